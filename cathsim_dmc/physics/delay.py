"""The way of a command to the drives, which takes some control steps."""

import numpy as np

from cathsim_dmc.physics.effects import Effect, Episode, World
from cathsim_dmc.physics.readings import Readings


class ActionDelay(Effect):
    """Actions take effect as many control steps later as was drawn."""

    def __init__(self, longest: int):
        """Bounds the delay, control steps."""
        self._longest = longest

    def bind(self, world: World) -> None:
        """Starts without delay."""
        num_actions = len(world.chain.action_names)
        self._past = np.zeros((world.num_simulations, self._longest + 1, num_actions))
        self._delay = np.zeros(world.num_simulations, dtype=int)

    def restart(
        self, index: int, episode: Episode, random_state: np.random.RandomState
    ) -> None:
        """Begins an episode of one simulation, with drives at rest."""
        self._past[index] = 0.0
        self._delay[index] = episode.delay

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Takes the action (N, A) of this step, returns the one that takes effect."""
        if not self._longest:
            return action
        self._past[:, 1:] = self._past[:, :-1]
        self._past[:, 0] = action
        return self._past[np.arange(len(self._delay)), self._delay]

    @property
    def state(self) -> dict[str, np.ndarray]:
        """Actions on their way, the last one first, and delays."""
        return {"past": self._past, "delay": self._delay} if self._longest else {}
