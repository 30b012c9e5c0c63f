"""A scripted expert that steers along the centreline to the goal.

Its success shows that a task can be solved, and is the reference for trained agents.
`pursuit` computes the actions for a steerable device, `coaxial_pursuit` those for
coaxial devices.
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
    """Plans for the anatomies of N simulations, made when first needed."""

    def __init__(self, view: View):
        self.view = view
        self._plans: dict[Case, Plan | CoaxialPlan] = {}

    def chosen(self) -> Iterator[tuple[Any, np.ndarray, tuple[Any, ...]]]:
        """Yields each plan, the indices (K,) of its simulations and their readings."""
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
        state: State of the expert in the simulations, arrays (N, ...).
    """

    name = "expert"
    # Cheapest to observe.
    observation = "tracking"
    state: State

    def __init__(self, seed: int = 0):
        """Starts before the first episode; the expert draws no random numbers."""
        self._plans: _Plans | None = None

    def reset(self, view: View, which: np.ndarray) -> None:
        """Resets the state of simulations; ValueError if a device cannot be steered."""
        begins = self._plans is None or self._plans.view is not view
        if self._plans is None or begins:
            self._plans = _Plans(view)
        for plan, _, _ in self._plans.chosen():
            self._plan, fresh = plan, plan.fresh((view.num_simulations,))
        old, _ = fresh if begins else self.state, self._plans.memory
        self.state = merged(old, part(fresh, which), which)

    def act(self, observation: Any) -> np.ndarray:
        """Returns the actions (N, A) in [-1, 1]; the observation is not used."""
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
        """Replaces the last actions by the applied ones, (N, A) in [-1, 1]."""
        self.state = self._plan.told(self.state, action)


class Teacher:
    """The expert as a teacher: its action in states that another policy reaches.

    Every correction adds to the last command of a steerable tip, so the teacher takes
    the applied action as its last command. If the learner observes the memory of the
    attempts, the teacher decides by that memory. Otherwise it decides by the present
    state alone: it withdraws outside the tube of the route and advances inside it, and
    coaxial devices keep one lead and one look-ahead. Its action then depends only on
    the observation, if that includes the last action.
    """

    def __init__(self, view: View, lead: float = 0.02):
        """Takes a view of simulations; call `reset` before the first `act`.

        Args:
            lead: lead of a guidewire over the catheter around it if the learner does
                not observe the memory, m. With 0.02 it reaches the left common carotid
                of Type I without retries; the brachiocephalic artery of Type II needs
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
        """Resets the simulations `which`, (N,) bool, that begin a new episode."""
        self._last[:, which] = np.nan

    def act(self, last_action: np.ndarray) -> np.ndarray:
        """Returns the expert's actions; call it once per control step.

        Args:
            last_action: (N, A) in [-1, 1], applied in the control step before; zeros at
                the start of an episode.

        Returns:
            (N, A) in [-1, 1].

        Raises:
            ValueError: the task's single device has no motors in its tip.
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
    """Returns a memory of the attempts derived from the present state alone."""
    place = locate(plan, readings.head)
    memory = Memory.at(place, readings.insertion)
    outside = place.excess > settings.retry.tolerance
    return memory._replace(
        retracting=outside, stale=np.where(outside, settings.straightening, 0)
    )
