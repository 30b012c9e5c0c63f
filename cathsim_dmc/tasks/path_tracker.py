"""How far the heads have gone, and how much of it was detour."""

import numpy as np

from cathsim_dmc.tasks.objectives import straight


class PathTracker:
    """Paths of the heads of N simulations in their episodes."""

    def __init__(self, num_simulations: int):
        """Starts with all heads at rest."""
        self._head = np.zeros((num_simulations, 3))
        self._length = np.zeros(num_simulations)
        self._shortest = np.ones(num_simulations)

    def restart(
        self, indices: np.ndarray, head: np.ndarray, shortest: np.ndarray
    ) -> None:
        """Begins episodes of some simulations.

        Args:
          indices: (K,) numbers of the simulations.
          head: (N, 3), heads of all simulations, m.
          shortest: (N,), shortest ways from there to the goals, m.
        """
        # New arrays: those handed out before stay what they were.
        self._head = self._head.copy()
        self._head[indices] = head[indices]
        self._length = self._length.copy()
        self._length[indices] = 0.0
        self._shortest = self._shortest.copy()
        self._shortest[indices] = shortest[indices]

    def add(self, head: np.ndarray) -> None:
        """Adds the ways to the heads (N, 3), m."""
        self._length = self._length + straight(self._head, head)
        self._head = head

    @property
    def ratio(self) -> np.ndarray:
        """(N,), length of each path over the shortest way from start to goal."""
        return self._length / self._shortest
