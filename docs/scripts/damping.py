"""Writes how the expert's episodes depend on the damping into docs/physics.md.

    python docs/scripts/damping.py

The expert's actions with the stated damping are replayed with other damping (open
loop), and the expert plays with other damping (closed loop).
"""

import argparse
from pathlib import Path

import figures
import numpy as np

from cathsim_dmc import policies, suite

PAGE = Path(__file__).parents[1] / "physics.md"
TASK, SEEDS = "type1_lcca", range(4)
# Factors of the loss factor and of the viscosity.
CASES = {"as stated": 1.0, "half": 0.5, "twice": 2.0}


def episode(case, seed, actions=None):
    """Actions, end of the tip (3,) m, mean wall force (N) and success of an episode."""
    factor = CASES[case]
    ranges = {"loss": (factor, factor), "viscosity": (factor, factor)}
    env = suite.load("cathsim", TASK, {"random": seed, "randomisation": ranges})
    act = policies.in_environment(policies.make_policy("expert"), env)
    step, done, forces = env.reset(), [], []
    while not step.last() and len(done) < (300 if actions is None else len(actions)):
        done.append(act(step) if actions is None else actions[len(done)])
        step = env.step(done[-1])
        forces.append(float(env.task.wall_force.mean_sum))
    return done, env.task.readings.head, np.mean(forces), step.discount == 0.0


def main():
    stated = [episode("as stated", seed) for seed in SEEDS]
    rows = ["| damping | tip, mm, median (max) | force | steps of the expert |"]
    rows.append("|---|---|---|---|")
    for case in CASES:
        again = [episode(case, s, one[0]) for s, one in zip(SEEDS, stated, strict=True)]
        away = [
            1e3 * np.linalg.norm(a[1] - b[1])
            for a, b in zip(again, stated, strict=True)
        ]
        ratio = np.mean([a[2] for a in again]) / np.mean([b[2] for b in stated])
        own = [episode(case, seed) for seed in SEEDS]
        steps = np.mean([len(one[0]) for one in own])
        reached = sum(one[3] for one in own)
        rows.append(
            f"| {case} | {np.median(away):.1f} ({max(away):.1f}) | × {ratio:.2f} | "
            f"{steps:.0f}, {reached} of {len(own)} at the goal |"
        )
        print(rows[-1], flush=True)
    figures.put(PAGE, damping=rows)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
