"""Writes docs/performance.md's tables from `benchmarks/speed.py --json`.

python docs/scripts/performance.py  (with nothing else running)
"""

import datetime
import json
import re
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).parents[1] / "performance.md"
BEGIN, END = "<!-- measured -->", "<!-- end -->"


def main():
    result = subprocess.run(
        [sys.executable, str(PAGE.parents[1] / "benchmarks/speed.py"), "--json"],
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    report = json.loads(result.stdout)
    lines = [
        f"Measured on {datetime.date.today()}, 2 shared cores of an Intel Xeon server:",
        "",
        "| figure | measured | bar | |",
        "|---|---|---|---|",
    ]
    for check in report["checks"]:
        verdict = "" if check["passed"] else "**missed**"
        note = f" ({check['note']})" if check["note"] else ""
        lines.append(
            f"| {check['name']}{note} | {check['value']:.3g} {check['unit']} "
            f"| {check['bound']} | {verdict} |"
        )
    lines += ["", "By insertion depth (real-time factor; contacts with the wall):", ""]
    depths = report["findings"]["by_insertion_depth"]
    bins = sorted({key for row in depths.values() for key in row}, key=_low)
    lines += [f"| policy | {' | '.join(bins)} |", "|---" * (len(bins) + 1) + "|"]
    for policy, row in depths.items():
        cells = [
            f"{row[key]['real_time_factor']:.0f} ({row[key]['contacts']:.0f})"
            if key in row
            else "–"
            for key in bins
        ]
        lines.append(f"| {policy} | {' | '.join(cells)} |")
    rates = report["findings"]["batched_steps_per_second"]
    lines += ["", "Batched control steps per second, 16 simulations, random:", ""]
    lines += [f"- {name}: {rate:.0f}" for name, rate in rates.items()]
    lines += ["", "Where a control step of 40 ms goes, µs on one core:", ""]
    stages = report["findings"]["microseconds_in_a_control_step"]
    lines += [f"| | {' | '.join(stages)} |", "|---" * (len(stages) + 1) + "|"]
    for stage in next(iter(stages.values())):
        cells = [f"{table[stage]:.0f}" for table in stages.values()]
        lines.append(f"| {stage} | {' | '.join(cells)} |")
    page = PAGE.read_text()
    block = BEGIN + "\n" + "\n".join(lines) + "\n" + END
    PAGE.write_text(re.sub(f"{BEGIN}.*{END}", lambda _: block, page, flags=re.S))


def _low(name: str) -> float:
    return float(re.match(r"\d+", name).group())


if __name__ == "__main__":
    main()
