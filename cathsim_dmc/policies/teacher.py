"""The expert as a teacher: its actions in states that another policy reaches.

The expert remembers its commands to a steerable tip, to which every correction adds,
and its retries. Neither fits the state that another policy has reached, and a learner
does not observe retries. The teacher therefore takes the action that was carried out
for its own and judges every state by itself: it withdraws outside the tube of the route
and advances inside it. Coaxial devices keep one lead and one look-ahead. All follows
from the observation if that has the last action.
"""

import dataclasses
from typing import Any

import numpy as np

from cathsim_dmc.policies.coaxial_pursuit import CoaxialPlan, CoaxialSettings
from cathsim_dmc.policies.expert import Expert
from cathsim_dmc.policies.pursuit import Plan, Settings
from cathsim_dmc.policies.view import View
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.objective_pool import part
from cathsim_dmc.tasks.route import locate


class Teacher:
    """Tells the expert's action in the states of N simulations."""

    def __init__(self, view: View, lead: float = 0.02):
        """Looks at simulations; `reset` comes before the first question.

        Args:
            lead: of a guidewire ahead of the catheter around it, m. With 0.02 it
                reaches the left common carotid of Type I without retries; the
                brachiocephalic artery of Type II takes -0.02, the catheter first.
        """
        self._view = view
        # A longer look-ahead than the expert's needs no retry.
        self._coaxial = CoaxialSettings(
            leads=(lead,), offsets=(0.0,), lookahead_factors=(1.4,)
        )
        self._plans: dict[Case, Plan | CoaxialPlan] = {}
        self._cases: list[Case | None] = [None] * view.num_simulations
        self._insertion = np.full(view.num_simulations, np.nan)

    def reset(self, which: np.ndarray) -> None:
        """Looks at the anatomies of the simulations that begin a new episode.

        Args:
            which: (N,) bool.

        Raises:
            ValueError: the task's device can neither be steered nor turned.
        """
        for index in np.flatnonzero(which).tolist():
            case = self._view.case(index)
            if case not in self._plans:
                self._plans[case] = Expert.for_task(case).plan
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
        action = np.empty((self._view.num_simulations, self._view.num_actions))
        for case, plan in self._plans.items():
            rows = np.array([i for i, one in enumerate(self._cases) if one is case])
            if len(rows):
                action[rows] = self._decided(plan, rows, last_action[rows])
        self._insertion = np.array(self._view.resting.insertion)
        return action

    def _decided(
        self, plan: Plan | CoaxialPlan, rows: np.ndarray, last_action: np.ndarray
    ) -> np.ndarray:
        """Actions of the simulations (rows,) that share a plan."""
        view, shape = self._view, (len(rows),)
        readings, force = part(view.resting, rows), part(view.wall_force, rows)
        coaxial = isinstance(plan, CoaxialPlan)
        settings: Any = self._coaxial if coaxial else Settings()
        state: Any = dataclasses.replace(
            plan.fresh(shape),
            retracting=locate(plan, readings.head).excess > settings.tolerance,
            turn=np.full(shape, np.inf),
            held=np.array(readings.insertion),
        )
        state = plan.told(state, last_action)
        if isinstance(plan, Plan):
            state = dataclasses.replace(state, insertion=self._insertion[rows])
        devices = part(view.devices, rows)
        return plan.decide(settings, state, readings, force, devices)[0]
