"""Runs all validations and rewrites the tables and figures of docs/validation.md.

``python docs/scripts/validation.py [--phantom DIRECTORY ...] [--machine TEXT]``
"""

import argparse
import datetime
import json
import pathlib
import sys
import time

from rich.console import Console

from cathsim_dmc import validation

DOCS = pathlib.Path(__file__).parents[1]
PAGE = DOCS / "validation.md"
IMAGES = DOCS / "images"
MACHINE = "2 cores of an AMD EPYC server"


def between(text: str, name: str, content: str) -> str:
    """The text with the part between the markers of `name` replaced."""
    start, stop = f"<!-- {name} -->\n", f"<!-- /{name} -->"
    head, rest = text.split(start)
    _, tail = rest.split(stop)
    return f"{head}{start}{content}{stop}{tail}"


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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--phantom", action="append", default=[])
    parser.add_argument("--machine", default=MACHINE)
    parser.add_argument("--json", type=pathlib.Path, help="also write the reports here")
    arguments = parser.parse_args()
    runs = {
        "rod": validation.validate_rod,
        "wall": lambda figure: validation.validate_wall(figure, arguments.phantom),
        "forces": validation.validate_forces,
    }
    text, reports = PAGE.read_text(encoding="utf-8"), {}
    for name, run in runs.items():
        start = time.time()
        report = run(IMAGES / f"validation_{name}.png")
        Console().print(report.table())
        print(f"{name}: {time.time() - start:.0f} s")
        text = between(text, name, report.markdown())
        text = between(text, f"{name} findings", findings(report))
        reports[name] = report
    text = between(text, "convergence", convergence(reports["wall"]))
    today = datetime.date.today().isoformat()
    text = between(text, "when", f"Measured on {today}, {arguments.machine}.\n")
    PAGE.write_text(text, encoding="utf-8")
    if arguments.json:
        everything = {name: report.as_dict() for name, report in reports.items()}
        arguments.json.write_text(json.dumps(everything, indent=1), encoding="utf-8")
    return 0 if all(report.passed for report in reports.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
