"""Attempts of a pursuit: when it gives up, how far it withdraws, when it goes on.

When the head makes no progress, or has left the tube of the route as in a wrong branch,
the device is withdrawn until the head is back in the route, from farther back with each
retry, and tries again. A shaft that buckles into a wide vessel while the head stays is
given up too; taking up that slack lets the head spring forward, so of such retries most
withdraw only as long as the head does not come back.

Pure functions of arrays with leading batch axes, written `...`; metres.
"""

import dataclasses
from typing import TypeVar

import numpy as np

from cathsim_dmc.tasks.route import Place

_WITHDRAWN = 2e-3  # m, insertion below which there is nothing left to withdraw
_GROWING = 4  # retries over which the way back grows


@dataclasses.dataclass(frozen=True)
class AttemptSettings:
    """When to give up and how far to withdraw.

    Attributes:
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

    progress: float = 0.3e-3
    patience: int = 40
    lost_patience: int = 10
    tolerance: float = 0.25
    backoff: float = 15e-3
    backoff_growth: float = 0.5
    slack: float = np.inf
    give: float = 0.0
    thorough: int = 1


@dataclasses.dataclass(frozen=True)
class Attempts:
    """Progress of each simulation, arrays (...).

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

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> "Attempts":
        """Before the first step of an episode."""
        return Attempts(
            arc_length=np.full(shape, np.nan),
            retracting=np.zeros(shape, dtype=bool),
            taking_up=np.zeros(shape, dtype=bool),
            turn=np.zeros(shape),
            best=np.zeros(shape),
            held=np.zeros(shape),
            stale=np.zeros(shape, dtype=int),
            lost=np.zeros(shape, dtype=int),
            attempts=np.zeros(shape, dtype=int),
        )


State = TypeVar("State", bound=Attempts)


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
    return dataclasses.replace(
        state,
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
