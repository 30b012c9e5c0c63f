"""Runs the validations, keeps their figures in docs/data and draws their pictures.

    python docs/scripts/validation.py [rod] [pair] [wall] [rest] [forces]

Each part is kept as soon as it has ended; `figures.py` writes the pages.
"""

import argparse
import sys

import figures
import validation_figures
from rich.console import Console

from cathsim_dmc.validation import force_sensors, pair, rest, rod, wall

DOCS = figures.ROOT / "docs"
IMAGES = DOCS / "images"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="rod|pair|wall|rest|forces")
    arguments = parser.parse_args()
    runs = {
        "rod": rod.validate_rod,
        "pair": pair.validate_pair,
        "wall": wall.validate_wall,
        "rest": rest.validate_rest,
        "forces": force_sensors.validate_forces,
    }
    chosen = arguments.parts or list(runs)
    if unknown := set(chosen) - set(runs):
        parser.error(f"no part is called {', '.join(unknown)}; give some of {[*runs]}")
    passed = True
    for part in chosen:
        report = runs[part]()
        if part in validation_figures.DRAWN:
            validation_figures.draw(part, report, IMAGES / f"validation_{part}.png")
        Console().print(report.table())
        figures.keep(f"validation_{part}", report.as_dict(), f"cathsim validate {part}")
        passed = passed and report.passed
    figures.main([])
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
