"""Memory of the attempts along a route, computed only from what a policy may observe.

It is an automaton over the place of the head on the route, the insertion and the force
of the base. A task advances it once per control step, whichever policy acts. The expert
decides by it; a policy that observes it needs no recurrence.

A retry begins when the head makes no progress, has left the tube of the route (as in a
wrong branch), the base is pushed too hard, or the shaft buckles in a wide vessel. The
device is withdrawn until the head is back in the route, farther with each retry, and
then advances again. Taking up the slack of a buckled shaft lets the head spring
forward, so most retries of coaxial devices end as soon as the head moves back. The
memory gives up where the lumen ahead is narrower than the device, or after several
retries at one place because of hard pushes.

Pure functions of arrays with leading batch axes, written `...`; metres and newtons.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.tasks.route import Place, Route
from cathsim_dmc.tasks.take_offs import bend

_WITHDRAWN = 2e-3  # m, insertion below which there is nothing left to withdraw
_GROWING = 4  # retries over which the withdrawal and the slack grow
_SAME_PLACE = 5e-3  # m of the route
_PAST = 3e-3  # m past a close take-off, where vessels lie side by side
_ALONE = 20e-3  # m, lead of a wire past a held branch before the catheter follows
# Scales of the observation.
_SEEN_WAY, _SEEN_LEAD, _SEEN_ATTEMPTS, _MOST_LEAD = 20e-3, 20e-3, 4, 2.0
RETRY_ENTRIES, COAXIAL_RETRY_ENTRIES = 11, 15
SHOWN = (
    "memory of the attempts: 1 while withdrawing; remaining withdrawal / 20 mm; "
    "control steps without progress, and outside the tube of the route, each divided "
    "by the number that begins a retry; number of retries / 4; look-ahead of the "
    "attempt, one-hot (3); 1 in every second attempt, which seeks the head on the "
    "route near its last position only; force of the base, N; 1 after giving up. "
    "Coaxial devices also have: 1 while slack is taken up; lead / 20 mm, at most 2; "
    "cosine and sine of the offset in direction"
)


@dataclasses.dataclass(frozen=True)
class Pattern:
    """Parameters that successive attempts cycle through.

    Attributes:
        lookahead_factors: factors of the look-ahead.
        leads: lead of each coaxial device over the one around it, m; negative if it
            stays behind.
        offsets: added to the direction of coaxial devices, rad.
    """

    lookahead_factors: tuple[float, ...] = (1.0, 0.75, 1.3)
    leads: tuple[float, ...] = (0.0,)
    offsets: tuple[float, ...] = (0.0,)

    def __post_init__(self):
        bounds.settings(self, dict.fromkeys(("leads", "offsets"), (-np.inf, np.inf)))


@dataclasses.dataclass(frozen=True)
class RetrySettings:
    """When a retry begins, how far it withdraws, and what the next attempt changes.

    Attributes:
        progress: least advance of the head along the route that counts as progress, m.
        patience: control steps without progress until a retry.
        lost_patience: control steps outside the route's tube until a retry.
        tolerance: largest `Place.excess` that counts as inside the route's tube.
        hard_push: force of the base above which it is pushed too hard, N.
        deep_push: likewise past the last of several take-offs that lie apart, where
            friction in the bends takes up more of the push, N.
        push_patience: control steps of such a push until a retry.
        most_pushed: number of retries after such pushes at one place at which the
            memory gives up.
        backoff: withdrawal of the first retry, m.
        backoff_growth: share of `backoff` that each retry adds; the withdrawal starts
            anew after every fourth retry.
        longest: control steps after which a withdrawal ends inside the tube.
        slack: Buckling threshold: advance of the base without the head, m.
        slack_growth: share of `slack` that each attempt adds, anew after every fourth:
            a shaft takes up more in a wide aorta before its end moves. None on routes
            with a take-off close to the first one, where slack pushes a catheter out.
        give: distance that the head may move back while slack is taken up, m.
        thorough: every n-th retry withdraws the whole way, not the slack alone.
        middle: excess below which a head past a take-off close to the first one is in
            the right branch; a withdrawal there ends only below it.
        held: distance past such a take-off from which the catheter holds the branch and
            only the wire advances, m.
        lookahead: longest look-ahead along the route, m, before the factor of the
            attempt.
        least_lookahead: shortest look-ahead, m; about one link of the tip.
        lookahead_radii: look-ahead between these limits, in radii of the lumen.
        pattern: parameters of the attempts.
        close: likewise on routes with a take-off close to the first one.
        sharp, planar: turn of the route into its last branch, rad, and cosine between
            the planes of this turn and of the bend before it, below either of which
            the attempts begin with the last of the leads, see `blunt`.
    """

    progress: float = 0.3e-3
    patience: int = 40
    lost_patience: int = 10
    tolerance: float = 0.25
    hard_push: float = 0.1
    deep_push: float = 0.1
    push_patience: int = 2
    most_pushed: int = 6
    backoff: float = 15e-3
    backoff_growth: float = 0.5
    longest: int = 120
    slack: float = np.inf
    slack_growth: float = 0.0
    give: float = 0.0
    thorough: int = 1
    middle: float = -0.7
    held: float = 14e-3
    lookahead: float = 16e-3
    least_lookahead: float = 8e-3
    lookahead_radii: float = 1.5
    pattern: Pattern = Pattern()
    close: Pattern = Pattern()
    sharp: float = 0.0
    planar: float = -1.0

    def __post_init__(self):
        limits: dict[str, tuple[float, float]] = {}
        limits |= dict.fromkeys(("patience", "lost_patience", "thorough"), (1, np.inf))
        limits |= dict.fromkeys(("tolerance", "middle", "planar"), (-1, np.inf))
        bounds.settings(self, limits)


SINGLE = RetrySettings()
COAXIAL = RetrySettings(
    progress=0.5e-3,
    patience=60,
    lost_patience=15,
    hard_push=0.2,
    deep_push=0.3,
    most_pushed=16,
    slack=12e-3,
    slack_growth=0.5,
    give=2e-3,
    thorough=4,
    lookahead=20e-3,
    least_lookahead=12e-3,
    pattern=Pattern(
        lookahead_factors=(1.4, 1.0, 0.75),
        leads=(0.02, -0.03, -0.045, -0.02),
        offsets=(0.0, 0.0, 0.0, 0.7, -0.7, 0.0, 1.4, -1.4),
    ),
    close=Pattern(
        lookahead_factors=(3.64, 2.6, 1.95),
        leads=(-0.02,),
    ),
    sharp=0.84,
    planar=0.85,
)


class Memory(NamedTuple):
    """Memory of the attempts of an episode, arrays (...).

    Attributes:
        arc_length: arc length of the head's place on the route, m.
        excess: `Place.excess` there.
        retracting: bool, whether the device is being withdrawn.
        taking_up: bool, whether the retraction ends when the slack is taken up.
        turn: insertion to be withdrawn to while retracting, m.
        best: farthest place on the route in this attempt, m.
        held: insertion when the head was there, m.
        stale: control steps since then, or since the withdrawal began.
        lost: control steps out of the route's tube.
        pressed: control steps of too hard a push.
        barrier: place of the first retry after such a push, m.
        pushed: number of these retries at that place.
        attempts: retries so far.
        first: index of the first attempt's lead in `Pattern.leads`.
        ostium: arc length of the last take-off close to the first one, m; infinite
            without.
        last: arc length of the last of several take-offs that lie apart, m; infinite
            without.
        given_up: bool, whether there is no further attempt.
    """

    arc_length: np.ndarray
    excess: np.ndarray
    retracting: np.ndarray
    taking_up: np.ndarray
    turn: np.ndarray
    best: np.ndarray
    held: np.ndarray
    stale: np.ndarray
    lost: np.ndarray
    pressed: np.ndarray
    barrier: np.ndarray
    pushed: np.ndarray
    attempts: np.ndarray
    first: np.ndarray
    ostium: np.ndarray
    last: np.ndarray
    given_up: np.ndarray

    @classmethod
    def at(cls, place: Place, insertion: np.ndarray) -> "Memory":
        """Memory (...) at the start of an episode, of heads at a place."""
        arc_length, shape = np.array(place.arc_length), np.shape(insertion)
        no, zero, none = np.zeros(shape, bool), np.zeros(shape), np.zeros(shape, int)
        return cls(
            arc_length=arc_length,
            excess=np.array(place.excess),
            best=arc_length,
            held=np.array(insertion),
            barrier=arc_length,
            **dict.fromkeys(("retracting", "taking_up", "given_up"), no),
            **dict.fromkeys(("stale", "lost", "pressed"), none),
            **dict.fromkeys(("pushed", "attempts", "first"), none),
            turn=zero,
            ostium=zero + np.inf,
            last=zero + np.inf,
        )

    @property
    def steady(self) -> np.ndarray:
        """Last arc lengths (...) for `route.locate`, m; NaN in even attempts.

        In odd attempts the head's place stays near the last one. Either choice fails in
        some branchings.
        """
        return np.where(self.attempts % 2 == 1, self.arc_length, np.nan)


def advance(
    settings: RetrySettings,
    memory: Memory,
    place: Place,
    insertion: np.ndarray,
    push: np.ndarray,
    narrow: np.ndarray | bool = False,
) -> Memory:
    """Returns the memory after a control step; begins and ends retries.

    Args:
        place: Place of the head on the route, arrays (...).
        insertion: (...), insertion of the head's device, m.
        push: (...), force of the base, positive forward, N.
        narrow: (...) bool, whether the lumen ahead is narrower than the device.
    """
    m, s = memory, settings
    outside, on = place.excess > s.tolerance, ~(m.retracting | m.given_up)
    gained = place.arc_length > m.best + s.progress
    stale = np.where(gained & on, 0, m.stale + 1)
    lost = np.where(outside & on, m.lost + 1, 0)
    hard_push = np.where(place.arc_length > m.last, s.deep_push, s.hard_push)
    pressed = np.where((push > hard_push) & on, m.pressed + 1, 0)
    held = np.where(gained, insertion, m.held)
    recent = m.attempts % _GROWING
    more = np.where(np.isfinite(m.ostium), 0.0, s.slack_growth) * recent
    buckled = on & (insertion > held + s.slack * (1 + more))
    strayed, forced = lost > s.lost_patience, pressed > s.push_patience
    give_up = on & ((stale > s.patience) | buckled) | strayed | forced
    attempts = m.attempts + give_up
    taking_up = ~strayed & (attempts % s.thorough != 0)
    taking_up = np.where(give_up, taking_up, m.taking_up)
    growth = 1 + s.backoff_growth * recent
    turn = np.where(give_up, insertion - s.backoff * growth, m.turn)
    best = np.where(give_up | gained, place.arc_length, m.best)
    # Taking up slack ends when the head comes back with the shaft.
    comes_back = taking_up & ~give_up & (place.arc_length < best - s.give)
    back = (insertion <= turn) | comes_back | m.retracting & (stale > s.longest)
    # Past a close take-off, only a head in mid-lumen is sure to be in the right branch.
    past, middle = place.arc_length > m.ostium + _PAST, place.excess <= s.middle
    falls_in = m.retracting & ~taking_up
    back = np.where(past, (back | falls_in) & middle, back & ~outside)
    back = back | (insertion <= _WITHDRAWN)
    retracting = (m.retracting | give_up) & ~back
    again = m.retracting & ~retracting
    barrier, pushed = _barrier(m, place, forced)
    return m._replace(
        arc_length=np.array(place.arc_length),
        excess=np.array(place.excess),
        retracting=retracting,
        taking_up=taking_up,
        turn=turn,
        best=np.where(again, place.arc_length, best),
        held=np.where(again, insertion, held),
        stale=np.where(give_up | again, 0, stale),
        lost=lost,
        pressed=np.where(give_up, 0, pressed),
        barrier=barrier,
        pushed=pushed,
        attempts=attempts,
        given_up=m.given_up | (pushed >= s.most_pushed) | narrow & ~outside,
    )


def _barrier(
    memory: Memory, place: Place, forced: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Arc length of the first hard push, m, and number of retries after one there."""
    farther = place.arc_length > memory.barrier + _SAME_PLACE
    barrier = np.where(forced & farther, place.arc_length, memory.barrier)
    pushed = np.where(farther, 0, memory.pushed) + forced
    return barrier, pushed


