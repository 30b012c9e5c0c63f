"""State of the simulations, for policies that do not act on observations."""

from dm_control import composer

from cathsim_dmc.physics.forces import WallForce
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.cases import Case
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
    def _rollout(self) -> Rollout:
        rollout = self._stepped.rollout
        assert rollout is not None  # an environment has compiled its model
        return rollout

    def case(self, index: int) -> Case:
        """Scene and objective of the episode of one simulation."""
        return self._rollout.case(index)

    @property
    def readings(self) -> Readings:
        """State of the devices; every array has the leading axis N."""
        return self._rollout.readings

    @property
    def resting(self) -> Readings:
        """The same, with all places where they are in the vessel at rest."""
        return self._rollout.resting

    @property
    def wall_force(self) -> WallForce:
        """Force on the wall over the last control step; arrays (N,), N."""
        return self._rollout.wall_force

    @property
    def devices(self) -> CoaxialReadings | None:
        """State of coaxial devices, arrays (N, ...); None for one device alone."""
        return self._rollout.devices
