"""Writes docs/leaderboard.md from the submissions in docs/data/leaderboard.

cathsim submit POLICY --task TASK --out docs/data/leaderboard/NAME.json
python docs/scripts/leaderboard.py
"""

import json
import sys

import figures

from cathsim_dmc.agents import protocols, submission
from cathsim_dmc.tasks.config import MAX_STEPS

PAGE = figures.ROOT / "docs" / "leaderboard.md"
FOLDER = figures.DATA / "leaderboard"
SAFE = "0.5 N"


def read(path):
    """A submission; ValueError where it does not count."""
    found = json.loads(path.read_text())
    if found.get("sha256") != submission.seal(found):
        raise ValueError(f"{path.name} was changed after it was written")
    wanted = protocols.get(submission.PROTOCOL).episodes
    if len(found["episodes"]) != wanted:
        raise ValueError(f"{path.name} has not the {wanted} episodes of the protocol")
    options = found["settings"]["task_kwargs"]
    if options not in ({}, {"max_steps": MAX_STEPS}):
        raise ValueError(f"{path.name} changes the options of its task: {options}")
    return found


def table(found):
    """Rows by task and safe success."""
    rows = [
        f"| task | policy | success, % (95 %) | safe, {SAFE}, % | time, s "
        "| mean force, mN | version, commit | policy SHA-256 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    order = {id(one): -(one["summary"]["safe_success"][SAFE] or 0) for one in found}
    for one in sorted(found, key=lambda one: (one["task"], order[id(one)])):
        summary = one["summary"]
        low, high = summary["success_ci95"]
        digest = one["policy_sha256"]
        rows.append(
            f"| `{one['task']}` | `{one['policy']}` | {100 * summary['success']:.0f} "
            f"({100 * low:.0f}–{100 * high:.0f}) "
            f"| {100 * summary['safe_success'][SAFE]:.0f} "
            f"| {0.04 * summary['length']:.1f} "
            f"| {1e3 * summary['forces']['sum']['mean']['mean']:.1f} "
            f"| {one['package']}, {one['commit'] or '–'} "
            f"| {f'`{digest[:12]}`' if digest else '–'} |"
        )
    return rows


def main():
    found = [read(path) for path in sorted(FOLDER.glob("*.json"))]
    figures.put(PAGE, leaderboard=table(found))


if __name__ == "__main__":
    sys.exit(main())
