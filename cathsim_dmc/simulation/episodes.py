"""The loop of an episode, for demonstrations, recordings and measurements."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import dm_env
import numpy as np

from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.snapshot import Snapshot
from cathsim_dmc.tasks.step import Step


class Turn(NamedTuple):
    """A control step of N simulations.

    Attributes:
        action: Actions (N, A); None at the start.
        state: State after the step.
        running: (N,) bool, the simulations whose first episode has this step. The
            caller clears an entry to end that episode early.
    """

    action: np.ndarray | None
    state: Step
    running: np.ndarray


def play(
    simulation: BatchSimulation,
    choose: Callable[[Any], np.ndarray],
    begin: Callable[[np.ndarray], None],
) -> Iterator[Turn]:
    """Play an episode in each of N simulations, side by side.

    Simulations whose episode has ended begin another one, which does not count, until
    all have ended.

    Args:
        choose: Function from the observations, arrays (N, ...) by name, to the actions.
        begin: Function that is called with a mask (N,) of simulations that have begun
            an episode.

    Yields:
        The start, then every control step.
    """
    running = np.ones(simulation.num_simulations, dtype=bool)
    begun, step = running.copy(), simulation.reset()
    yield Turn(None, step, running)
    while running.any():
        if begun.any():
            begin(begun)
        action = choose(step.observation)
        step = simulation.step(np.asarray(action, dtype=np.float64))
        before = running.copy()
        yield Turn(action, step, running)
        ended = step.terminated | step.truncated
        begun = ended | (before & ~running)
        running &= ~ended
        if begun.any() and running.any():
            step = simulation.reset(np.flatnonzero(begun))


def play_alone(
    environment: Any,
    choose: Callable[[dm_env.TimeStep], np.ndarray],
    start: Snapshot | None = None,
) -> Iterator[tuple[np.ndarray | None, dm_env.TimeStep]]:
    """Play an episode of a composer environment.

    Args:
        choose: Function from the present time step to the action. It may raise
            StopIteration to end the episode.
        start: Snapshot of a running episode, which is continued; None for a reset.

    Yields:
        The start, with None, then the action and time step of every control step.
    """
    timestep = environment.reset() if start is None else environment.restore(start)
    yield None, timestep
    while not timestep.last():
        try:
            action = choose(timestep)
        except StopIteration:
            return
        timestep = environment.step(action)
        yield action, timestep
