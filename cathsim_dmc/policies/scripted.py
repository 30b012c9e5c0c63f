"""Policies that ignore the observation: baselines of agents, loads of the simulator."""

from __future__ import annotations

from typing import Any

import numpy as np

from cathsim_dmc.policies.policy import Policy
from cathsim_dmc.policies.view import View


class _Drawn(Policy):
    """Draws simulation i's actions from seed + i, on from episode to episode."""

    def __init__(self, seed: int = 0):
        self._seed = seed
        self._generators: list[np.random.Generator] = []
        self._action = np.zeros((0, 0))

    def reset(self, view: View, which: np.ndarray) -> None:
        """Make the generators with the first episodes."""
        count = view.num_simulations
        if len(self._generators) != count:
            seeds = range(self._seed, self._seed + count)
            self._generators = [np.random.default_rng(seed) for seed in seeds]
            self._action = np.zeros((count, view.num_actions))


class Random(_Drawn):
    """Uniform actions in [-1, 1], from a generator for each simulation."""

    name = "random"

    def act(self, observation: Any) -> np.ndarray:
        """Actions (N, A), whatever is observed."""
        size = self._action.shape[1]
        return np.stack([g.uniform(-1, 1, size) for g in self._generators])


class RandomCurl(_Drawn):
    """Full push, the tip bent all the way in one direction drawn for each episode.

    Every x hinge of the tip gets the same command and every y hinge the same: a point
    drawn uniformly by angle and by distance in the unit circle.
    """

    name = "random_curl"

    def reset(self, view: View, which: np.ndarray) -> None:
        """Draw the curls of the simulations that begin a new episode."""
        super().reset(view, which)
        catheter = view.task.scene.catheter
        motors = len(catheter.tip_motors)
        self._action = self._action.copy()
        for index in np.flatnonzero(which):
            draw = self._generators[index]
            angle, size = draw.uniform(0.0, 2.0 * np.pi), draw.uniform()
            self._action[index, 0:motors:2] = size * np.cos(angle)
            self._action[index, 1:motors:2] = size * np.sin(angle)
            self._action[index, catheter.translations] = 1.0

    def act(self, observation: Any) -> np.ndarray:
        """Actions (N, A), whatever is observed."""
        return self._action


class _Constant(Policy):
    """The same action in every step."""

    def __init__(self, seed: int = 0):
        """Starts; `seed` is not used."""
        self._action = np.zeros((0, 0))

    def reset(self, view: View, which: np.ndarray) -> None:
        """Look up what the entries of an action are."""
        self._action = np.zeros((view.num_simulations, view.num_actions))
        self._fill(self._action, view)

    def _fill(self, action: np.ndarray, view: View) -> None:
        """Write the action (N, A), which is zero."""

    def act(self, observation: Any) -> np.ndarray:
        """Actions (N, A), whatever is observed."""
        return self._action


class Idle(_Constant):
    """No push, tip motors at rest."""

    name = "idle"


class Push(_Constant):
    """Full push, tip motors at rest."""

    name = "push"

    def _fill(self, action: np.ndarray, view: View) -> None:
        action[:, view.task.scene.catheter.translations] = 1.0


class Curl(_Constant):
    """Full push, the tip bent as far as it goes: the device jams."""

    name = "curl"

    def _fill(self, action: np.ndarray, view: View) -> None:
        catheter = view.task.scene.catheter
        action[:, 0 : len(catheter.tip_motors) : 2] = 1.0
        action[:, catheter.translations] = 1.0
