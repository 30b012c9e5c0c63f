"""Policies that ignore the observation: baselines, stress tests of the simulator."""

from typing import Any

import numpy as np

from cathsim_dmc.policies.policy import Policy, View


class _Scripted(Policy):
    """Repeats an action; simulation i draws from a generator with the seed + i."""

    def __init__(self, seed: int = 0):
        self._seed = seed
        self._generators: list[np.random.Generator] = []
        self._action = np.zeros((0, 0))

    def reset(self, view: View, which: np.ndarray) -> None:
        """Make the generators and the actions (N, A) at the first reset."""
        shape = view.num_simulations, view.num_actions
        if self._action.shape != shape:
            seeds = range(self._seed, self._seed + shape[0])
            self._generators = [np.random.default_rng(seed) for seed in seeds]
            self._action = np.zeros(shape)

    def among(self, first: int, count: int) -> Policy:
        """Return a copy whose generators have the seeds of its simulations."""
        return type(self)(self._seed + first)

    def act(self, observation: Any) -> np.ndarray:
        self._require_reset()
        return self._action.copy()  # noise on it must not stay

    def _require_reset(self) -> None:
        if not self._generators:
            raise RuntimeError(f"the policy {self.name!r} must be reset before it acts")


class Random(_Scripted):
    """Uniform actions in [-1, 1], from a generator for each simulation."""

    name = "random"

    def act(self, observation: Any) -> np.ndarray:
        """Actions (N, A), independent of the observation."""
        self._require_reset()
        size = self._action.shape[1]
        return np.stack([g.uniform(-1, 1, size) for g in self._generators])


class RandomCurl(_Scripted):
    """Full push with a constant bend of the tip, drawn for each episode.

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


class _Constant(_Scripted):
    """The same action in every control step."""

    push = bend = 0.0

    def reset(self, view: View, which: np.ndarray) -> None:
        """Set the entries of the action that push and that bend the tip about x."""
        super().reset(view, which)
        catheter = view.task.scene.catheter
        self._action[:, catheter.translations] = self.push
        self._action[:, 0 : len(catheter.tip_motors) : 2] = self.bend


class Idle(_Constant):
    """No push, tip motors at rest."""

    name = "idle"


class Push(_Constant):
    """Full push, tip motors at rest."""

    name = "push"
    push = 1.0


class Curl(_Constant):
    """Full push, the tip bent as far as it goes: the device jams."""

    name = "curl"
    push = bend = 1.0
