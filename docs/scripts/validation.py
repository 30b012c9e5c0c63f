"""Runs the validations and rewrites their tables and figures.

``python docs/scripts/validation.py [rod] [pair] [wall] [forces] [--phantom DIRECTORY]``

Each part is written into docs/validation.md, pair into docs/pair.md, with its date,
as soon as it has ended.
"""

import argparse
import datetime
import json
import pathlib
import sys
import time

import validation_figures
from rich.console import Console

from cathsim_dmc import files, validation

DOCS = pathlib.Path(__file__).parents[1]
PAGE, PAIR = DOCS / "validation.md", DOCS / "pair.md"
IMAGES = DOCS / "images"
MACHINE = "2 shared cores of an Intel Xeon server"


def between(text: str, name: str, content: str) -> str:
    """The text with the part between the markers of `name` replaced."""
    start, stop = f"<!-- {name} -->\n", f"<!-- /{name} -->"
    head, rest = text.split(start)
    _, tail = rest.split(stop)
    return f"{head}{start}{content}{stop}{tail}"


def checks(report) -> str:
    lines = ["| check | measured | bound | | behind it |", "|---|---|---|---|---|"]
    for check in report.checks:
        passed = "pass" if check.passed else "**FAIL**"
        bound = f"{check.bound} {check.unit}"
        cells = (check.name, check.measured, bound, passed, check.note)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def findings(report) -> str:
    rows = ["| | |", "|---|---|"]
    for key, value in report.findings.items():
        if key == "convergence":
            continue
        rows += [f"| {name} | {number} |" for name, number in flat(key, value)]
    return "\n".join(rows) + "\n" if len(rows) > 2 else ""


def flat(key, value):
    if isinstance(value, dict):
        for inner, each in value.items():
            yield from flat(f"{key}: {inner}", each)
    else:
        yield key, f"{value:.4g}" if isinstance(value, float) else value


def convergence(report) -> str:
    rows = [
        "| script | parameter | value | links | path, mean (max), mm | off the track, "
        "max, mm | wall force, mean (p95), mN | deepest penetration, mm |",
        "|---|---|---|---|---|---|---|---|",
    ]
    units = {"physics_timestep": "time step, ms", "shaft_link": "longest link, mm"}
    for one in report.findings.get("convergence", ()):
        for index, value in enumerate(one["value"]):
            rows.append(
                f"| {one['script']} | {units[one['parameter']]} | {1e3 * value:g} | "
                f"{one['links'][index]} | {one['path_mean_mm'][index]:.3f} "
                f"({one['path_max_mm'][index]:.2f}) | "
                f"{one['track_max_mm'][index]:.2f} | "
                f"{1e3 * one['force_mean'][index]:.2f} "
                f"({1e3 * one['force_p95'][index]:.1f}) | "
                f"{one['penetration_max_mm'][index]:.2f} |"
            )
    return "\n".join(rows) + "\n"


def write(name: str, report, machine: str) -> None:
    """Put a report and its date into its page."""
    page = PAIR if name == "pair" else PAGE
    text = page.read_text(encoding="utf-8")
    text = between(text, name, checks(report))
    if name != "pair":
        text = between(text, f"{name} findings", findings(report))
    if name == "wall":
        text = between(text, "convergence", convergence(report))
    when = f"Measured on {datetime.date.today().isoformat()}, {machine}.\n"
    text = between(text, f"{name} when", when)
    files.write_text(page, text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="rod|pair|wall|forces")
    parser.add_argument("--phantom", action="append", default=[])
    parser.add_argument("--machine", default=MACHINE)
    parser.add_argument("--json", type=pathlib.Path, help="also write the reports here")
    arguments = parser.parse_args()
    runs = {
        "rod": validation.validate_rod,
        "pair": validation.validate_pair,
        "wall": lambda: validation.validate_wall(arguments.phantom),
        "forces": validation.validate_forces,
    }
    chosen = arguments.parts or list(runs)
    if unknown := set(chosen) - set(runs):
        parser.error(f"no part is called {', '.join(unknown)}; give some of {[*runs]}")
    reports = {}
    for name in chosen:
        start = time.time()
        report = runs[name]()
        validation_figures.draw(name, report, IMAGES / f"validation_{name}.png")
        Console().print(report.table())
        print(f"{name}: {time.time() - start:.0f} s", flush=True)
        write(name, report, arguments.machine)
        reports[name] = report
    if arguments.json:
        everything = {name: report.as_dict() for name, report in reports.items()}
        arguments.json.write_text(json.dumps(everything, indent=1), encoding="utf-8")
    return 0 if all(report.passed for report in reports.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
