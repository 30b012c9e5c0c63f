"""Translation and look-ahead of the scripted expert within an attempt.

`tasks.retry` decides when an attempt ends. Pure functions of arrays with leading batch
axes, written `...`; metres.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.tasks import retry
from cathsim_dmc.tasks.retry import Memory, RetrySettings
from cathsim_dmc.tasks.route import Place, Route, locate


@dataclasses.dataclass(frozen=True)
class AttemptSettings:
    """Settings of the translation in an attempt.

    Attributes:
        retry: settings of the attempts and of the look-ahead, see `tasks.retry`.
        speed: fastest translation, as a fraction of the full speed of the carriage.
        creep: slowest advance, misaligned or in hard contact, as a fraction of `speed`.
        aligned, misaligned: cosines of the direction error between which the speed
            falls from `speed` to `creep`.
        soft_force, hard_force: largest contact force, N, mean over a control step,
            between which the speed falls likewise. The published forces lie below
            0.2 N, with outliers above 0.4 N.
        press: slowest advance when the head is stuck inside the route's tube, as a
            fraction of `speed`; it rises from 0 over the steps `stuck`.
        stuck: (first, last) control step without progress of this rise.
        soft_push, hard_push: force of the base, N, between which `press` falls to 0.
        straightening: control steps of standstill, in which the tip straightens,
            before a withdrawal.
        withdrawal: speed of a withdrawal, as a fraction of the full speed.
        relaxing: factor of the tip's bends per control step in a withdrawal, and at a
            contact force of `hard_force`.
    """

    retry: RetrySettings = retry.SINGLE
    speed: float = 0.6
    creep: float = 0.05
    aligned: float = 0.9
    misaligned: float = 0.5
    soft_force: float = 0.1
    hard_force: float = 0.35
    press: float = 0.5
    stuck: tuple[int, int] = (10, 30)
    soft_push: float = 0.05
    hard_push: float = 0.1
    straightening: int = 8
    withdrawal: float = 0.25
    relaxing: float = 0.7

    def __post_init__(self):
        limits: dict[str, tuple[float, float]] = {}
        shares = "speed", "creep", "press", "withdrawal", "relaxing"
        limits |= dict.fromkeys(shares, (0, 1))
        limits |= dict.fromkeys(("aligned", "misaligned"), (-1, 1))
        bounds.settings(self, limits)
        bounds.interval("stuck", self.stuck, 0, integers=True)
        for low, high, ends in (
            ("misaligned", "aligned", (self.misaligned, self.aligned)),
            ("soft_force", "hard_force", (self.soft_force, self.hard_force)),
            ("soft_push", "hard_push", (self.soft_push, self.hard_push)),
            ("stuck[0]", "stuck[1]", self.stuck),
        ):
            if ends[0] >= ends[1]:  # the ramp between them would divide by 0
                bounds.refuse(low, ends[0], f"below {high}, {ends[1]}")


class State(NamedTuple):
    """State of the expert in each simulation, beside the task's `retry.Memory`.

    Attributes:
        arc_length: (...), of the head's place on the route at the last step, m; NaN
            before the first.
        insertion: (...), at the last step, m; NaN before the first.
        bend: (..., M, 2), last command to the hinges of a steerable tip, rad.
    """

    arc_length: np.ndarray
    insertion: np.ndarray
    bend: np.ndarray

    @classmethod
    def fresh(cls, shape: tuple[int, ...], joints: int = 0) -> "State":
        """Returns the state at the start of an episode, for a tip of M `joints`."""
        unknown = np.full(shape, np.nan)
        return cls(unknown, unknown, np.zeros((*shape, joints, 2)))


def aim(
    route: Route,
    settings: AttemptSettings,
    state: State,
    memory: Memory,
    head: np.ndarray,
) -> tuple[Place, np.ndarray]:
    """Returns the place of a head (..., 3) on the route and the look-ahead (...), m."""
    steady = np.where(np.isnan(memory.steady), np.nan, state.arc_length)
    place = locate(route, head, steady)
    return place, retry.lookahead(settings.retry, memory, route, place.arc_length)


def translation(
    settings: AttemptSettings,
    memory: Memory,
    contact: np.ndarray,
    push: np.ndarray,
    cosine: np.ndarray,
) -> np.ndarray:
    """Returns the command of the translation (...) in [-1, 1].

    Args:
        contact: (...), largest contact force on the wall, N.
        push: (...), force of the base, N.
        cosine: (...), cosine of the direction error.
    """
    s, free = settings, freedom(settings, contact)
    clear = _ramp(cosine, s.misaligned, s.aligned)
    stuck = _ramp(memory.stale, *s.stuck) * (memory.lost == 0)
    press = s.press * stuck * free * ease(s, push)
    forward = s.speed * np.maximum(np.maximum(free * clear, s.creep), press)
    forward = np.where(memory.given_up, 0.0, forward)
    straight = memory.stale >= s.straightening
    return np.where(memory.retracting, -s.withdrawal * straight, forward)


def freedom(settings: AttemptSettings, contact: np.ndarray) -> np.ndarray:
    """Returns a ramp (...), 1 at `soft_force` and 0 at `hard_force`; contact in N."""
    return _ramp(contact, settings.hard_force, settings.soft_force)


def ease(settings: AttemptSettings, push: np.ndarray) -> np.ndarray:
    """Returns a ramp (...), 1 at `soft_push` and 0 at `hard_push`; push in N."""
    return _ramp(push, settings.hard_push, settings.soft_push)


def relaxed(
    settings: AttemptSettings, memory: Memory, contact: np.ndarray
) -> np.ndarray:
    """Returns the factor (...) of the tip's bends in a control step, at most 1."""
    held = memory.retracting | memory.given_up
    free = np.where(held, 0.0, freedom(settings, contact))
    return settings.relaxing + (1.0 - settings.relaxing) * free


def _ramp(value: np.ndarray, none: float, full: float) -> np.ndarray:
    """Returns a linear ramp from 0 at `none` to 1 at `full`, constant beyond."""
    return np.clip((value - none) / (full - none), 0.0, 1.0)
