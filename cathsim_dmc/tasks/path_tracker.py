"""How far the heads have gone, and how much of it was detour."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cathsim_dmc.tasks.objectives import straight


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
