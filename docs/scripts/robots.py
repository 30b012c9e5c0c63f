"""Percentiles of the control loop over a socket, for docs/robots.md.

    python docs/scripts/robots.py

Serves a task in one process and drives it in another with a policy that ships, in real
time and with the commands of the user, and writes the table into the page.
"""

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

from figures import grid, origin, put, since

PAGE = Path(__file__).parents[1] / "robots.md"
CATHSIM = [sys.executable, "-m", "cathsim_dmc.cli"]
EPISODES, SEED = 3, 1_000_000
CASES = {  # policy: task with its options
    "femoral_type1_lcca": "femoral_type1_lcca --observation tracking",
    "type1_lcca": "type1_lcca --observation internal",
    "femoral_type1_lcca_pair": "femoral_type1_lcca_pair --observation tracking",
}
HEAD = (
    "policy, observation",
    "state → action in the driver, ms: p50 / p95 / p99 / max",
    "state sent → action received by the device, ms",
    "period begins late, ms",
    "missed of all periods",
    "ends",
)


def measure(policy: str, task: str) -> list[str]:
    """Plays a case; returns its row of the table."""
    count = ["--episodes", str(EPISODES), "--json"]
    patient = ["--watchdog", "2"]
    device = subprocess.Popen(
        [*CATHSIM, "serve", *task.split(), "--port", "0", *count, *patient],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    place = None
    while place is None and (line := device.stderr.readline()):
        place = re.search(r"listens on (\S+)", line)
    if place is None:
        raise SystemExit(f"{task} is not served")
    there = ["--connect", place[1], "--seed", str(SEED)]
    drive = [*CATHSIM, "drive", f"pretrained:{policy}", *there, *count, *patient]
    found = subprocess.run(drive, stdout=subprocess.PIPE, text=True)
    served = json.loads(device.communicate()[0])["episodes"]
    driven = json.loads(found.stdout)["episodes"]
    missed = sum(one["missed"] for one in served), sum(one["steps"] for one in served)
    return [
        f"`{policy}`, {task.split()[-1]}",
        worst(driven, "compute"), worst(served, "answer"), worst(served, "tick"),
        "{} of {}".format(*missed), ", ".join(one["end"] for one in driven),
    ]  # fmt: skip


def worst(episodes: list[dict], name: str) -> str:
    """Text of percentiles, the largest over the episodes of each."""
    each = [one[name] for one in episodes]
    return " / ".join(f"{max(one[k] for one in each):.1f}" for k in each[0])


def main() -> None:
    rows = [measure(*case) for case in CASES.items()]
    text = [since(origin("python docs/scripts/robots.py")), "", *grid(HEAD, rows)]
    put(PAGE, measured=text)
    print(*text, sep="\n")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
