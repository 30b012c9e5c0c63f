"""The expert as a teacher: its actions in states that another policy reaches.

The expert remembers its commands to the tip, to which every correction adds, and its
retries. Neither fits the state that another policy has reached, and a learner does not
observe retries. The teacher therefore takes the action that was carried out for its
own and judges every state by itself: it withdraws outside the tube of the route and
advances inside it. Both follow from the observation if that has the last action.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from cathsim_dmc.policies.pursuit import Plan, Settings, State, decide, locate
from cathsim_dmc.policies.view import View
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.objective_pool import part


class Teacher:
    """Tells the expert's action in the states of N simulations."""

    def __init__(self, view: View):
        """Looks at simulations; `reset` comes before the first question."""
        self._view = view
        self._settings = Settings()
        self._plans: dict[Case, Plan] = {}
        self._cases: list[Case | None] = [None] * view.num_simulations
        self._insertion = np.full(view.num_simulations, np.nan)

    def reset(self, which: np.ndarray) -> None:
        """Looks at the anatomies of the simulations that begin a new episode.

        Args:
            which: (N,) bool.

        Raises:
            ValueError: the task's device cannot be steered.
        """
        for index in np.flatnonzero(which).tolist():
            case = self._view.case(index)
            if case not in self._plans:
                self._plans[case] = Plan.for_task(case)
            self._cases[index] = case
        self._insertion[which] = np.nan

    def act(self, last_action: np.ndarray) -> np.ndarray:
        """The expert's action in every state; to be asked once in a control step.

        Args:
            last_action: (N, A) in [-1, 1], carried out in the control step before;
                zeros at the start of an episode.

        Returns:
            (N, A) in [-1, 1].
        """
        readings, wall_force = self._view.resting, self._view.wall_force
        action = np.empty((self._view.num_simulations, self._view.num_actions))
        for case, plan in self._plans.items():
            rows = np.array([i for i, one in enumerate(self._cases) if one is case])
            if not len(rows):
                continue
            mine = part(readings, rows)
            fresh = State.fresh((len(rows),), len(plan.tip))
            told = last_action[rows, : plan.tip.size] * plan.steering_angle
            outside = locate(plan, mine.head).excess > self._settings.tolerance
            state = dataclasses.replace(
                fresh,
                bend=told.reshape(fresh.bend.shape),
                insertion=self._insertion[rows],
                retracting=outside,
                turn=np.full(len(rows), np.inf),
            )
            action[rows], _ = decide(
                plan, self._settings, state, mine, part(wall_force, rows)
            )
        self._insertion = np.array(readings.insertion)
        return action
