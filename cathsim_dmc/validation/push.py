"""Whether a device that is only pushed ends up in a branch."""

from __future__ import annotations

import dataclasses

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.anatomy import Anatomy, Goal
from cathsim_dmc.entities.chain import MAX_PUSH_SPEED

# A push that has gone on for so long a way of the base, m, beside that to the goal,
# has missed.
_SPARE = 0.08


@dataclasses.dataclass(frozen=True)
class Push:
    """One straight push.

    Attributes:
        success: whether the task called it a cannulation.
        steps: control steps until then, or until it was given up.
        mean_force: sum of the contact forces on the wall, mean over the steps, N.
        peak_force: largest single contact force, N.
    """

    success: bool
    steps: int
    mean_force: float
    peak_force: float


def straight_push(anatomy: Anatomy, goal: str | Goal, seed: int = 0, **options) -> Push:
    """Pushes the device at full speed without steering it.

    Args:
        anatomy: where.
        goal: of the anatomy.
        seed: of the start of the episode.
        **options: of the task, fields of `tasks.navigation.NavigationConfig`.
    """
    environment = suite.load(
        suite.DOMAIN,
        "navigate",
        task_kwargs={"anatomy": anatomy, "goal": goal, "random": seed, **options},
    )
    try:
        return _push(environment, anatomy.route(goal).length)
    finally:
        environment.close()


def _push(environment, way: float) -> Push:
    action = np.zeros(environment.action_spec().shape)
    task = environment.task
    action[list(task.scene.catheter.translations)] = 1.0
    longest = round((way + _SPARE) / (MAX_PUSH_SPEED * task.control_timestep))
    timestep = environment.reset()
    sums, peak, steps = [], 0.0, 0
    while not timestep.last() and steps < longest:
        timestep = environment.step(action)
        steps += 1
        sums.append(float(task.wall_force.sum))
        peak = max(peak, float(task.wall_force.peak_max))
    return Push(task.termination == "success", steps, float(np.mean(sums)), peak)
