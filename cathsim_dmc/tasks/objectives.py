"""Objectives of tasks: success and reward."""

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Anatomy, Centreline, Goal
from cathsim_dmc.anatomy.geodesic import LumenDistance
from cathsim_dmc.json_options import Constant
from cathsim_dmc.physics import forces, readings

_NOTHING = np.zeros(())
GOAL_RADIUS = 8e-3  # m, δ of the published task
_FARTHEST = 1.0  # m; a larger δ is taken for one given in millimetres
GENTLE = 0.1  # N, sum of all contacts above which a push counts as hard
# Weights of the published reward: minus the distance in metres, or 10 at success.
PUBLISHED_REWARD: Mapping[str, float] = Constant(distance=-1.0, success=10.0)


class Measurement(NamedTuple):
    """Measurement of a control step, which an objective judges; SI, world frame.

    Attributes:
        readings: state of the devices, arrays with the leading axes `...`.
        wall_force: force on the wall over the control step, arrays (...).
        action: (..., A), action of this control step in [-1, 1].
        previous_action: (..., A), action of the control step before, zeros after a
            reset.
        distance: (...), straight from the head to the goal of the objective, m.
    """

    readings: readings.Readings
    wall_force: forces.WallForce
    action: np.ndarray
    previous_action: np.ndarray
    distance: np.ndarray


class Outcome(NamedTuple):
    """Judgement of a control step; arrays have the leading axes of the measurement.

    Attributes:
        reward: (...) float64, the sum of the terms.
        success: (...) bool, which ends the episode.
        terms: name to weighted reward term (...).
        failed: (...) bool, which ends the episode without success, such as a limit of
            force that is exceeded; None for never. Success takes precedence.
    """

    reward: np.ndarray
    success: np.ndarray
    terms: Mapping[str, np.ndarray]
    failed: np.ndarray | None = None


