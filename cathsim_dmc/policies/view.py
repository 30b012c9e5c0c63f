"""What a policy may know beyond the observation: the simulations themselves.

One face for many simulations side by side and for a composer environment, so that a
policy that looks at positions and forces needs no second version of itself.
"""

from __future__ import annotations

from typing import Protocol, TypeVar

import numpy as np
from dm_control import composer

from cathsim_dmc.physics import forces
from cathsim_dmc.physics.readings import Readings
from cathsim_dmc.physics.sliding import CoaxialReadings
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.navigation import Navigation

State = TypeVar("State", Readings, forces.WallForce, CoaxialReadings)


class View(Protocol):
    """N simulations of one task.

    Attributes:
        num_simulations: N.
        num_actions: Number A of entries of an action.
        task: The task that all of them run.
        readings: State of the devices; every array has the leading axis N.
        wall_force: Force on the wall over the last control step, likewise.
        devices: State of coaxial devices, likewise; None for one device alone.
    """

    num_simulations: int
    num_actions: int

    @property
    def task(self) -> Navigation:
        """The task that all simulations run."""
        ...

    def case(self, index: int) -> Case:
        """Scene and objective of the episode of one simulation."""
        ...

    @property
    def readings(self) -> Readings:
        """State of the devices; every array has the leading axis N."""
        ...

    @property
    def wall_force(self) -> forces.WallForce:
        """Force on the wall over the last control step; arrays (N,), N."""
        ...

    @property
    def devices(self) -> CoaxialReadings | None:
        """State of coaxial devices, arrays (N, ...); None for one device alone."""
        ...


class BatchedView:
    """The simulations of a batch."""

    def __init__(self, simulation: BatchSimulation):
        self._simulation = simulation
        self.num_simulations = simulation.num_simulations
        self.num_actions = simulation.num_actions

    @property
    def task(self) -> Navigation:
        """The task that all simulations run."""
        return self._simulation.task

    def case(self, index: int) -> Case:
        """Scene and objective of the episode of one simulation."""
        return self._simulation.rollout.case(index)

    @property
    def readings(self) -> Readings:
        """State of the devices; every array has the leading axis N."""
        return self._simulation.readings

    @property
    def wall_force(self) -> forces.WallForce:
        """Force on the wall over the last control step; arrays (N,), N."""
        return self._simulation.wall_force

    @property
    def devices(self) -> CoaxialReadings | None:
        """State of coaxial devices, arrays (N, ...); None for one device alone."""
        return self._simulation.rollout.devices


class ComposerView:
    """A composer environment, one simulation."""

    num_simulations = 1

    def __init__(self, environment: composer.Environment):
        self._environment = environment
        self.num_actions = int(environment.action_spec().shape[0])

    @property
    def task(self) -> Navigation:
        """The task that the simulation runs."""
        return self._environment.task

    def case(self, index: int) -> Case:
        """Scene and objective of the episode."""
        return self._environment.task.rollout.case()

    @property
    def readings(self) -> Readings:
        """State of the devices; every array has the leading axis 1."""
        return _batch(self.task.readings)

    @property
    def wall_force(self) -> forces.WallForce:
        """Force on the wall over the last control step; arrays (1,), N."""
        return _batch(self.task.wall_force)

    @property
    def devices(self) -> CoaxialReadings | None:
        """State of coaxial devices, arrays (1, ...); None for one device alone."""
        devices = self.task.devices
        return None if devices is None else _batch(devices)


def _batch(state: State) -> State:
    """A tuple of arrays (...,) as one of arrays (1, ...)."""
    return type(state)(*(np.stack([value]) for value in state))
