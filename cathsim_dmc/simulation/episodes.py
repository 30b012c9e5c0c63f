"""The loop of an episode: evaluations, recordings and measurements play with it."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import dm_env
import numpy as np
from dm_control import composer

from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.step import Step


class ComposerSimulation:
    """A composer environment, as `play` steps it; its state is the time step.

    Attributes:
        seen: What chooses the next action sees this: the present time step.
    """

    seen: dm_env.TimeStep

    def __init__(self, environment: composer.Environment):
        self._environment = environment

    def reset(self, which: np.ndarray | None) -> dm_env.TimeStep:
        """Begin an episode; the state."""
        self.seen = self._environment.reset()
        return self.seen

    def step(self, action: np.ndarray) -> tuple[dm_env.TimeStep, np.ndarray]:
        """Advance by a control step; the state, and (1,) bool whether it ends."""
        self.seen = self._environment.step(action)
        return self.seen, np.array([self.seen.last()])


class BatchedSimulations:
    """The N simulations of a batch, as `play` steps them; their state is a `Step`.

    Attributes:
        seen: Present observation, arrays (N, ...) by name.
    """

    def __init__(self, simulation: BatchSimulation):
        self._simulation = simulation
        self.seen: Any = None

    def reset(self, which: np.ndarray | None) -> Step:
        """Begin episodes in the simulations of a mask (N,), None for all."""
        step = self._simulation.reset(None if which is None else np.flatnonzero(which))
        self.seen = step.observation
        return step

    def step(self, action: np.ndarray) -> tuple[Step, np.ndarray]:
        """Advance by a control step; the state, and (N,) bool whether episodes end."""
        step = self._simulation.step(np.asarray(action, dtype=np.float64))
        self.seen = step.observation
        return step, step.terminated | step.truncated


class Turn(NamedTuple):
    """A control step of N simulations.

    Attributes:
        action: Actions; None at the start.
        state: State after it, of the kind of the simulations.
        running: (N,) bool, the simulations whose first episode has this step. Entries
            that are cleared end an episode early.
    """

    action: np.ndarray | None
    state: Any
    running: np.ndarray


def play(
    simulations: Any,
    choose: Callable[[Any], np.ndarray],
    begin: Callable[[np.ndarray], None] = lambda which: None,
    count: int = 1,
) -> Iterator[Turn]:
    """Play an episode in each of N simulations, side by side.

    Simulations whose episode has ended begin another one, which does not count, until
    all have ended.

    Args:
        simulations: `ComposerSimulation`, `BatchedSimulations`, or another class with
            their attribute and methods.
        choose: Function from what is seen to the actions. It may raise StopIteration
            to end all episodes.
        begin: Function that is called with a mask (N,) of simulations that have begun
            an episode.
        count: N.

    Yields:
        The start, then every control step.
    """
    running = np.ones(count, dtype=bool)
    begun = running.copy()
    yield Turn(None, simulations.reset(None), running)
    while running.any():
        if begun.any():
            begin(begun)
        try:
            action = choose(simulations.seen)
        except StopIteration:
            return
        state, ended = simulations.step(action)
        before = running.copy()
        yield Turn(action, state, running)
        begun = ended | (before & ~running)
        running &= ~ended
        if begun.any() and running.any():
            simulations.reset(begun)
