"""How fast a pursuit drives in an attempt, and which point of the route it pursues.

`tasks.retry` decides when an attempt ends. Pure functions of arrays with leading batch
axes, written `...`; metres.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from cathsim_dmc.tasks import retry
from cathsim_dmc.tasks.retry import Memory, RetrySettings
from cathsim_dmc.tasks.route import Place, Route, locate


@dataclasses.dataclass(frozen=True)
class AttemptSettings:
    """How fast to drive.

    Attributes:
        retry: Of the attempts, and how far ahead they look, see `tasks.retry`.
        speed: fastest translation, as a part of what the carriage can do.
        creep: slowest, as a part of `speed`, when misaligned or pressing.
        aligned, misaligned: cosines of the error of direction between which the speed
            falls from full to creeping.
        soft_force, hard_force: largest contact, N, between which it falls likewise; the
            mean over a control step. The published forces lie below 0.2 N, with
            outliers above 0.4 N.
        press: slowest, as a part of `speed`, when the head is stuck inside the tube;
            it grows from nothing between `stuck` control steps without progress.
        stuck: see `press`.
        soft_push, hard_push: force of the base, N, between which pressing ceases.
        straightening: control steps in which the device stands and its tip straightens
            before it is withdrawn.
        withdrawal: fastest translation then, as `speed`.
        relaxing: what is left of the bend of the tip after each control step then, and
            where it presses on the wall with `hard_force`.
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


class State(NamedTuple):
    """Memory of the expert beside that of the task, for each simulation, arrays (...).

    Attributes:
        arc_length: of the place on the route at the last step, m; NaN before the
            first.
        insertion: at the last step, m; NaN before the first.
        bend: (..., M, 2), told to the hinges of a steerable tip, rad.
    """

    arc_length: np.ndarray
    insertion: np.ndarray
    bend: np.ndarray

    @classmethod
    def fresh(cls, shape: tuple[int, ...], joints: int = 0) -> "State":
        """State (...) at the start of an episode, of a tip of so many joints."""
        unknown = np.full(shape, np.nan)
        return cls(unknown, unknown, np.zeros((*shape, joints, 2)))


def aim(
    route: Route,
    settings: AttemptSettings,
    state: State,
    memory: Memory,
    head: np.ndarray,
) -> tuple[Place, np.ndarray]:
    """Place of a head (..., 3) on the route, and way (...) to the point pursued, m."""
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
    """Translation (...) in [-1, 1].

    Args:
        contact: (...), largest contact with the wall, N.
        push: (...), force of the base, N.
        cosine: (...), of the error of direction.
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
    """1 where the largest contact (...), N, is soft, 0 where it is hard."""
    return _ramp(contact, settings.hard_force, settings.soft_force)


def ease(settings: AttemptSettings, push: np.ndarray) -> np.ndarray:
    """1 where the base is pushed softly, (...), N, 0 where it is pushed hard."""
    return _ramp(push, settings.hard_push, settings.soft_push)


def relaxed(
    settings: AttemptSettings, memory: Memory, contact: np.ndarray
) -> np.ndarray:
    """What is left (...) of the bends of the tip after a control step."""
    held = memory.retracting | memory.given_up
    free = np.where(held, 0.0, freedom(settings, contact))
    return settings.relaxing + (1.0 - settings.relaxing) * free


def _ramp(value: np.ndarray, none: float, full: float) -> np.ndarray:
    """Linear from 0 at `none` to 1 at `full`, constant beyond either."""
    return np.clip((value - none) / (full - none), 0.0, 1.0)