def straight(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Euclidean distances (...) between points (..., 3), m."""
    way = end - start
    return np.sqrt(np.vecdot(way, way))


class Objective(Protocol):
    """Success and reward of a navigation task; pure functions of arrays.

    Arrays have a leading axis of length N; N is 1 in a composer environment.

    Attributes:
        goal: (3,), or (N, 3) where it differs between simulations, m, world frame.
        goal_radius: distance from the goal that counts as reached, m.
        terms: names of the reward terms of every outcome.

    An objective whose goal can be shifted derives from `Shiftable`, one with a route
    from `Routed`.
    """

    @property
    def goal(self) -> np.ndarray: ...  # noqa: D102

    @property
    def goal_radius(self) -> float: ...  # noqa: D102

    @property
    def terms(self) -> Sequence[str]: ...  # noqa: D102

    def outcome(self, measurement: Measurement) -> Outcome:
        """Judges a control step."""
        ...

    def path_distance(self, head: np.ndarray) -> np.ndarray:
        """Length (...) of the route from heads (..., 3) at the start to the goal, m."""
        ...


class Shiftable(abc.ABC):
    """An objective with a goal that randomisation can shift along its branch."""

    @abc.abstractmethod
    def shifted(self, shift: np.ndarray) -> Objective:
        """The same objective with the goal moved by `shift` () or (N,), m."""


class Routed:
    """An objective with a route, for the observation `route` and for the expert.

    Attributes:
        route: centreline from the inlet to the goal.
    """

    route: Centreline


@dataclasses.dataclass(frozen=True, eq=False)
class Cannulation(Shiftable, Routed):
    """Bring the head of the device into a branch.

    Success: the head is within `goal_radius` of the goal and inside the lumen of the
    branch, past its ostium. The reward is the sum of the weighted `TERMS` and of
    "success". At success the terms of `UNTIL_SUCCESS` are 0: with the published
    weights the reward is minus the distance before success and 10 at success.

    Attributes:
        goal: (3,) or, if it differs between simulations, (N, 3), m, world frame.
        branch: centreline of the whole target branch.
        ostium: arc length at which the branch leaves its parent's lumen, m.
        route: centreline from the inlet to the goal.
        goal_radius: δ, m.
        weights: reward term to its weight; terms without one are not computed.
        goal_arc_length: () or (N,), of the goal on the route, m; None for the route's
            end.
        lumen: shortest paths in the lumen to the end of the route, so that the term
            `path` holds for goals on the route alone; None without this term.
    """

    goal: np.ndarray
    branch: Centreline
    ostium: float
    route: Centreline
    goal_radius: float = GOAL_RADIUS
    weights: Mapping[str, float] = dataclasses.field(
        default_factory=lambda: PUBLISHED_REWARD
    )
    goal_arc_length: np.ndarray | None = None
    lumen: LumenDistance | None = None

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the reward terms with a weight."""
        return tuple(self.weights)

    # Reward terms before weighting: arrays (...) of an objective and a measurement. A
    # subclass adds terms of its own.
    TERMS: ClassVar[
        Mapping[str, Callable[["Cannulation", Measurement], np.ndarray]]
    ] = MappingProxyType(
        {
            # Straight from head to goal, m.
            "distance": lambda self, m: m.distance,
            # Shortest way from head to goal inside the lumen, m.
            "path": lambda self, m: self.lumen_distance(m.readings.head),
            # Sum of all contacts on the wall, mean over the control step, N.
            "force": lambda self, m: m.wall_force.mean_sum,
            # Largest single contact, mean over the control step, N.
            "contact_force": lambda self, m: m.wall_force.mean_max,
            # Largest single contact in any physics step of the control step, N; it
            # depends on the physics step, see `forces.PEAK_NOTE`.
            "peak_force": lambda self, m: m.wall_force.peak_max,
            # By how much "force" exceeds `GENTLE`, N.
            "excess_force": lambda self, m: np.maximum(
                m.wall_force.mean_sum - GENTLE, 0.0
            ),
            # 1 for each control step.
            "time": lambda self, m: np.ones_like(m.readings.insertion),
            # Mean square of the change of the action.
            "smoothness": lambda self, m: np.square(m.action - m.previous_action).mean(
                -1
            ),
        }
    )
    UNTIL_SUCCESS: ClassVar[frozenset[str]] = frozenset({"distance", "path"})

    def __post_init__(self):
        bounds.number(
            "goal_radius", self.goal_radius, 0.0, _FARTHEST, "m", positive=True
        )
        known = (*self.TERMS, "success")
        if not bounds.mapping("reward", self.weights, known):
            bounds.refuse("reward", self.weights, f"some of {', '.join(known)}")
        weights = {n: bounds.number(f"reward {n}", w) for n, w in self.weights.items()}
        object.__setattr__(self, "weights", Constant(weights))

    @classmethod
    def to(
        cls,
        anatomy: Anatomy,
        goal: Goal,
        *,
        reward: Mapping[str, float] = PUBLISHED_REWARD,
        goal_radius: float | None = None,
        farthest_shift: float = 0.0,
    ) -> "Cannulation":
        """The objective of reaching a goal of an anatomy.

        Args:
            goal: Goal in the lumen of one of its vessels.
            reward: Weights of the reward terms.
            goal_radius: Distance from the goal that counts as reached, m; by default 8
                mm, less in a short branch.
            farthest_shift: Largest shift of the goal away from the ostium, m.
        """
        bounds.instance("anatomy", anatomy, Anatomy).check_goal(goal)
        bounds.number("farthest_shift", farthest_shift, 0.0, _FARTHEST, "m")
        vessel = anatomy.tree.vessel(goal.vessel)
        if goal_radius is None:
            goal_radius = min(GOAL_RADIUS, anatomy.goal_room(goal))
        route = anatomy.route(goal, farthest_shift)
        arc_length = route.project(goal.position).arc_length if farthest_shift else None
        lumen = None
        if isinstance(reward, Mapping) and "path" in reward:
            vertices, inlet = anatomy.surface.vertices, anatomy.inlet.position
            box = np.stack([vertices.min(0), vertices.max(0)])
            lumen = LumenDistance(anatomy.lumen, box, route.points[-1], inlet)
        return cls(
            goal=goal.position,
            branch=vessel.centreline,
            ostium=vessel.ostium,
            route=route,
            goal_radius=goal_radius,
            weights=reward,
            goal_arc_length=arc_length,
            lumen=lumen,
        )

    def outcome(self, measurement: Measurement) -> Outcome:
        """Judges a control step."""
        success, failed = self.success(measurement), self.failure(measurement)
        # `judge` refuses a failure of another shape or type.
        if failed is not None and np.shape(failed) == success.shape:
            success = success & ~np.asarray(failed, dtype=bool)
        any_success = np.count_nonzero(success)
        terms = {}
        for name, weight in self.weights.items():
            if name == "success":
                term = weight * success if any_success else np.zeros(success.shape)
            else:
                term = weight * self.TERMS[name](self, measurement)
                if any_success and name in self.UNTIL_SUCCESS:
                    term = np.where(success, 0.0, term)
            terms[name] = term
        return Outcome(sum(terms.values(), _NOTHING), success, terms, failed)

    def failure(self, measurement: Measurement) -> np.ndarray | None:
        """Whether episodes end without success: (...) bool, or None for never."""
        del measurement
        return None

    def success(self, measurement: Measurement) -> np.ndarray:
        """Whether heads are in the branch and within the goal's radius: (...) bool."""
        success = measurement.distance < self.goal_radius
        if np.count_nonzero(success):  # finding the place in the branch takes 50 µs
            success = success & self.in_branch(measurement.readings.head)
        return success

    def distance(self, head: np.ndarray) -> np.ndarray:
        """Straight distance (...) from heads (..., 3) to the goal, m."""
        return straight(head, self.goal)

    def in_branch(self, head: np.ndarray) -> np.ndarray:
        """Whether the head (..., 3) is in the lumen of the branch, past its ostium."""
        place = self.branch.project_rows(head)
        return (place.distance <= place.radius) & (place.arc_length >= self.ostium)

    def lumen_distance(self, head: np.ndarray) -> np.ndarray:
        """Shortest distance (...) inside the lumen from heads (..., 3) to the goal, m.

        From a head in another branch, the path leads back through the parent vessel.
        ValueError if the objective has no `lumen`.
        """
        if self.lumen is None:
            raise ValueError(
                "the objective has no ways through the lumen; make it with "
                "Cannulation.to and a reward with the term 'path'"
            )
        # Paths are measured to the end of the route; the goal lies on them or at it.
        left = self.lumen(head) - self.lumen(self.goal)
        return np.maximum(left, self.distance(head))

    def path_distance(self, head: np.ndarray) -> np.ndarray:
        """Distance (...) along the route to the goal plus that from the route, m."""
        place = self.route.project_rows(head)
        if self.goal_arc_length is None:
            return self.route.length - place.arc_length + place.distance
        return np.abs(self.goal_arc_length - place.arc_length) + place.distance

    def shifted(self, shift: np.ndarray) -> "Cannulation":
        """The same objective with the goal moved along its branch.

        Args:
            shift: () or (N,), m, positive away from the ostium; the goal stays between
                the ostium and the end of the branch.
        """
        branch = self.branch
        start = branch.project(self.goal).arc_length
        stop = np.clip(start + shift, self.ostium, branch.length)
        moved = branch.at(stop).position - branch.at(start).position
        goal = self.goal + moved
        arc_length = self.route.project_rows(goal).arc_length
        return dataclasses.replace(self, goal=goal, goal_arc_length=arc_length)
