"""The expert on every arch of a set, one episode each, by type of arch.

    python docs/scripts/test_arches.py --out runs/test_arches.jsonl
    python docs/scripts/test_arches.py --out runs/test_arches.jsonl --write

Every episode becomes a line of the file when it ends; the same command continues with
the missing episodes. `--write` writes the table into docs/difficulty.md.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

import figures
import numpy as np

from cathsim_dmc import files, policies, suite
from cathsim_dmc.analysis.intervals import success_interval
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.simulation.batch import BatchSimulation

# Placed before this folder, which has a difficulty.py too.
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import difficulty

TASKS = ("arch_bca", "arch_lcca", "femoral_arch_bca", "femoral_arch_lcca")
PAGE = Path(__file__).parents[1] / "difficulty.md"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--arches", default="test", choices=arch.SETS)
    parser.add_argument("--task", action="append", choices=TASKS)
    parser.add_argument("--policy", default="expert", choices=policies.POLICIES)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.write:
        figures.put(PAGE, arches=table(read(options.out)))
        return
    files.require_file(options.out)
    done = {(row["task"], row["arch"]) for row in read(options.out)}
    # The goals of an arch follow each other, so that it is built once.
    for number, seed in enumerate(arch.arch_set(options.arches)):
        for task in options.task or TASKS:
            if (task, seed.name) in done:
                continue
            row = {"task": task, "arch": seed.name, "type": seed.arch_type}
            row |= episode(task, options.arches, number, options.policy)
            with options.out.open("a") as file:
                file.write(json.dumps(row) + "\n")


def episode(task, arches, number, policy):
    """Plays one episode on one arch; returns its end, steps and forces."""
    where = {"arches": arches, "pool": 1, "first": number}
    made = suite.make_task(task, observation="tracking", **where)
    limit = difficulty.LIMITS.get(policy)
    trial = difficulty.play(
        BatchSimulation(made, 1, num_threads=1),
        policies.make_policy(policy, 0),
        number,
        limit,
    )
    return {"end": trial.ends[0], "steps": trial.steps[0]} | {
        "forces": dataclasses.asdict(trial.forces[0])
    }


def read(path):
    lines = path.read_text().splitlines() if path.exists() else []
    return [json.loads(line) for line in lines]


def table(rows):
    """The table as lines of Markdown, with a row for each task and type of arch."""
    lines = [
        "| task | type | success, % (95 % interval), arches | steps | mean force, mN "
        "| largest contact, mN: mean / largest |",
        "|---|---|---|---|---|---|",
    ]
    for task in TASKS:
        for kind in (*sorted({row["type"] for row in rows}), "all"):
            own = [r for r in rows if r["task"] == task and kind in (r["type"], "all")]
            if not own:
                continue
            good = sum(r["end"] == difficulty.SUCCESS for r in own)
            low, high = success_interval(good, len(own))
            mean = np.mean(
                [r["forces"].get("mean_sum", r["forces"]["sum"])["mean"] for r in own]
            )
            peaks = [
                r["forces"].get("mean_max", r["forces"]["peak_max"])["maximum"]
                for r in own
            ]
            lines.append(
                f"| `{task}` | {kind} | {100 * good / len(own):.0f} "
                f"({100 * low:.0f}–{100 * high:.0f}), {len(own)} "
                f"| {np.mean([r['steps'] for r in own]):.0f} | {1e3 * mean:.1f} "
                f"| {1e3 * np.mean(peaks):.0f} / {1e3 * np.max(peaks):.0f} |"
            )
    return lines


if __name__ == "__main__":
    main()
