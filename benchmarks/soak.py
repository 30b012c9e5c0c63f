"""Soak: long episodes under harsh policies, with a record of everything that breaks.

    python benchmarks/soak.py --out runs/soak          # 100 episodes of 2,000 steps
    python benchmarks/soak.py --out runs/soak --quick  # 16 episodes of 200 steps

Every finished episode is one line of OUT/episodes.jsonl, written when its batch ends;
the same command continues with the missing episodes. The report is printed and written
to OUT/soak.json and OUT/soak.md. Exit code 1: a bound was broken.

Measured quantities
- penetration: penetration depth of every contact with the wall in every physics substep
  (MuJoCo's `dist`). Percentiles are those of the deepest contact of a substep, over the
  substeps that have a contact.
- wall force: magnitude of every single contact in every substep, and their sum.
- excess: protrusion of the device from the lumen (or the sheath) in every control step,
  at points 1 mm apart along its axis, with and without contacts: `containment.py`.
- escape: the excess exceeds the device's diameter, so that a part of the device is
  entirely outside.
- tip step: largest displacement of the device's end in a control step.
- warnings: MuJoCo's own counters.

Goals do not end episodes: their radius is tiny.
"""

import argparse
import collections
import dataclasses
import itertools
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from containment import Containment
from scipy.stats import qmc

from cathsim_dmc import files, suite
from cathsim_dmc.cli.options import say
from cathsim_dmc.physics import forces
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.validation.checks import Check

# Both arches from both accesses; the goal does not affect these policies.
TASKS = ("type1_lcca", "type2_lcca", "femoral_type1_lcca", "femoral_type2_lcca")
EPISODES, STEPS = 100, 2000
QUICK_EPISODES, QUICK_STEPS = 16, 200
TINY_GOAL = 1e-9  # m

# Bounds.
PENETRATION_P99 = 0.3e-3  # m
PENETRATION_MAX = 1e-3  # m
FORCE_MAX = 10.0  # N

# Penetrations are counted in bins, so that percentiles over all episodes follow from
# their lines.
BIN, BINS = 1e-6, 10_000  # m; the last bin holds all larger ones

# Quantities whose largest value is kept with its control step.
STEPPED = ("penetration", "force", "excess", "tip_step")

# Most control steps between two changes of the action.
LONGEST_HOLD = 100


# Policies: (control steps, size of an action, seed) -> actions (T, A) in [-1, 1].


def halton_noise(steps: int, size: int, seed: int) -> np.ndarray:
    """Low-discrepancy noise, with a new value at every control step."""
    return 2 * qmc.Halton(size, seed=seed).random(steps) - 1


def full_push(steps: int, size: int, seed: int) -> np.ndarray:
    """Forward at full speed with a constant command of the tip, straight or curled."""
    random = np.random.RandomState(seed)
    tip = random.choice([-1.0, 1.0], size=size) * random.choice([0.0, 0.5, 1.0])
    tip[-1] = 1.0
    return np.tile(tip, (steps, 1))


