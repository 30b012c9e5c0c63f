"""Forces of a cannulation of type1_bca against the published description.

    python docs/scripts/force_protocol.py --out docs/data/force_protocol.json

Plays the expert and a straight push with 1 to 100 times the bending stiffness and three
frictions, one episode from the same start each; writes the table of docs/forces.md. A
sample is one contact in the last physics step of a control step, as published.
"""

import argparse
import itertools
import json
from pathlib import Path

import figures
import numpy as np

from cathsim_dmc import files, policies, suite
from cathsim_dmc.physics.randomisation import Draw, Randomisation, RandomisedModel
from cathsim_dmc.simulation.batch import BatchSimulation

TASK = "type1_bca"
STIFFNESS = (1.0, 3.0, 10.0, 30.0, 100.0)  # times the device's EI
FRICTION = (0.02, 0.037, 0.15)  # wet silicone 0.037; else the randomised range
SHOWN = 0.037  # friction of the rows of the page
POLICIES = {"expert": "steered", "push": "pushed"}
STEPS = 250
RESTING = 40  # control steps without progress after which an episode ends
NARROW, WIDE = 0.2, 0.4  # N: most forces are below NARROW, outliers above WIDE
PAGE = Path(__file__).parents[1] / "forces.md"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    files.require_file(options.out)
    rows = []
    for policy in POLICIES:
        rows += play(policy, options.threads)
    report = {**figures.origin("python docs/scripts/force_protocol.py"), "rows": rows}
    files.write_text(options.out, json.dumps(report, indent=1) + "\n")
    figures.put(PAGE, protocol=[figures.since(report), "", *table(rows)])


def play(name, threads):
    """Plays a policy; returns a row of statistics for each stiffness and friction."""
    settings = list(itertools.product(STIFFNESS, FRICTION))
    count = len(settings)
    task = suite.make_task(TASK, observation="tracking", effects=[Settings(settings)])
    simulation = BatchSimulation(task, count, num_threads=threads)
    # All episodes have the same start.
    simulation.seed([0] * count)
    step = simulation.reset()
    policy = policies.make_policy(name, 0)
    policy.reset(policies.View(simulation), np.ones(count, dtype=bool))
    samples = [[] for _ in settings]
    cell, ends = [[] for _ in settings], [None] * count
    lengths, best = np.zeros(count, dtype=int), np.full(count, -1.0)
    resting = np.zeros(count, dtype=int)
    for number in range(1, STEPS + 1):
        step = simulation.step(policy.act(step.observation))
        contacts, insertion = simulation.contacts(), step.readings.insertion
        grown = insertion > best + 0.5e-3
        best = np.where(grown, insertion, best)
        resting = np.where(grown, 0, resting + 1)
        for i in range(count):
            if ends[i] is not None:
                continue
            lengths[i] = number
            present = contacts.present[i]
            samples[i] += contacts.magnitude[i][present].tolist()
            if present.any():
                resultant = contacts.force[i][present].sum(0)
                cell[i].append(float(np.linalg.norm(resultant)))
            if step.errors[i] is not None:
                ends[i] = step.errors[i]
            elif step.outcome.success[i]:
                ends[i] = "success"
            elif resting[i] >= RESTING and name == "push":
                ends[i] = "stuck"
        if None not in ends:
            break
    return [
        {
            "policy": name,
            "stiffness": stiffness,
            "friction": friction,
            "end": ends[i] or "out of time",
            "steps": int(lengths[i]),
            **statistics(np.array(samples[i]), np.array(cell[i]), int(lengths[i])),
        }
        for i, (stiffness, friction) in enumerate(settings)
    ]


class Settings(RandomisedModel):
    """Stiffness and friction of each simulation."""

    def __init__(self, settings):
        """Takes a factor of the stiffness and a friction for each simulation."""
        super().__init__(Randomisation(friction=(0.0, 1.0), stiffness=(1.0, 100.0)))
        self._settings = settings

    def restart(self, index, episode, random_state):
        """Writes the model of one simulation."""
        stiffness, friction = self._settings[index]
        own = Draw(np.zeros(3), friction=friction, stiffness=stiffness)
        super().restart(index, own, random_state)


def statistics(samples, cell, steps):
    """Statistics of contact forces (n,) and readings of the load cell (m,), N."""
    if not len(samples):
        return {"samples": 0}
    return {
        "samples": len(samples),
        "in_contact": len(cell) / steps,
        "mean": float(samples.mean()),
        "median": float(np.median(samples)),
        "p95": float(np.percentile(samples, 95)),
        "max": float(samples.max()),
        "below": float((samples <= NARROW).mean()),
        "above": float((samples > WIDE).mean()),
        "load_cell": float(cell.mean()),
    }


def table(rows):
    """The table as lines of Markdown."""
    lines = [
        "| | EI, times | end, control steps | contacts, steps in contact "
        "| mean / median / p95 / max, mN | up to 0.2 N / above 0.4 N "
        "| load cell, mean, mN |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if row["friction"] != SHOWN:
            continue
        start = (
            f"| {POLICIES[row['policy']]} | {row['stiffness']:g} "
            f"| {row['end']}, {row['steps']} "
        )
        if not row["samples"]:
            lines.append(start + "| none | – | – | – |")
            continue
        four = (f"{1e3 * row[key]:.0f}" for key in ("mean", "median", "p95", "max"))
        lines.append(
            start + f"| {row['samples']}, {100 * row['in_contact']:.0f} % "
            f"| {' / '.join(four)} | {100 * row['below']:.0f} % / "
            f"{100 * row['above']:.0f} % | {1e3 * row['load_cell']:.0f} |"
        )
    return lines


if __name__ == "__main__":
    main()
