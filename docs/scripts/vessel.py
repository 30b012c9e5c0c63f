"""Writes what a living vessel costs, and what it does to policies, into docs/vessel.md.

python docs/scripts/vessel.py [--episodes 10]
"""

import argparse
import sys
import time
from pathlib import Path

import figures
import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.agents.evaluation import evaluate
from cathsim_dmc.simulation.batch import BatchSimulation

PAGE = Path(__file__).parents[1] / "vessel.md"
HEART, BREATH = {"phase": (0, 1)}, {"breath_phase": (0, 1)}
CASES = {
    "rigid": "rigid",
    "flow": {"flow": HEART},
    "wall": {"wall": True},
    "motion": {"motion": HEART | BREATH},
    "living": {"flow": HEART, "wall": True, "motion": BREATH},
}
POLICIES = (
    ("expert", "type1_lcca"),
    ("expert", "femoral_type1_lcca"),
    *((f"pretrained:{name}", name) for name in ("type1_bca", "type1_lcca")),
    *((f"pretrained:{name}", name) for name in ("type2_bca", "type2_lcca")),
    *(
        (f"pretrained:femoral_{name}_lcca", f"femoral_{name}_lcca")
        for name in ("type1", "type2")
    ),
)
LONGEST = 400  # control steps
SAFE = 1.0  # N


def costs(rounds: int = 5) -> str:
    """Times of a control step over the rigid vessel's, measured in alternation."""
    rows = ["| | random | push |", "|---|---|---|"]
    batches = {
        case: BatchSimulation(
            suite.make_task("type1_lcca", vessel=vessel, observation="tracking"),
            1,
            num_threads=1,
        )
        for case, vessel in CASES.items()
    }
    seconds = {(case, kind): [] for case in CASES for kind in ("random", "push")}
    for _ in range(rounds):
        for kind in ("random", "push"):
            held = np.random.RandomState(0).uniform(-1, 1, (12, 21))
            if kind == "push":
                held[:] = np.eye(21)[20]
            for case, batch in batches.items():
                batch.reset()
                start = time.process_time()
                for action in np.repeat(held, 10, axis=0):
                    batch.step(action[None])
                seconds[case, kind].append(time.process_time() - start)
    for case in CASES:
        ratios = [
            np.median(np.divide(seconds["rigid", kind], seconds[case, kind]))
            for kind in ("random", "push")
        ]
        rows.append(f"| {case} | {ratios[0]:.2f} | {ratios[1]:.2f} |")
    return "\n".join(rows)


def judged(episodes: int) -> str:
    """Success, safe success, largest force and steps of each policy in each vessel."""
    rows = ["| policy | task | " + " | ".join(CASES) + " |"]
    rows.append("|---" * (2 + len(CASES)) + "|")
    for policy, task in POLICIES:
        cells = []
        for case, vessel in CASES.items():
            options = {"vessel": vessel, "max_steps": LONGEST}
            result = evaluate(policy, task, episodes, task_kwargs=options)
            force = result.mean_sd("forces.peak_sum.maximum")[0]
            steps = result.mean_sd("length")[0]
            safe = round((result.safe_success(SAFE) or 0.0) * episodes)
            cells.append(f"{result.successes} ({safe}), {force:.2f} N, {steps:.0f}")
            print(policy, task, case, cells[-1], file=sys.stderr, flush=True)
        rows.append(f"| `{policy}` | `{task}` | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def main():
    """Measures and writes both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=10)
    episodes = parser.parse_args().episodes
    figures.put(PAGE, cost=costs(), policies=judged(episodes))


if __name__ == "__main__":
    main()
