"""Definitions of the forces of an episode.

Four quantities of a control step, three statistics of each over an episode, and four
named figures, which evaluations, results and cards report. docs/forces.md explains
them and relates them to the published figures.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cathsim_dmc.recording.episode import Episode


@dataclass(frozen=True)
class Statistics:
    """One force of the control steps of an episode in three numbers, N.

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

    None where the environment or the recording does not tell.

    Attributes:
        sum: Of the sum of the magnitudes over all contacts at the end of a control
            step.
        max: Of the largest single contact at the end of a control step.
        peak_sum: Of the largest sum in any physics step of a control step.
        peak_max: Of the largest single contact in any physics step of a control step.
    """

    sum: Statistics | None = None
    max: Statistics | None = None
    peak_sum: Statistics | None = None
    peak_max: Statistics | None = None

    @property
    def mean_force(self) -> float | None:
        """Sum over all contacts, mean over all control steps, N."""
        return self.sum and self.sum.mean

    @property
    def mean_contact_force(self) -> float | None:
        """Largest single contact, mean over the control steps with contact, N."""
        return self.max and self.max.mean_in_contact

    @property
    def max_force(self) -> float | None:
        """Largest single contact at the end of any control step, N."""
        return self.max and self.max.maximum

    @property
    def peak_force(self) -> float | None:
        """Largest single contact in any physics step, N."""
        return self.peak_max and self.peak_max.maximum


QUANTITIES = tuple(field.name for field in dataclasses.fields(EpisodeForces))
# Properties of `EpisodeForces`.
FIGURES = ("mean_force", "mean_contact_force", "max_force", "peak_force")


class ForceTracker:
    """Statistics of the running episodes of N simulations, step by step."""

    def __init__(self, num_simulations: int):
        """Starts N episodes.

        Args:
            num_simulations: N.
        """
        self._steps = np.zeros(num_simulations, dtype=np.int64)
        shape = (len(QUANTITIES), num_simulations)
        self._known = np.zeros(shape, dtype=bool)
        self._total = np.zeros(shape)
        self._contacts = np.zeros(shape, dtype=np.int64)
        self._largest = np.zeros(shape)

    def add(self, forces: Mapping[str, np.ndarray | None]) -> None:
        """Add a control step.

        Args:
            forces: Values (N,) in N by their names in `QUANTITIES`; None or left out
                where they are not known.
        """
        self._steps += 1
        for index, name in enumerate(QUANTITIES):
            values = forces.get(name)
            if values is None:
                continue
            self._known[index] = True
            self._total[index] += values
            self._contacts[index] += values > 0
            np.maximum(self._largest[index], values, out=self._largest[index])

    def finish(self, simulation: int) -> EpisodeForces:
        """Statistics of a simulation's episode, which ends; the next one begins."""
        found = {}
        for index, name in enumerate(QUANTITIES):
            if self._known[index, simulation]:
                total = self._total[index, simulation]
                contacts = self._contacts[index, simulation]
                found[name] = Statistics(
                    mean=float(total / self._steps[simulation]),
                    mean_in_contact=float(total / contacts) if contacts else None,
                    maximum=float(self._largest[index, simulation]),
                )
        self._steps[simulation] = 0
        for table in (self._known, self._total, self._contacts, self._largest):
            table[:, simulation] = 0
        return EpisodeForces(**found)


def recorded_forces(episode: Episode) -> EpisodeForces:
    """Statistics of a recorded episode; empty without a single step."""
    columns = {
        "sum": episode.wall_force_sum,
        "max": episode.wall_force_max,
        "peak_sum": episode.meta.get("wall_force_peak_sum"),
        "peak_max": episode.meta.get("wall_force_peak_max"),
    }
    known = {
        name: np.asarray(values, dtype=np.float64)
        for name, values in columns.items()
        if values is not None
    }
    if not episode.steps:
        return EpisodeForces()
    tracker = ForceTracker(1)
    for step in range(episode.steps):
        tracker.add({name: values[step : step + 1] for name, values in known.items()})
    return tracker.finish(0)


def millinewtons(mean: float | None, deviation: float | None = None) -> str:
    """Text of a force given in N, in mN with three digits and its deviation alike."""
    if mean is None:
        return "–"
    size = 1e3 * max(abs(mean), abs(deviation or 0.0))
    digits = 0 if size >= 100 else 1 if size >= 10 else 2
    text = f"{1e3 * mean:.{digits}f}"
    return text if deviation is None else f"{text} ± {1e3 * deviation:.{digits}f}"
