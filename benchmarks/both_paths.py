"""Episodes of a policy in the batch, each repeated as a composer environment.

    python benchmarks/both_paths.py --task femoral_type1_lcca_pair
    python benchmarks/both_paths.py --task type1_lcca --policy random --steps 200

The conditions of an episode are those of the varied protocol. Observation, reward,
termination, positions, velocities and wall force must be bitwise equal in every control
step.
"""

import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

# torchrl must be imported before dm_control.
from cathsim_dmc.agents import protocols  # isort: skip

import numpy as np
import tyro

from cathsim_dmc import policies, suite
from cathsim_dmc.analysis.intervals import success_interval
from cathsim_dmc.cli.options import say, show
from cathsim_dmc.simulation import episodes
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.config import EVALUATION_SEED
from cathsim_dmc.validation.checks import Check, Report

OBSERVED = ("internal", "tracking", "force")


class Row(NamedTuple):
    """An episode of both paths; `differs` is the first step that does, or None."""

    seed: int
    success: bool
    steps: int
    force: float  # largest sum of the wall force, N
    differs: int | None


class Play:
    """First episodes of a batch.

    Attributes:
        actions: actions (T, A) of each episode.
        states: by episode, the arrays of every step that are compared.
        success: whether each episode reached its goal.
        force: largest sum of the wall force in each episode, N.
    """

    def __init__(
        self,
        name: str,
        policy: str,
        seeds: Sequence[int],
        options: dict[str, Any],
        steps: int | None,
        threads: int,
    ):
        task = suite.make_task(name, observation=OBSERVED, **options)
        batch = BatchSimulation(
            task, len(seeds), seeds=list(seeds), num_threads=threads
        )
        player = policies.make_policy(policy, seeds[0])
        view = policies.View(batch)
        self.actions = [[] for _ in seeds]
        self.states = [[] for _ in seeds]
        self.success = np.zeros(len(seeds), bool)
        self.force = np.zeros(len(seeds))
        turns = episodes.play(
            batch, player.act, lambda which: player.reset(view, which)
        )
        for number, (action, step, running) in enumerate(turns):
            for i in np.flatnonzero(running):
                if action is not None:
                    self.actions[i].append(np.array(action[i], np.float64))
                    self.success[i] |= step.outcome.success[i]
                    self.force[i] = max(self.force[i], step.wall_force.mean_sum[i])
                self.states[i].append(
                    [np.array(v[i]) for _, v in sorted(step.observation.items())]
                    + [batch.batch.qpos[i].copy(), batch.batch.qvel[i].copy()]
                    + ([] if action is None else outcome_of_batch(step, i))
                )
            if number == steps:
                break


def outcome_of_batch(step: Any, index: int) -> list[np.ndarray]:
    """Reward, termination, end and wall force of one simulation."""
    ended = step.terminated[index], step.terminated[index] or step.truncated[index]
    force = step.wall_force
    return [
        np.array([step.outcome.reward[index], *ended]),
        np.array([each[index] for each in force]),
    ]


def first_difference(
    name: str, seed: int, options: dict[str, Any], actions: list, states: list
) -> int | None:
    """First control step that differs in a composer environment; None if none does."""
    task = suite.make_task(name, observation=OBSERVED, random=seed, **options)
    environment = suite.environment(task)
    seen = environment.reset()
    for number, state in enumerate(states):
        if number:
            seen = environment.step(actions[number - 1])
        data = environment.physics.data
        own = [np.array(v) for _, v in sorted(seen.observation.items())]
        own += [data.qpos.copy(), data.qvel.copy()]
        if number:
            force = environment.task.wall_force
            own.append(np.array([seen.reward, seen.discount == 0, seen.last()]))
            own.append(np.array(force))
        if any(not np.array_equal(*both) for both in zip(own, state, strict=True)):
            return number
    return None


def main(
    task: str,
    policy: str = "expert",
    seeds: int = 30,
    seed: int = EVALUATION_SEED,
    steps: int | None = None,
    threads: int = 0,
    json: bool = False,
) -> int:
    """Play episodes in the batch, and each again as a composer environment.

    Args:
        task: Task of `cathsim list`.
        policy: Name of a policy.
        seeds: Number of episodes, each with conditions of its own.
        seed: The seeds lie at or above it.
        steps: Control steps after which episodes are cut off.
        threads: Number of threads of the batch, 0 for one per core.
        json: Whether to print one JSON object and nothing else.
    """
    protocol = protocols.get("varied")
    rows = []
    for part in protocols.parts(protocol, task, {}, seeds, seed):
        options = dict(part.task_kwargs)
        one = Play(task, policy, part.seeds, options, steps, threads)
        say(f"{one.success.sum()} of {len(part.seeds)} succeed")
        for i, own in enumerate(part.seeds):
            differs = first_difference(
                task, own, options, one.actions[i], one.states[i]
            )
            success, force = bool(one.success[i]), float(one.force[i])
            rows.append(Row(own, success, len(one.actions[i]), force, differs))
            say(" ".join(map(str, rows[-1])))
    success = sum(row.success for row in rows)
    different = sum(row.differs is not None for row in rows)
    low, high = success_interval(success, len(rows))
    label = f"{task}, {policy}: episodes that differ between batch and environment"
    checks = [Check.at_most(label, different, 0, "", f"of {len(rows)}")]
    findings = {
        "episodes": len(rows),
        "successes": success,
        "success_ci95": [low, high],
        "safe at 0.5 N": sum(row.success and row.force <= 0.5 for row in rows),
        "control steps, mean": float(np.mean([row.steps for row in rows])),
        "control steps, longest": max(row.steps for row in rows),
        "control steps compared": sum(row.steps for row in rows),
        "largest sum, N": max(row.force for row in rows),
        "failed seeds": [row.seed for row in rows if not row.success],
    }
    return show(Report("both paths", checks, findings), json)


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
