"""Force statistics of an episode; docs/forces.md defines them."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cathsim_dmc.physics.forces import NAMES
from cathsim_dmc.recording.episode import Episode


@dataclass(frozen=True)
class Statistics:
    """Statistics of one force over the control steps of an episode, N.

    Attributes:
        mean: Mean over all control steps; steps without contact count as 0.
        mean_in_contact: Mean over the steps in which the force is not zero; None if
            there are none.
        maximum: Largest value of any step.
    """

    mean: float
    mean_in_contact: float | None
    maximum: float


@dataclass(frozen=True)
class EpisodeForces:
    """Force of the device on the wall over an episode, N.

    A quantity is None if the environment or the recording does not have it.

    Attributes:
        sum: Sum of the magnitudes over all contacts at the end of a control step.
        max: Largest single contact at the end of a control step; one place of the wall
            may be two contacts.
        peak_sum: Largest sum in any physics step of a control step; it depends on the
            physics step (`physics.forces.PEAK_NOTE`).
        peak_max: Largest single contact in any physics step of a control step; it
            depends on the physics step too.
        mean_sum: Sum over all contacts, mean over a control step: the reading of a load
            cell at 25 Hz.
        mean_max: Largest single contact, mean over a control step.
    """

    sum: Statistics | None = None
    max: Statistics | None = None
    peak_sum: Statistics | None = None
    peak_max: Statistics | None = None
    mean_sum: Statistics | None = None
    mean_max: Statistics | None = None

    # Files from before 0.3 lack the means over a control step; the first three
    # properties then use the values at its end.

    @property
    def mean_force(self) -> float | None:
        """`mean_sum`, mean over all control steps, N."""
        force = self.mean_sum or self.sum
        return force and force.mean

    @property
    def mean_contact_force(self) -> float | None:
        """`mean_max`, mean over the control steps with contact, N."""
        force = self.mean_max or self.max
        return force and force.mean_in_contact

    @property
    def max_force(self) -> float | None:
        """`mean_max` of the control step where it is largest, N."""
        force = self.mean_max or self.max
        return force and force.maximum

    @property
    def largest_sum(self) -> float | None:
        """`mean_sum` of the control step where it is largest, N.

        It decides *safe success*. Files from before 0.3 have `peak_sum` instead, which
        is never less.
        """
        force = self.mean_sum or self.peak_sum
        return force and force.maximum

    @property
    def peak_force(self) -> float | None:
        """Largest single contact in any physics step, N; see `PEAK_NOTE`."""
        return self.peak_max and self.peak_max.maximum


STATISTICS = tuple(field.name for field in dataclasses.fields(Statistics))
QUANTITIES = tuple(field.name for field in dataclasses.fields(EpisodeForces))
# Properties of `EpisodeForces`.
FIGURES = ("mean_force", "mean_contact_force", "max_force", "largest_sum", "peak_force")


class ForceTracker:
    """Forces of the running episodes of N simulations, step by step."""

    def __init__(self, num_simulations: int):
        """Starts N episodes."""
        self._steps: list[list[np.ndarray]] = [[] for _ in range(num_simulations)]

    def add(self, forces: Sequence[np.ndarray], failed: np.ndarray) -> None:
        """Add a control step.

        Args:
            forces: One array (N,), N, for each of `QUANTITIES`, in order.
            failed: (N,) bool, where the physics failed, whose forces do not count.
        """
        rows = np.array(forces, dtype=np.float64).T
        for steps, row, lost in zip(self._steps, rows, failed, strict=True):
            if not lost:
                steps.append(row)

    def finish(self, simulation: int) -> EpisodeForces:
        """Ends the episode of a simulation; its statistics are None without a step."""
        steps, self._steps[simulation] = self._steps[simulation], []
        columns = zip(QUANTITIES, np.transpose(steps), strict=False)
        return EpisodeForces(**{name: _statistics(column) for name, column in columns})


def _statistics(row: Sequence[float] | np.ndarray) -> Statistics | None:
    values = np.asarray(row, dtype=np.float64)
    if np.isnan(values).any():
        return None
    touching = values[values > 0]
    in_contact = float(touching.mean()) if len(touching) else None
    return Statistics(float(values.mean()), in_contact, float(values.max()))


def recorded_forces(episode: Episode) -> EpisodeForces:
    """Statistics of a recorded episode; all None without a step."""
    if not episode.steps:
        return EpisodeForces()
    columns = episode.wall_force_sum, episode.wall_force_max
    columns += tuple(map(episode.meta.get, NAMES[2:]))
    found = {
        name: None if column is None else _statistics(column)
        for name, column in zip(QUANTITIES, columns, strict=False)
    }
    return EpisodeForces(**found)


def millinewtons(mean: float | None, deviation: float | None = None) -> str:
    """Text, in mN with three digits, of a force and its deviation given in N."""
    if mean is None:
        return "–"
    size = 1e3 * max(abs(mean), abs(deviation or 0.0))
    digits = 0 if size >= 100 else 1 if size >= 10 else 2
    text = f"{1e3 * mean:.{digits}f}"
    return text if deviation is None else f"{text} ± {1e3 * deviation:.{digits}f}"
