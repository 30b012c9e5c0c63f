"""Attempts of a pursuit: how fast it drives, when it gives up, how far it withdraws.

When the head makes no progress, or has left the tube of the route as in a wrong branch,
the device is withdrawn until the head is back in the route, from farther back with each
retry, and tries again. A shaft that buckles into a wide vessel while the head stays is
given up too; taking up that slack lets the head spring forward, so of such retries most
withdraw only as long as the head does not come back.

Pure functions of arrays with leading batch axes, written `...`; metres.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from cathsim_dmc.tasks.route import Place, Route, locate

_WITHDRAWN = 2e-3  # m, insertion below which there is nothing left to withdraw
_GROWING = 4  # retries over which the way back grows


@dataclasses.dataclass(frozen=True)
class AttemptSettings:
    """How fast to drive, when to give up and how far to withdraw.

    Attributes:
        lookahead: longest way along the route to the point pursued, m.
        least_lookahead: shortest, m; about one link of the tip.
        lookahead_radii: in between it is so many radii of the lumen.
        lookahead_factors: multiply it in successive attempts, over and over.
        speed: fastest translation, as a part of what the carriage can do.
        creep: slowest, as a part of `speed`, when misaligned or pressing.
        aligned, misaligned: cosines of the error of direction between which the speed
            falls from full to creeping.
        soft_force, hard_force: largest contact, N, between which it falls likewise; the
            mean over a control step. The published forces lie below 0.2 N, with
            outliers above 0.4 N.
        progress: m; what the head must gain to count as moving.
        patience: control steps without progress until a retry.
        lost_patience: control steps outside the route's tube until a retry.
        tolerance: by how much of its radius the lumen may exceed the route's tube.
        backoff: way back of the first retry, m.
        backoff_growth: of the way back from each retry to the next, up to the fourth.
        slack: what the base may advance while the head does not, m.
        give: distance that the head may move back while slack is taken up, m.
        thorough: every n-th retry withdraws the whole way, not the slack alone.
    """

    lookahead: float = 16e-3
    least_lookahead: float = 8e-3
    lookahead_radii: float = 1.5
    lookahead_factors: tuple[float, ...] = (1.0, 0.75, 1.3)
    speed: float = 0.6
    creep: float = 0.05
    aligned: float = 0.9
    misaligned: float = 0.5
    soft_force: float = 0.1
    hard_force: float = 0.35
    progress: float = 0.3e-3
    patience: int = 40
    lost_patience: int = 10
    tolerance: float = 0.25
    backoff: float = 15e-3
    backoff_growth: float = 0.5
    slack: float = np.inf
    give: float = 0.0
    thorough: int = 1


class State(NamedTuple):
    """Memory of the expert for each simulation, arrays (...).

    Attributes:
        arc_length: of the place on the route at the last step, m; NaN before the
            first.
        retracting: bool.
        taking_up: bool, whether the retraction ends when the slack is taken up.
        turn: insertion to be withdrawn to while retracting, m.
        best: farthest place on the route in this attempt, m.
        held: insertion when the head was there, m.
        stale: control steps since then.
        lost: control steps out of the route's tube.
        attempts: retries so far.
        insertion: at the last step, m; NaN before the first.
        bend: (..., M, 2), told to the hinges of a steerable tip, rad.
    """

    arc_length: np.ndarray
    retracting: np.ndarray
    taking_up: np.ndarray
    turn: np.ndarray
    best: np.ndarray
    held: np.ndarray
    stale: np.ndarray
    lost: np.ndarray
    attempts: np.ndarray
    insertion: np.ndarray
    bend: np.ndarray

    @classmethod
    def fresh(cls, shape: tuple[int, ...], joints: int = 0) -> "State":
        """State (...) at the start of an episode, of a tip of so many joints."""
        unknown, zero = np.full(shape, np.nan), np.zeros(shape)
        no, none = np.zeros(shape, bool), np.zeros(shape, int)
        counts, bend = (none, none, none), np.zeros((*shape, joints, 2))
        return cls(unknown, no, no, zero, zero, zero, *counts, unknown, bend)


def aim(
    route: Route, settings: AttemptSettings, state: State, head: np.ndarray
) -> tuple[Place, np.ndarray]:
    """Place of a head (..., 3) on the route, and way (...) to the point pursued, m."""
    # Every other attempt stays near the last place: both ways fail in some
    # branchings.
    steady = np.where(state.attempts % 2 == 1, state.arc_length, np.nan)
    place = locate(route, head, steady)
    # The lumen that counts is the one to come, or a branch is entered too obliquely.
    coming = place.arc_length + settings.least_lookahead
    radius = np.interp(coming, route.arc_length, route.radii)
    ahead = np.clip(
        settings.lookahead_radii * radius, settings.least_lookahead, settings.lookahead
    )
    factors = np.asarray(settings.lookahead_factors)
    return place, ahead * factors[state.attempts % len(factors)]


def translation(
    settings: AttemptSettings, state: State, contact: np.ndarray, cosine: np.ndarray
) -> np.ndarray:
    """Translation (...) in [-1, 1] at a largest contact, N, and error of direction."""
    free = _ramp(contact, settings.hard_force, settings.soft_force)
    clear = _ramp(cosine, settings.misaligned, settings.aligned)
    forward = settings.speed * np.maximum(free * clear, settings.creep)
    return np.where(state.retracting, -settings.speed, forward)


def _ramp(value: np.ndarray, none: float, full: float) -> np.ndarray:
    """Linear from 0 at `none` to 1 at `full`, constant beyond either."""
    return np.clip((value - none) / (full - none), 0.0, 1.0)


def advance(
    settings: AttemptSettings, state: State, place: Place, insertion: np.ndarray
) -> State:
    """Counts progress over a control step; begins and ends retries.

    Args:
        insertion: (...), of the head's device, m.
    """
    outside = place.excess > settings.tolerance
    gained = place.arc_length > state.best + settings.progress
    idle = gained | state.retracting
    stale = np.where(idle, 0, state.stale + 1)
    lost = np.where(outside & ~state.retracting, state.lost + 1, 0)
    held = np.where(idle, np.minimum(insertion, state.held), state.held)
    held = np.where(gained, insertion, held)
    buckled = ~state.retracting & (insertion > held + settings.slack)
    strayed = lost > settings.lost_patience
    give_up = (stale > settings.patience) | buckled | strayed
    attempts = state.attempts + give_up
    slack = ~strayed & (attempts % settings.thorough != 0)
    slack = np.where(give_up, slack, state.taking_up)
    growth = 1 + settings.backoff_growth * (state.attempts % _GROWING)
    turn = np.where(give_up, insertion - settings.backoff * growth, state.turn)
    best = np.where(give_up | gained, place.arc_length, state.best)
    # Taking up slack ends when the head comes back with the shaft.
    comes_back = slack & ~give_up & (place.arc_length < best - settings.give)
    back = ((insertion <= turn) | comes_back) & ~outside | (insertion <= _WITHDRAWN)
    retracting = (state.retracting | give_up) & ~back
    again = state.retracting & ~retracting
    return state._replace(
        arc_length=np.array(place.arc_length),
        retracting=retracting,
        taking_up=slack,
        turn=turn,
        best=np.where(again, place.arc_length, best),
        held=np.where(again, insertion, held),
        stale=np.where(give_up, 0, stale),
        lost=lost,
        attempts=attempts,
    )
