"""State of the simulations, for policies that do not act on observations."""

from dm_control import composer

from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.rollout import Rollout


class View:
    """N simulations of one task: those of a batch, or a composer environment.

    Attributes:
        num_simulations: N.
        num_actions: Number A of entries of an action.
        task: The task that all of them run.
    """

    def __init__(self, simulations: BatchSimulation | composer.Environment):
        """Takes simulations; they need no episode yet."""
        batched = isinstance(simulations, BatchSimulation)
        self.task = simulations.task
        self.num_simulations = simulations.num_simulations if batched else 1
        self.num_actions: int = self.task.num_actions
        self._stepped = simulations if batched else self.task

    @property
    def rollout(self) -> Rollout:
        """What is measured of them; arrays (N, ...), see `tasks.rollout.Rollout`."""
        return self._stepped.rollout
