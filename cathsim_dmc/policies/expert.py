"""A scripted expert that steers along the centreline to the goal.

Its success shows that a task can be solved, and is compared with that of trained
agents. `pursuit` has its decisions, `coaxial_pursuit` those for coaxial devices.
"""

import dataclasses
from typing import Any

import numpy as np

from cathsim_dmc.physics import forces
from cathsim_dmc.physics.readings import CoaxialReadings, Readings
from cathsim_dmc.policies.attempts import Attempts
from cathsim_dmc.policies.coaxial_pursuit import CoaxialPlan
from cathsim_dmc.policies.policy import Policy
from cathsim_dmc.policies.pursuit import Plan, Settings
from cathsim_dmc.policies.view import View
from cathsim_dmc.tasks import navigation
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.objective_pool import part


class Expert:
    """The expert on one task; remembers the attempt of each simulation.

    Attributes:
        plan: What is known of the task.
        state: What is remembered; None before the first action.
    """

    def __init__(self, plan: Plan | CoaxialPlan, settings: Settings | None = None):
        """Starts before the first episode; `for_task` makes the plan.

        Args:
            plan: Of a steerable device, or of coaxial devices.
            settings: Of the same kind; None for the defaults.
        """
        self.plan: Any = plan
        self._settings = settings or plan.settings()
        self.state: Attempts | None = None

    @classmethod
    def for_task(
        cls, task: navigation.Navigation | Case, settings: Settings | None = None
    ) -> "Expert":
        """The expert for a task, or for one of the anatomies that episodes draw from.

        Args:
            settings: Settings of its driving; those of coaxial devices are
                `coaxial_pursuit.CoaxialSettings`.

        Raises:
            ValueError: if the device can neither be steered nor turned at its base, or
                the settings are not for it.
        """
        kind = CoaxialPlan if task.scene.coaxial else Plan
        if settings is not None and not isinstance(settings, kind.settings):
            raise ValueError(
                "these settings are of a steerable device's expert; coaxial devices "
                "need coaxial_pursuit.CoaxialSettings"
            )
        return cls(kind.for_task(task), settings)

    def reset(self, which: np.ndarray | None = None) -> None:
        """Forgets the simulations that begin a new episode.

        Args:
            which: Mask or indices of the simulations, None for all.
        """
        if which is None or self.state is None:
            self.state = None
            return
        fresh = self.plan.fresh(self.state.attempts.shape)
        for field in dataclasses.fields(fresh):
            getattr(self.state, field.name)[which] = getattr(fresh, field.name)[which]

    def act(
        self,
        readings: Readings,
        wall_force: forces.WallForce,
        devices: CoaxialReadings | None = None,
    ) -> np.ndarray:
        """Action (..., A) in [-1, 1]; ValueError if the leading axes changed."""
        shape = readings.head.shape[:-1]
        state = self.plan.fresh(shape) if self.state is None else self.state
        if state.attempts.shape != shape:
            raise ValueError(
                f"the readings have leading axes {shape}, those before had "
                f"{state.attempts.shape}; call reset() in between"
            )
        action, self.state = self.plan.decide(
            self._settings, state, readings, wall_force, devices
        )
        return action

    def follow(self, action: np.ndarray) -> None:
        """Replace the last action by the one (..., A) that was carried out."""
        if self.state is not None:
            self.state = self.plan.told(self.state, action)


class ExpertPolicy(Policy):
    """The expert as a policy; it reads the simulations, not the observation."""

    name = "expert"
    # Cheapest to observe.
    observation = "tracking"

    def __init__(self, seed: int = 0):
        """Starts before the first episode.

        Args:
            seed: Not used: the expert draws no random numbers.
        """
        self._view: View | None = None
        # One for all simulations; where their anatomies differ, one for each.
        self._experts: dict[int, Expert] = {}
        self._cases: dict[int, Case] = {}
        self._several = False

    def reset(self, view: View, which: np.ndarray) -> None:
        """Forget simulations that begin an episode; ValueError if it cannot steer."""
        if self._view is not view:
            self._view, self._experts, self._cases = view, {}, {}
            self._several = view.task.num_anatomies > 1
        if not self._several:
            if not self._experts:
                self._experts[0] = Expert.for_task(view.task)
            self._experts[0].reset(which)
            return
        for index in np.flatnonzero(which).tolist():
            case = view.case(index)
            if self._cases.get(index) is not case:
                self._cases[index] = case
                self._experts[index] = Expert.for_task(case)
            self._experts[index].reset()

    def act(self, observation: Any) -> np.ndarray:
        """Actions (N, A) for the state of the devices."""
        view = self._view
        if view is None:
            raise RuntimeError("the expert must be reset before it acts")
        readings, wall_force, devices = view.resting, view.wall_force, view.devices
        if not self._several:
            return self._experts[0].act(readings, wall_force, devices)
        actions = []
        for index in range(view.num_simulations):
            row = np.array([index])
            own = None if devices is None else part(devices, row)
            state = part(readings, row), part(wall_force, row), own
            actions.append(self._experts[index].act(*state))
        return np.concatenate(actions)

    def follow(self, action: np.ndarray) -> None:
        """Replace the last actions by those that were carried out.

        Args:
            action: (N, A) in [-1, 1].
        """
        for index, expert in self._experts.items():
            expert.follow(action[[index]] if self._several else action)
