"""Result of a control step of N simulations."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cathsim_dmc.physics import forces, readings
from cathsim_dmc.physics.vessel import INFO, VesselReadings
from cathsim_dmc.tasks import objectives
from cathsim_dmc.tasks.observation_kind import Observation

_INFO = ("distance", "insertion", "push_force", *forces.NAMES, "path_ratio")


def info_types(terms: Sequence[str], living: bool = False) -> dict[str, type]:
    """Type of each figure of `Step.info`, float or bool.

    Args:
        terms: Names of the terms of the reward.
        living: Whether there are figures of the vessel.
    """
    numbers = *_INFO, *(INFO if living else ()), *(f"reward_{name}" for name in terms)
    switches = "success", "failed", "physics_error"
    return {**dict.fromkeys(numbers, float), **dict.fromkeys(switches, bool)}


class Step(NamedTuple):
    """State of N simulations after a control step, or at the start of an episode.

    Attributes:
        observation: arrays (N, ...), which may share memory with the readings; a batch
            returns copies of both.
        outcome: reward, success and reward terms, arrays (N,); the reward is 0 and
            there is no success where the physics failed.
        terminated: (N,) bool, success, a physics error, given up (option `give_up`), or
            failed by the objective (`Outcome.failed`).
        truncated: (N,) bool, out of time.
        errors: N reasons, None where the physics went well.
        readings: state of the devices.
        wall_force: force on the wall over the control step.
        distance: (N,), straight from head to goal, m.
        path_ratio: (N,), length of the head's path so far over the length of the route
            from the start to the goal.
        vessel: state of the vessel; None for a rigid one with blood at rest.
    """

    observation: Observation
    outcome: objectives.Outcome
    terminated: np.ndarray
    truncated: np.ndarray
    errors: tuple[str | None, ...]
    readings: readings.Readings
    wall_force: forces.WallForce
    distance: np.ndarray
    path_ratio: np.ndarray
    vessel: VesselReadings | None = None

    @property
    def physics_error(self) -> np.ndarray:
        """(N,) bool, whether the physics failed."""
        return np.array([error is not None for error in self.errors])

    @property
    def failed(self) -> np.ndarray:
        """(N,) bool, whether the objective has ended the episode without success."""
        success, fails = self.outcome.success, self.outcome.failed
        ends = np.zeros_like(success) if fails is None else fails & ~success
        return ends & ~self.physics_error

    def info(self) -> dict[str, np.ndarray]:
        """Figures beside the observation, arrays (N,): for logs and wrappers.

        "distance" and "insertion" in m; "push_force" in N; "wall_force_sum",
        "wall_force_max" and their means and peaks within the control step in N (see
        `forces.WallForce`); "path_ratio"; of a living vessel "heart_phase",
        "breath_phase", "blood_speed" (at the head, m/s), "indentation" (m) and
        "wall_work" (J); "reward_<term>" for each weighted term; and "success", "failed"
        (by the objective) and "physics_error" (bool).
        """
        return {
            "distance": self.distance,
            "insertion": self.readings.insertion,
            "push_force": self.readings.push_force,
            **self.wall_force.named(),
            "path_ratio": self.path_ratio,
            **({} if self.vessel is None else self.vessel.info()),
            **{f"reward_{name}": term for name, term in self.outcome.terms.items()},
            "success": self.outcome.success,
            "failed": self.failed,
            "physics_error": self.physics_error,
        }
