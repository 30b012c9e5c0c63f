"""A scripted expert that steers along the centreline to the goal.

It proves the tasks solvable and is a yardstick for trained agents. What it decides is
in `pursuit`; here it meets the simulations.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from cathsim_dmc.policies.policy import Policy
from cathsim_dmc.policies.pursuit import Plan, Settings, State, decide
from cathsim_dmc.policies.view import View
from cathsim_dmc.tasks import forces, navigation
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.objective_pool import part
from cathsim_dmc.tasks.readings import Readings


class Expert:
    """The expert at work on one task; remembers where each simulation stands."""

    def __init__(self, plan: Plan, settings: Settings | None = None):
        """Starts without any memory; see `for_task`."""
        self._plan = plan
        self._settings = settings or Settings()
        self._state: State | None = None

    @classmethod
    def for_task(
        cls, task: navigation.Navigation, settings: Settings | None = None
    ) -> Expert:
        """The expert for a task.

        Raises:
            ValueError: if the task's device cannot be steered.
        """
        return cls(Plan.for_task(task), settings)

    @property
    def plan(self) -> Plan:
        """What is known of the task."""
        return self._plan

    @property
    def state(self) -> State | None:
        """What is remembered; None before the first action."""
        return self._state

    def reset(self, which: np.ndarray | None = None) -> None:
        """Forgets the simulations that begin a new episode.

        Args:
            which: Mask or indices of the simulations, None for all.
        """
        if which is None or self._state is None:
            self._state = None
            return
        shape = self._state.insertion.shape
        fresh = State.fresh(shape, len(self._plan.tip))
        for field in dataclasses.fields(State):
            getattr(self._state, field.name)[which] = getattr(fresh, field.name)[which]

    def act(self, readings: Readings, wall_force: forces.WallForce) -> np.ndarray:
        """Action (..., A) in [-1, 1] for the state of the devices.

        Raises:
            ValueError: if the leading axes changed since the last call without reset.
        """
        shape = readings.head.shape[:-1]
        if self._state is None:
            self._state = State.fresh(shape, len(self._plan.tip))
        if self._state.insertion.shape != shape:
            raise ValueError(
                f"the readings have leading axes {shape}, those before had "
                f"{self._state.insertion.shape}; call reset() in between"
            )
        action, self._state = decide(
            self._plan, self._settings, self._state, readings, wall_force
        )
        return action

    def follow(self, action: np.ndarray) -> None:
        """Takes what was carried out, (..., A) in [-1, 1], for its own last action."""
        if self._state is None:
            return
        told = action[..., : self._plan.tip.size] * self._plan.steering_angle
        bend = told.reshape(self._state.bend.shape)
        self._state = dataclasses.replace(self._state, bend=bend)


class Experts:
    """An expert for each simulation, where their anatomies differ."""

    def __init__(self, view: View, settings: Settings | None = None):
        """Starts without knowing any simulation: `reset` comes first."""
        self._view = view
        self._settings = settings
        self._plans: dict[Case, Plan] = {}
        # By simulation, from its first reset on.
        self._experts: dict[int, Expert] = {}

    def reset(self, which: np.ndarray | None = None) -> None:
        """Looks at the anatomies of the simulations that begin a new episode.

        Args:
            which: Mask or indices of the simulations, None for all.
        """
        numbers = np.arange(self._view.num_simulations)
        chosen = numbers if which is None else numbers[which]
        for index in chosen.tolist():
            case = self._view.case(index)
            if case not in self._plans:
                self._plans[case] = Plan.for_task(case)
            self._experts[index] = Expert(self._plans[case], self._settings)

    def act(self, readings: Readings, wall_force: forces.WallForce) -> np.ndarray:
        """Action (N, A) in [-1, 1] for the state of the devices."""
        rows = [np.array([index]) for index in range(self._view.num_simulations)]
        actions = [
            self._experts[index].act(part(readings, row), part(wall_force, row))
            for index, row in enumerate(rows)
        ]
        return np.concatenate(actions)

    def follow(self, action: np.ndarray) -> None:
        """Takes what was carried out, (N, A) in [-1, 1], for their last actions."""
        for index, expert in self._experts.items():
            expert.follow(action[[index]])


class ExpertPolicy(Policy):
    """The expert as a policy; it looks at the simulations, not at the observation."""

    name = "expert"
    # Cheapest to observe.
    observation = "tracking"

    def __init__(self, seed: int = 0, settings: Settings | None = None):
        """Takes a seed as all policies do, and draws nothing from it.

        Args:
            seed: Seed, not used.
            settings: Settings of its driving.
        """
        self._settings = settings
        self._expert: Expert | Experts | None = None
        self._view: View | None = None

    def reset(self, view: View, which: np.ndarray) -> None:
        """Forget the simulations that begin a new episode.

        Raises:
            ValueError: the task's device cannot be steered.
        """
        if self._expert is None or self._view is not view:
            self._view = view
            several = view.task.num_anatomies > 1
            self._expert = (
                Experts(view, self._settings)
                if several
                else Expert.for_task(view.task, self._settings)
            )
        self._expert.reset(which)

    def act(self, observation: Any) -> np.ndarray:
        """Actions (N, A) for the state of the devices."""
        if self._expert is None or self._view is None:
            raise RuntimeError("the expert must be reset before it acts")
        return self._expert.act(self._view.readings, self._view.wall_force)

    def follow(self, action: np.ndarray) -> None:
        """Takes what was carried out in place of its last actions for its own.

        Args:
            action: (N, A) in [-1, 1].
        """
        if self._expert is not None:
            self._expert.follow(action)