def lookahead(
    settings: RetrySettings, memory: Memory, route: Route, arc_length: np.ndarray
) -> np.ndarray:
    """Look-ahead (...) along the route in the present attempt, m.

    Args:
        arc_length: (...), arc length of the head's place on the route, m.
    """
    s = settings
    # With the radius at the head, a branch would be entered too obliquely.
    coming = arc_length + s.least_lookahead
    radius = np.interp(coming, route.arc_length, route.radii)
    way = np.clip(s.lookahead_radii * radius, s.least_lookahead, s.lookahead)
    factors = s.pattern.lookahead_factors, s.close.lookahead_factors
    return way * _nth(factors, memory.attempts, memory)


def lead(settings: RetrySettings, memory: Memory) -> np.ndarray:
    """Lead (...) of coaxial devices in the present attempt, m.

    A catheter that is pushed after its wire too early leaves the branch that it holds.
    """
    leads = settings.pattern.leads, settings.close.leads
    lead = _nth(leads, memory.attempts + memory.first, memory)
    deep = memory.arc_length - memory.ostium
    return np.where(deep > settings.held, deep + _ALONE, lead)


def offset(settings: RetrySettings, memory: Memory) -> np.ndarray:
    """Offset (...) of the direction of coaxial devices in the present attempt, rad."""
    offsets = settings.pattern.offsets, settings.close.offsets
    return _nth(offsets, memory.attempts, memory)


