"""A scripted expert that steers along the centreline to the goal.

Its success shows that a task can be solved, and is compared with that of trained
agents. `pursuit` has its decisions, `coaxial_pursuit` those for coaxial devices.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from cathsim_dmc.physics.readings import Readings, merged, part
from cathsim_dmc.policies.attempts import AttemptSettings, State
from cathsim_dmc.policies.coaxial_pursuit import CoaxialPlan, CoaxialSettings
from cathsim_dmc.policies.policy import Policy, View
from cathsim_dmc.policies.pursuit import Plan
from cathsim_dmc.tasks import retry
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.retry import Memory
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

    @property
    def memory(self) -> Memory:
        """Memory of the attempts, which the task keeps."""
        return self.view.rollout.memory


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
        old, _ = fresh if begins else self.state, self._plans.memory
        self.state = merged(old, part(fresh, which), which)

    def act(self, observation: Any) -> np.ndarray:
        """Actions (N, A) for the state of the devices."""
        if self._plans is None:
            raise RuntimeError("the expert must be reset before it acts")
        view = self._plans.view
        action = np.empty((view.num_simulations, view.num_actions))
        for plan, rows, (readings, force, devices) in self._plans.chosen():
            own, memory = part(self.state, rows), part(self._plans.memory, rows)
            decided = plan.decide(plan.settings, own, memory, readings, force, devices)
            action[rows], state = decided
            self.state = merged(self.state, state, rows)
        return action

    def follow(self, action: np.ndarray) -> None:
        """Replace the last actions by those carried out, (N, A) in [-1, 1]."""
        self.state = self._plan.told(self.state, action)


class Teacher:
    """The expert as a teacher: its action in states that another policy reaches.

    The expert remembers its commands to a steerable tip, to which every correction
    adds; the teacher takes the action that was carried out for its own. Where the
    learner observes the memory of the attempts, the teacher decides by it. Otherwise it
    judges every state by itself: it withdraws outside the tube of the route and
    advances inside it, and coaxial devices keep one lead and one look-ahead. All
    follows from the observation if that has the last action.
    """

    def __init__(self, view: View, lead: float = 0.02):
        """Looks at simulations; `reset` comes before the first question.

        Args:
            lead: of a guidewire ahead of the catheter around it where the learner does
                not observe the memory, m. With 0.02 it reaches the left common carotid
                of Type I without retries; the brachiocephalic artery of Type II takes
                -0.02, the catheter first.
        """
        self._plans = _Plans(view)
        self._last = np.full((2, view.num_simulations), np.nan)
        # A longer look-ahead than the expert's needs no retry: with 1.4 a pair stops
        # short of the left common carotid, with 1.8 to 2.4 it reaches it.
        pattern = retry.Pattern(lookahead_factors=(2.0,), leads=(lead,))
        one = dataclasses.replace(retry.COAXIAL, pattern=pattern)
        self._one_lead = CoaxialSettings(retry=one)

    def reset(self, which: np.ndarray) -> None:
        """Forgets the simulations, (N,) bool, that begin a new episode."""
        self._last[:, which] = np.nan

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
        remembers = self._plans.view.rollout.progress.shown
        for plan, rows, (readings, force, devices) in self._plans.chosen():
            settings, state = plan.settings, plan.fresh((len(rows),))
            arc_length, insertion = self._last[:, rows]
            state = state._replace(arc_length=arc_length, insertion=insertion)
            state = plan.told(state, last_action[rows])
            if remembers:
                memory = part(self._plans.memory, rows)
            else:
                settings = self._one_lead if isinstance(plan, CoaxialPlan) else settings
                memory = _of_the_moment(plan, settings, readings)
            action[rows], state = plan.decide(
                settings, state, memory, readings, force, devices
            )
            self._last[:, rows] = state.arc_length, state.insertion
        return action


def _of_the_moment(
    plan: Plan | CoaxialPlan, settings: AttemptSettings, readings: Readings
) -> Memory:
    """A memory that follows from the present state alone."""
    place = locate(plan, readings.head)
    memory = Memory.at(place, readings.insertion)
    outside = place.excess > settings.retry.tolerance
    return memory._replace(
        retracting=outside, stale=np.where(outside, settings.straightening, 0)
    )
