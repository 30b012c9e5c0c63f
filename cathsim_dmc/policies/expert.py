"""A scripted expert that steers along the centreline to the goal.

Its success shows that a task can be solved, and is compared with that of trained
agents. `pursuit` has its decisions, `coaxial_pursuit` those for coaxial devices.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from cathsim_dmc.physics.readings import merged, part
from cathsim_dmc.policies.attempts import State
from cathsim_dmc.policies.coaxial_pursuit import CoaxialPlan, CoaxialSettings
from cathsim_dmc.policies.policy import Policy, View
from cathsim_dmc.policies.pursuit import Plan
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.route import locate


class _Plans:
    """What is known of the anatomies of N simulations."""

    def __init__(self, view: View):
        self.view = view
        self._plans: dict[Case, Plan | CoaxialPlan] = {}

    def chosen(self) -> Iterator[tuple[Any, np.ndarray, tuple[Any, ...]]]:
        """Plans, the numbers (K,) of their simulations, and what is read of these."""
        rollout = self.view.rollout
        cases = [rollout.case(i) for i in range(self.view.num_simulations)]
        state = rollout.resting, rollout.wall_force, rollout.devices
        for case in dict.fromkeys(cases):
            if case not in self._plans:
                kind = CoaxialPlan if case.scene.catheter.coaxial else Plan
                self._plans[case] = kind.for_case(case)
            rows = np.array([i for i, one in enumerate(cases) if one is case])
            yield self._plans[case], rows, tuple(part(one, rows) for one in state)


class ExpertPolicy(Policy):
    """The expert as a policy; it reads the simulations, not the observation.

    Attributes:
        state: What is remembered of the simulations, arrays (N, ...).
    """

    name = "expert"
    # Cheapest to observe.
    observation = "tracking"
    state: State

    def __init__(self, seed: int = 0):
        """Starts before the first episode; the expert draws no random numbers."""
        self._plans: _Plans | None = None

    def reset(self, view: View, which: np.ndarray) -> None:
        """Forget simulations that begin an episode; ValueError if it cannot steer."""
        begins = self._plans is None or self._plans.view is not view
        if self._plans is None or begins:
            self._plans = _Plans(view)
        for plan, _, _ in self._plans.chosen():
            self._plan, fresh = plan, plan.fresh((view.num_simulations,))
        old = fresh if begins else self.state
        self.state = merged(old, part(fresh, which), which)

    def act(self, observation: Any) -> np.ndarray:
        """Actions (N, A) for the state of the devices."""
        if self._plans is None:
            raise RuntimeError("the expert must be reset before it acts")
        view = self._plans.view
        action = np.empty((view.num_simulations, view.num_actions))
        for plan, rows, seen in self._plans.chosen():
            state = part(self.state, rows)
            action[rows], state = plan.decide(plan.settings, state, *seen)
            self.state = merged(self.state, state, rows)
        return action

    def follow(self, action: np.ndarray) -> None:
        """Replace the last actions by those carried out, (N, A) in [-1, 1]."""
        self.state = self._plan.told(self.state, action)


class Teacher:
    """The expert as a teacher: its action in states that another policy reaches.

    The expert remembers its commands to a steerable tip, to which every correction
    adds, and its retries. Neither fits the state that another policy has reached, and a
    learner does not observe retries. The teacher therefore takes the action that was
    carried out for its own and judges every state by itself: it withdraws outside the
    tube of the route and advances inside it. Coaxial devices keep one lead and one
    look-ahead. All follows from the observation if that has the last action.
    """

    def __init__(self, view: View, lead: float = 0.02):
        """Looks at simulations; `reset` comes before the first question.

        Args:
            lead: of a guidewire ahead of the catheter around it, m. With 0.02 it
                reaches the left common carotid of Type I without retries; the
                brachiocephalic artery of Type II takes -0.02, the catheter first.
        """
        self._plans = _Plans(view)
        self._insertion = np.full(view.num_simulations, np.nan)
        # A longer look-ahead than the expert's needs no retry.
        self._coaxial = CoaxialSettings(
            leads=(lead,), offsets=(0.0,), lookahead_factors=(1.4,)
        )

    def reset(self, which: np.ndarray) -> None:
        """Forgets the simulations, (N,) bool, that begin a new episode."""
        self._insertion[which] = np.nan

    def act(self, last_action: np.ndarray) -> np.ndarray:
        """The expert's action in every state; to be asked once in a control step.

        Args:
            last_action: (N, A) in [-1, 1], carried out in the control step before;
                zeros at the start of an episode.

        Returns:
            (N, A) in [-1, 1].

        Raises:
            ValueError: the task's device can neither be steered nor turned.
        """
        action = np.empty(last_action.shape)
        for plan, rows, (readings, force, devices) in self._plans.chosen():
            coaxial = isinstance(plan, CoaxialPlan)
            settings = self._coaxial if coaxial else plan.settings
            state = plan.fresh((len(rows),))._replace(
                retracting=locate(plan, readings.head).excess > settings.tolerance,
                turn=np.full(len(rows), np.inf),
                held=readings.insertion,
                insertion=self._insertion[rows],
            )
            state = plan.told(state, last_action[rows])
            decided = plan.decide(settings, state, readings, force, devices)
            action[rows], self._insertion[rows] = decided[0], readings.insertion
        return action
