"""What was measured after a control step, kept for observations and snapshots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.physics.forces import WallForce
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.physics.vessel import VesselReadings
from cathsim_dmc.tasks.objective_pool import part
from cathsim_dmc.tasks.objectives import straight
from cathsim_dmc.tasks.snapshot import Snapshot, merged, named


class Measured(NamedTuple):
    """What was measured of N simulations, arrays (N, ...).

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

    def rows(self, indices: np.ndarray) -> dict[str, Any]:
        """What is of some simulations, by the names of the fields."""
        return part(self, indices)._asdict()

    def updated(self, kept: Mapping[str, Any], indices: np.ndarray) -> Measured:
        """The same with `kept`, as from `rows`, of some simulations."""
        values: dict[str, Any] = {
            name: None if old is None else merged(old, kept[name], indices)
            for name, old in self._asdict().items()
        }
        return Measured(**values)

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays by name, for a snapshot."""
        return {
            name: array
            for kind, values in self._asdict().items()
            if values is not None
            for name, array in named(kind, values._asdict()).items()
        }

    def restored(self, snapshot: Snapshot, indices: np.ndarray) -> Measured:
        """The same with some simulations as in a snapshot of them."""
        kept = {
            kind: None if old is None else type(old)(**snapshot.part(kind))
            for kind, old in self._asdict().items()
        }
        return self.updated(kept, indices)


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

    def to(self, head: np.ndarray) -> Path:
        """The paths longer by the ways to heads (N, 3), m."""
        return Path(head, self.length + straight(self.head, head), self.shortest)

    @property
    def ratio(self) -> np.ndarray:
        """(N,), length of each path over the shortest way from start to goal."""
        return self.length / self.shortest
