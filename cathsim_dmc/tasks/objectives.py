"""What it means to cannulate a branch: distance, success and reward."""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy import centreline as centrelines

# The published task.
GOAL_RADIUS = 8e-3  # m, δ
SUCCESS_REWARD = 10.0
MAX_STEPS = 2000
CONTROL_TIMESTEP = 0.04  # s, one frame of fluoroscopy
START_JITTER = 1e-3  # m, radius of the ball of the random displacement of the tip

REWARDS = ("distance", "path")


class Outcome(NamedTuple):
    """How a control step went; arrays have the leading axes of the head.

    Attributes:
      distance: (...), straight from head to goal, m.
      success: (...) bool, in the branch and within the goal's radius.
      reward: (...), the weighted terms that count.
      path: (...), way along the route that is left and distance from it, m; None
        unless it is rewarded.
    """

    distance: np.ndarray
    success: np.ndarray
    reward: np.ndarray
    path: np.ndarray | None = None

    @property
    def terms(self) -> dict[str, np.ndarray]:
        """Named reward terms (...), before weighting."""
        terms = {"distance": self.distance, "success": self.success.astype(float)}
        return terms if self.path is None else {**terms, "path": self.path}


@dataclasses.dataclass(frozen=True)
class Cannulation:
    """The goal of a task and its reward.

    Attributes:
      goal: (3,) or, if it differs between simulations, (..., 3), m, world frame.
      branch: centreline of the whole target branch.
      ostium: arc length at which the branch leaves its parent's lumen, m.
      route: centreline from the inlet to the goal.
      goal_radius: δ, m.
      reward: "distance" (published: minus the straight distance in metres) or "path"
        (minus the way along the route that is left, and the distance from it).
      success_reward: bonus, weight of the term "success".
      max_steps: control steps until the episode is truncated.
      goal_arc_length: () or (...), of the goal on the route, m; None for its end.
    """

    goal: np.ndarray
    branch: centrelines.Centreline
    ostium: float
    route: centrelines.Centreline
    goal_radius: float = GOAL_RADIUS
    reward: str = "distance"
    success_reward: float = SUCCESS_REWARD
    max_steps: int = MAX_STEPS
    goal_arc_length: np.ndarray | None = None

    def __post_init__(self):
        if self.reward not in REWARDS:
            raise ValueError(
                f"reward is {self.reward!r}; allowed are {', '.join(REWARDS)}"
            )
        if not self.goal_radius > 0:
            raise ValueError(f"goal_radius is {self.goal_radius} m; it must be > 0")
        if self.max_steps < 1:
            raise ValueError(f"max_steps is {self.max_steps}; at least 1")

    @functools.cached_property
    def weights(self) -> dict[str, float]:
        """Weights of the reward terms."""
        return {self.reward: -1.0, "success": self.success_reward}

    def outcome(self, head: np.ndarray) -> Outcome:
        """Judges the position (..., 3) of the head, m, world frame."""
        distance = _norm(head - self.goal)
        success = distance < self.goal_radius
        path = self.path_distance(head) if self.reward == "path" else None
        reward = self.weights[self.reward] * (distance if path is None else path)
        if success.any():  # finding the place in the branch takes 50 µs
            success = success & self.in_branch(head)
            # Published: +10 inside δ, minus the distance otherwise.
            reward = np.where(success, self.weights["success"], reward)
        return Outcome(distance, success, reward, path)

    def in_branch(self, head: np.ndarray) -> np.ndarray:
        """Whether the head (..., 3) is in the lumen of the branch, past its ostium."""
        place = self.branch.project(head)
        return (place.distance <= place.radius) & (place.arc_length >= self.ostium)

    def path_distance(self, head: np.ndarray) -> np.ndarray:
        """Way (...) along the route to the goal plus distance from the route, m."""
        place = self.route.project(head)
        if self.goal_arc_length is None:
            return self.route.length - place.arc_length + place.distance
        return np.abs(self.goal_arc_length - place.arc_length) + place.distance

    def shifted(self, shift: np.ndarray) -> "Cannulation":
        """The same task with the goal moved along its branch.

        Args:
          shift: () or (...), m, positive away from the ostium; the goal stays
            between the ostium and the end of the branch.
        """
        branch = self.branch
        start = branch.project(self.goal).arc_length
        stop = np.clip(start + shift, self.ostium, branch.length)
        moved = branch.at(stop).position - branch.at(start).position
        goal = self.goal + moved
        arc_length = self.route.project(goal).arc_length
        return dataclasses.replace(self, goal=goal, goal_arc_length=arc_length)


def _norm(vectors: np.ndarray) -> np.ndarray:
    """Length of vectors (..., 3)."""
    return np.sqrt(np.vecdot(vectors, vectors))


class Travel:
    """Ways that the heads of N simulations have gone in their episodes."""

    def __init__(self, simulations: int):
        """Starts with all heads at rest."""
        self._gone = np.zeros(simulations)
        self._shortest = np.ones(simulations)
        # Positions whose ways are not in the sum yet: it is seldom asked for.
        self._heads = [np.zeros((simulations, 3))]

    def restart(
        self, indices: np.ndarray, head: np.ndarray, meaning: Cannulation
    ) -> None:
        """Begins episodes of some simulations with the heads (N, 3) of all, m."""
        self._sum_up()
        self._heads[0] = self._heads[0].copy()
        self._heads[0][indices] = head[indices]
        self._gone[indices] = 0.0
        self._shortest[indices] = meaning.path_distance(head)[indices]

    def add(self, head: np.ndarray) -> None:
        """Adds the way to the heads (N, 3), m."""
        self._heads.append(head)

    def _sum_up(self):
        ways = _norm(np.diff(self._heads, axis=0))
        # One step after the other: a sum would depend on when it is taken.
        self._gone = np.cumsum([self._gone, *ways], axis=0)[-1]
        del self._heads[:-1]

    @property
    def path_ratio(self) -> np.ndarray:
        """(N,), way gone so far over the shortest way from start to goal."""
        self._sum_up()
        return self._gone / self._shortest


def start_displacement(
    random_state: np.random.RandomState, ball: float = START_JITTER
) -> np.ndarray:
    """Random displacement (3,) of the tip: uniform in a ball of that radius, m."""
    direction = random_state.normal(size=3)
    radius = ball * random_state.uniform() ** (1 / 3)
    return radius * direction / np.linalg.norm(direction)


def check_action(action: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Returns the action as float64.

    Args:
      action: of one simulation (A,), or of many (N, A).
      shape: that it must have.

    Raises:
      ValueError: if its shape is another or it is not finite.
    """
    action = np.asarray(action, dtype=np.float64)
    if action.shape != shape:
        many = f"for {shape[0]} simulations, " if len(shape) > 1 else ""
        raise ValueError(
            f"the action has shape {action.shape}, but it must have {shape}: {many}"
            f"{shape[-1]} entries in [-1, 1]: tip motors from proximal to distal (x "
            "before y), translation, and rotation if the task has it"
        )
    finite = np.isfinite(action)
    if not finite.all():
        raise ValueError(
            f"the action holds {np.count_nonzero(~finite)} NaN or infinite entries; "
            "all must be numbers in [-1, 1]"
        )
    return action