def bang_bang(steps: int, size: int, seed: int) -> np.ndarray:
    """All motors of the tip alternate between their limits, with a constant push.

    The period differs between seeds; the shortest is one control step.
    """
    random = np.random.RandomState(seed)
    hold = (1, 2, 5, 25)[seed % 4]
    sign = np.where(np.arange(steps) // hold % 2, -1.0, 1.0)
    action = sign[:, None] * random.choice([-1.0, 1.0], size=size)
    action[:, -1] = 1.0
    return action


def reversals(steps: int, size: int, seed: int) -> np.ndarray:
    """Push and pull at full speed alternate, each with a new extreme tip command."""
    random = np.random.RandomState(seed)
    action = np.empty((steps, size))
    start, direction = 0, 1.0
    while start < steps:
        stop = start + random.randint(1, LONGEST_HOLD)
        action[start:stop] = random.choice([-1.0, 1.0], size=size)
        action[start:stop, -1] = direction
        start, direction = stop, -direction
    return action


POLICIES: dict[str, Callable[[int, int, int], np.ndarray]] = {
    "halton": halton_noise,
    "push": full_push,
    "bang_bang": bang_bang,
    "reversals": reversals,
}


@dataclasses.dataclass(frozen=True)
class Episode:
    """One episode to run; `seed` is that of the environment and of the policy."""

    number: int
    task: str
    policy: str
    seed: int


def plan(
    episodes: int,
    tasks: Sequence[str] = TASKS,
    policies: Sequence[str] = tuple(POLICIES),
) -> list[Episode]:
    """Spreads episodes evenly over tasks and policies."""
    pairs = itertools.cycle(itertools.product(policies, tasks))
    size = len(policies) * len(tasks)
    return [
        Episode(number, task, policy, number // size)
        for number, (policy, task) in zip(range(episodes), pairs, strict=False)
    ]


@dataclasses.dataclass
class Peak:
    """Largest value in each simulation, and the control step of it."""

    value: np.ndarray
    step: np.ndarray

    @classmethod
    def none(cls, size: int) -> "Peak":
        return cls(np.zeros(size), np.full(size, -1))

    def update(self, value: np.ndarray, step: int) -> None:
        larger = value > self.value
        self.value[larger] = value[larger]
        self.step[larger] = step


def run(simulation: BatchSimulation, episodes: list[Episode], steps: int) -> list[dict]:
    """Runs episodes of one task in a batch.

    Args:
      simulation: batch of the task with a simulation for each episode.
      episodes: episodes to run.
      steps: number of control steps.

    Returns:
      One row for each episode.
    """
    size = len(episodes)
    simulation.seed([episode.seed for episode in episodes])
    actions = np.stack(
        [
            POLICIES[episode.policy](steps, simulation.num_actions, episode.seed)
            for episode in episodes
        ],
        axis=1,
    )
    containment = Containment.of(simulation.task)
    simulation.reset()
    warnings = np.zeros(size, dtype=int)
    before = simulation.batch.warning.reshape(size, -1).copy()
    peaks = {name: Peak.none(size) for name in (*STEPPED, "force_sum", "contacts")}
    tip = simulation.rollout.readings.head
    counts = np.zeros((size, BINS), dtype=np.int64)
    force_sum = np.zeros(size)
    errors = np.full(size, -1)
    insertion = np.zeros(size)
    for step in range(steps):
        result = simulation.step(actions[step])
        after = simulation.batch.warning.reshape(size, -1).copy()
        warnings += (after != before).any(-1)
        before = after
        errors[result.physics_error & (errors < 0)] = step
        rows = simulation.stepper.rows[..., simulation.rollout.index.wall_contacts]
        contacts = forces.Contacts.from_sensor(rows)
        deepest = contacts.penetration.max(-1)
        touching = contacts.present.any(-1)
        bins = np.clip((deepest / BIN).astype(int), 0, BINS - 1)
        np.add.at(counts, (np.nonzero(touching)[0], bins[touching]), 1)
        found = {
            "penetration": deepest.max(-1),
            "force": contacts.magnitude.max((-1, -2)),
            "excess": containment.largest_excess(result.readings.centreline),
            "tip_step": np.linalg.norm(result.readings.head - tip, axis=-1),
            "force_sum": contacts.magnitude.sum(-1).max(-1),
            "contacts": contacts.found.max(-1),
        }
        for name, value in found.items():
            peaks[name].update(value, step)
        tip = result.readings.head
        force_sum += contacts.magnitude.sum(-1).mean(-1)
        insertion = np.maximum(insertion, result.readings.insertion)
    radius = containment.device_radius
    return [
        {
            **dataclasses.asdict(episode),
            "steps": steps,
            "warnings": int(warnings[index]),
            "physics_error_step": int(errors[index]),
            "escaped": bool(peaks["excess"].value[index] > 2 * radius),
            **{f"{name}_max": float(peaks[name].value[index]) for name in STEPPED},
            **{f"{name}_step": int(peaks[name].step[index]) for name in STEPPED},
            "force_sum_max": float(peaks["force_sum"].value[index]),
            "force_sum_mean": float(force_sum[index] / steps),
            "contacts_max": int(peaks["contacts"].value[index]),
            "insertion_max": float(insertion[index]),
            "penetration_histogram": {
                int(bin_): int(counts[index, bin_])
                for bin_ in np.flatnonzero(counts[index])
            },
        }
        for index, episode in enumerate(episodes)
    ]


# Results.


def read_rows(path: Path, steps: int) -> list[dict]:
    """Rows of a file that this program wrote, without an incomplete last line.

    Rows without `tip_step_max` are dropped too, so that they run again.

    Raises:
      ValueError: if they have another number of steps.
    """
    if not path.is_file():
        return []
    rows = []
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    rows = [row for row in rows if "tip_step_max" in row]
    if any(row["steps"] != steps for row in rows):
        raise ValueError(
            f"{path} holds episodes of {rows[0]['steps']} steps, not {steps}; give "
            "another --out, or delete it"
        )
    return rows


def percentile(rows: list[dict], percent: float) -> float:
    """Percentile of the penetration over all rows, m (0 without contact)."""
    counts = collections.Counter()
    for row in rows:
        found = row["penetration_histogram"].items()
        counts.update({int(key): count for key, count in found})
    if not counts:
        return 0.0
    bins = sorted(counts)
    below = np.cumsum([counts[one] for one in bins])
    return (bins[np.searchsorted(below, below[-1] * percent / 100)] + 1) * BIN


def summarise(rows: list[dict]) -> dict:
    """Statistics of a set of episodes; lengths in mm, forces in N."""
    return {
        "episodes": len(rows),
        "warnings": sum(row["warnings"] for row in rows),
        "escapes": sum(row["escaped"] for row in rows),
        "excess_max_mm": 1e3 * max(row["excess_max"] for row in rows),
        "penetration_p99_mm": 1e3 * percentile(rows, 99),
        "penetration_max_mm": 1e3 * max(row["penetration_max"] for row in rows),
        "tip_step_max_mm": 1e3 * max(row["tip_step_max"] for row in rows),
        "force_max": max(row["force_max"] for row in rows),
        "force_sum_max": max(row["force_sum_max"] for row in rows),
        "force_sum_mean": float(np.mean([row["force_sum_mean"] for row in rows])),
        "contacts_max": max(row["contacts_max"] for row in rows),
    }


def report(rows: list[dict]) -> dict:
    """Checks and statistics in the format of all measuring commands."""
    total = summarise(rows)

    def worst(key):
        row = max(rows, key=lambda row: row[f"{key}_max"])
        names = ("task", "policy", "seed", f"{key}_max", f"{key}_step")
        return {name: row[name] for name in names}

    groups = [
        {
            "task": task,
            "policy": policy,
            **summarise(
                [r for r in rows if (r["task"], r["policy"]) == (task, policy)]
            ),
        }
        for policy, task in sorted({(row["policy"], row["task"]) for row in rows})
    ]
    depth, deepest = total["penetration_p99_mm"], total["penetration_max_mm"]
    checks = [
        Check.at_most("MuJoCo warnings", total["warnings"], 0),
        Check.at_most("escapes", total["escapes"], 0),
        Check.at_most("penetration p99", depth, 1e3 * PENETRATION_P99, "mm"),
        Check.at_most("penetration max", deepest, 1e3 * PENETRATION_MAX, "mm"),
        Check.at_most("largest wall force", total["force_max"], FORCE_MAX, "N"),
    ]
    return {
        "checks": [dataclasses.asdict(check) for check in checks],
        "total": total,
        "worst": {key: worst(key) for key in STEPPED},
        "groups": groups,
    }


def markdown(result: dict) -> str:
    """The report as Markdown tables."""
    lines = [
        "| check | measured | bound | |",
        "|---|---|---|---|",
        *(
            f"| {c['name']} | {c['value']:.3g} {c['unit']} | {c['bound']} {c['unit']} "
            f"| {'pass' if c['passed'] else '**FAIL**'} |"
            for c in result["checks"]
        ),
        "",
        "| task | policy | episodes | penetration p99 / max, mm | excess max, mm "
        "| tip step max, mm | largest force, N | mean sum, N | contacts |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for group in [*result["groups"], {"task": "all", "policy": "", **result["total"]}]:
        lines.append(
            f"| {group['task']} | {group['policy']} | {group['episodes']} "
            f"| {group['penetration_p99_mm']:.3f} / {group['penetration_max_mm']:.3f} "
            f"| {group['excess_max_mm']:.2f} | {group['tip_step_max_mm']:.2f} "
            f"| {group['force_max']:.2f} "
            f"| {group['force_sum_mean']:.3f} | {group['contacts_max']} |"
        )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/soak"), help="folder")
    parser.add_argument("--quick", action="store_true", help="16 by 200 steps")
    parser.add_argument("--episodes", type=int, help="by default 100")
    parser.add_argument("--steps", type=int, help="of an episode; 2,000")
    parser.add_argument("--threads", type=int, default=0, help="0: one per core")
    parser.add_argument("--together", type=int, default=8, help="episodes side by side")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--task", action="append", help="repeated for several")
    parser.add_argument(
        "--policy", action="append", choices=list(POLICIES), help="repeated likewise"
    )
    options = parser.parse_args()
    episodes = options.episodes or (QUICK_EPISODES if options.quick else EPISODES)
    steps = options.steps or (QUICK_STEPS if options.quick else STEPS)
    files.require_folder(options.out, make=True)
    path = options.out / "episodes.jsonl"
    tasks = options.task or TASKS
    wanted = plan(episodes, tasks, options.policy or tuple(POLICIES))
    done = {row["number"] for row in read_rows(path, steps)}
    for task in tasks:
        missing = [e for e in wanted if e.task == task and e.number not in done]
        for first in range(0, len(missing), options.together):
            part = missing[first : first + options.together]
            start = time.perf_counter()
            made = suite.make_task(task, goal_radius=TINY_GOAL)
            simulation = BatchSimulation(made, len(part), num_threads=options.threads)
            rows = read_rows(path, steps) + run(simulation, part, steps)
            files.write_text(path, "".join(json.dumps(row) + "\n" for row in rows))
            say(f"{task}: {len(part)} episodes in {time.perf_counter() - start:.0f} s")
    rows = [row for row in read_rows(path, steps) if row["number"] < episodes]
    result = report(rows)
    files.write_text(options.out / "soak.json", json.dumps(result, indent=2) + "\n")
    files.write_text(options.out / "soak.md", markdown(result))
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        print(markdown(result))
        print(json.dumps(result["worst"], indent=2))
    return 0 if all(check["passed"] for check in result["checks"]) else 1


if __name__ == "__main__":
    sys.exit(main())
