"""Measures the speed for docs/performance.md and writes its tables.

python docs/scripts/performance.py          (with nothing else running)
python docs/scripts/performance.py --write  (the tables alone, from docs/data)
"""

import argparse
import json
import re
import subprocess
import sys

import figures

PAGE = figures.ROOT / "docs" / "performance.md"
DATA = figures.DATA / "speed.json"
# Rows of the page: names in the file, which has more, by label.
BATCHED = {
    "random, 1 thread": "1 thread",
    "random, 2 threads": "2 threads",
    "random, 1 thread, through TorchRL": "TorchRL, 1 thread",
}


def measure():
    script = figures.ROOT / "benchmarks" / "speed.py"
    command = [sys.executable, str(script), "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    figures.keep("speed", json.loads(done.stdout), "python benchmarks/speed.py --json")


def factors(report):
    """Table of real-time factors by anatomy and policy."""
    lines = ["| task | policy | real-time factor | calibrated, µs | at least |"]
    lines.append("|---|---|---|---|---|")
    bars = {check["name"]: check for check in report["checks"]}
    for scene, row in report["findings"]["calibration"].items():
        for policy, one in row.items():
            check = bars[f"calibrated speed, {scene}, {policy}"]
            lines.append(
                f"| `{scene}` | {policy} | {one['real_time_factor']:.0f} "
                f"| {check['value']:.0f} | {check['bound'].split()[1]} |"
            )
    return lines


def others(report):
    """Table of the checks other than calibrated speeds."""
    lines = ["| figure | measured | bound | |", "|---|---|---|---|"]
    for check in report["checks"]:
        if not check["name"].startswith("calibrated"):
            verdict = "" if check["passed"] else "**missed**"
            lines.append(
                f"| {check['name']} | {check['value']:.3g} {check['unit']} "
                f"| {check['bound']} | {verdict} |"
            )
    return lines


def depths(report):
    table = report["findings"]["by_insertion_depth"]
    bins = sorted(
        {key for row in table.values() for key in row},
        key=lambda name: float(re.match(r"\d+", name)[0]),
    )
    shown = {
        policy: {
            key: f"{one['real_time_factor']:.0f} ({one['contacts']:.0f})"
            for key, one in row.items()
        }
        for policy, row in table.items()
    }
    rows = ([policy, *(row.get(k, "–") for k in bins)] for policy, row in shown.items())
    return figures.grid(["policy", *bins], rows)


def stages(report):
    table = report["findings"]["microseconds_in_a_control_step"]
    rows = [
        [stage, *(f"{column[stage]:.0f}" for column in table.values())]
        for stage in next(iter(table.values()))
    ]
    return figures.grid(["", *table], rows)


def batches(report):
    rates = report["findings"]["batched_steps_per_second"]
    rows = [(row, f"{rates[key]:.0f}") for row, key in BATCHED.items()]
    return figures.grid(("16 simulations", "control steps per second"), rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="tables alone")
    if not parser.parse_args().write:
        measure()
    report = json.loads(DATA.read_text())
    makers = (factors, others, depths, stages, batches)
    blocks = {make.__name__: make(report) for make in makers}
    figures.put(PAGE, measured=figures.since(report), **blocks)


if __name__ == "__main__":
    main()
