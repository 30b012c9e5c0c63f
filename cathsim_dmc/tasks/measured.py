"""Measurements after a control step."""

from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.physics.forces import WallForce
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.physics.vessel import VesselReadings
from cathsim_dmc.tasks.objective_pool import part
from cathsim_dmc.tasks.objectives import straight


class Measured(NamedTuple):
    """Measurements of N simulations, arrays (N, ...).

    Attributes:
        readings: State of the devices.
        wall_force: Force on the wall over the control step.
        devices: State of coaxial devices; None for one alone.
        vessel: State of the vessels; None for rigid ones with blood at rest.
    """

    readings: Readings
    wall_force: WallForce
    devices: CoaxialReadings | None
    vessel: VesselReadings | None

    def updated(self, new: "Measured", rows: np.ndarray) -> "Measured":
        """The same with some simulations as in `new`."""
        pairs = zip(self, part(new, rows), strict=True)
        return Measured._make(old and merged(old, kept, rows) for old, kept in pairs)


class Path(NamedTuple):
    """Paths of the heads of N simulations in their episodes.

    Attributes:
        head: (N, 3), m.
        length: (N,), m, of the paths so far.
        shortest: (N,), m, shortest ways from the starts to the goals.
    """

    head: np.ndarray
    length: np.ndarray
    shortest: np.ndarray

    def to(self, head: np.ndarray) -> "Path":
        """The paths longer by the ways to heads (N, 3), m."""
        return Path(head, self.length + straight(self.head, head), self.shortest)

    @property
    def ratio(self) -> np.ndarray:
        """(N,), length of each path over the shortest way from start to goal."""
        return self.length / self.shortest


def merged(old: Any, new: Any, rows: np.ndarray) -> Any:
    """A named tuple of arrays (N, ...) with `new` in some rows; `old` stays."""
    values = []
    for before, now in zip(old, new, strict=True):
        array = before.copy()
        array[rows] = now
        values.append(array)
    return type(old)._make(values)