def _nth(
    values: tuple[tuple[float, ...], tuple[float, ...]],
    number: np.ndarray,
    memory: Memory,
) -> np.ndarray:
    """Values (...), cycled by `number`; the second tuple where take-offs are close."""
    usual, close = (np.asarray(v)[number % len(v)] for v in values)
    return np.where(np.isfinite(memory.ostium), close, usual)


def shown(
    settings: RetrySettings,
    memory: Memory,
    insertion: np.ndarray,
    push: np.ndarray,
    coaxial: bool,
) -> np.ndarray:
    """Observed memory, (..., `RETRY_ENTRIES` or `COAXIAL_RETRY_ENTRIES`), see `SHOWN`.

    Args:
        insertion: (...), insertion of the head's device, m.
        push: (...), force of the base, positive forward, N.
        coaxial: Whether the devices are coaxial.
    """
    m, s = memory, settings
    left = np.clip((insertion - m.turn) / _SEEN_WAY, -1.0, 2.0)
    turns = m.attempts % len(s.pattern.lookahead_factors)
    columns = [
        m.retracting,
        np.where(m.retracting, left, 0.0),
        np.clip(m.stale / s.patience, 0.0, 2.0),
        np.clip(m.lost / s.lost_patience, 0.0, 2.0),
        np.minimum(m.attempts, _SEEN_ATTEMPTS) / _SEEN_ATTEMPTS,
        *(turns == number for number in range(3)),
        m.attempts % 2 == 1,
        push,
        m.given_up,
    ]
    if coaxial:
        angle = offset(s, m)
        leads = np.minimum(lead(s, m) / _SEEN_LEAD, _MOST_LEAD)
        columns += [m.taking_up, leads, np.cos(angle), np.sin(angle)]
    return np.stack([np.asarray(column, float) for column in columns], axis=-1)


def blunt(settings: RetrySettings, route: Route) -> bool:
    """Whether attempts of coaxial devices begin with the last of the leads.

    The bend before a take-off presses a wire against the outer wall, in the plane of
    the bend. The wire enters a branch that leaves there. It passes a branch that leaves
    to the side or nearly straight on; a catheter's shaped end, turned there, enters it.
    """
    turn, planar = bend(route, route.narrowing)
    return turn < settings.sharp or planar < settings.planar
