"""Places along a capsule that are nearest to a wall.

Sphere tracing along the axis samples the clearance every `EVERY` m (J. C. Hart, The
Visual Computer 12 (1996) 527): the clearance changes by at most the distance moved, so
samples whose neighbour is far enough from the wall are skipped. Each local minimum that
can be a contact is then bisected and fitted by a parabola.
"""

from __future__ import annotations

import math

import numpy as np

from cathsim_dmc.compiled import inlined, law
from cathsim_dmc.laws.bore import straight_bore_places
from cathsim_dmc.laws.field import FREE
from cathsim_dmc.laws.places import Places
from cathsim_dmc.laws.wall import clearance_along, is_straight_bore

EVERY = 1e-3  # m, between the first samples of a capsule
SAMPLES = 65  # largest number of samples
# Depth, m, of a local minimum of the clearance that is a contact of its own; a capsule
# that lies flat on a wall has many shallower minima.
_DENT = 5e-6
_FLAT = 2e-6  # m, below which clearances count as equal
_BISECTIONS = 6
_FAR = 1e-3  # m, error of the coarse lattice far from the wall


@inlined
def _is_dent(samples, count, i, caps):
    """Whether a sample is a local minimum deep enough for a contact of its own.

    The clearance must rise to both sides by `_DENT`, or up to an end whose cap
    collides and where it still rises.
    """
    for side, way in enumerate((-1, 1)):
        rise, k = 0.0, i + way
        while 0 <= k < count and samples[k] >= samples[i] and rise < _DENT:
            rise = max(rise, samples[k] - samples[i])
            k += way
        if rise >= _DENT:
            continue
        if 0 <= k < count or not caps[side]:
            return False
        if samples[k - way] <= samples[k - 2 * way] + _FLAT:
            return False
    return True


@inlined
def _refine(wall, capsule, t, value, step):
    """Place (m) of the least clearance within a step of t, and that clearance (m).

    Bisection, because the clearance has a kink at an edge of the wall; then a parabola
    through the last three places.
    """
    half = capsule.half_length
    left, right = max(t - step, -half), min(t + step, half)
    before, after = 0.0, 0.0
    for end in range(2):
        there = clearance_along(wall, capsule, right if end else left)
        before, after = after, there
    for n in range(_BISECTIONS + 1):
        upper = right - t > t - left
        place = 0.5 * (t + (right if upper else left))
        if n == _BISECTIONS:
            one, other = (after - value) * (t - left), (before - value) * (right - t)
            if not (one > 0.0 and other > 0.0):
                break
            way = 0.5 * (other * (right - t) - one * (t - left)) / (one + other)
            place = t + way
        there = clearance_along(wall, capsule, place)
        if there < value:
            if upper:
                left, before = t, value
            else:
                right, after = t, value
            t, value = place, there
        elif upper:
            right, after = place, there
        else:
            left, before = place, there
    return t, value


@inlined
def is_far(wall, capsule, limit):
    """Whether a capsule is certain to be farther from the wall than the limit, m.

    The clearance at its middle decides; past an open end, that at its ends.
    """
    middle = clearance_along(wall, capsule, 0.0)
    if middle < FREE:
        return middle - capsule.half_length > limit + _FAR
    if capsule.half_length == 0.0:
        return False
    for side in (-1.0, 1.0):
        if clearance_along(wall, capsule, side * capsule.half_length) < FREE:
            return False
    return True


@inlined
def _sample(wall, capsule, limit, samples):
    """Writes clearances (m) along a capsule; returns their number and spacing (m).

    The number is 0 if the wall is farther away than the limit, m.
    """
    count, half = 1, capsule.half_length
    if half > 0.0:
        count += min(max(int(math.ceil(2.0 * half / EVERY)), 2), SAMPLES - 1)
    step = 2.0 * half / max(count - 1, 1)
    least, i = np.inf, 0
    while i < count:
        value = samples[i] = clearance_along(wall, capsule, -half + i * step)
        least = min(least, value)
        i += 1
        # It changes by at most the distance moved, except where an open end begins.
        while i < count and value < FREE and value - step > limit + _FAR:
            value -= step
            samples[i] = value
            i += 1
    return (0 if least > limit + step else count), step


@inlined
def _candidate(samples, count, i, deepest, caps):
    """Whether to refine a sample, and whether its end cap does not collide."""
    value = samples[i]
    if i == 0 or i == count - 1:
        beside = samples[min(1, count - 1)] if i == 0 else samples[i - 1]
        return value <= beside + _FLAT, not caps[0 if i == 0 else 1]
    if not (value <= samples[i - 1] and value < samples[i + 1]):
        return False, False
    return i == deepest or _is_dent(samples, count, i, caps), False


@inlined
def _with(places, t, value):
    """Adds a place beyond those found; keeps the two nearest to the wall."""
    found, first, low = places.found, places.first, places.first_clearance
    second, lower = places.second, places.second_clearance
    if found == 2:
        if value >= max(low, lower):
            return places
        if low > lower:
            first, low = second, lower
        found = 1
    if found:
        return Places(2, first, low, t, value)
    return Places(1, t, value, second, lower)


@law
def nearest_places(wall, capsule, limit, samples):
    """Places of a capsule's axis that are nearest to the wall.

    Args:
        wall: `wall.Wall`.
        capsule: `places.Capsule`.
        limit: Largest clearance of a place, m.
        samples: (SAMPLES,) scratch.

    Returns:
        `places.Places`.
    """
    if is_straight_bore(wall):
        return straight_bore_places(wall.line, capsule, limit)
    places = Places(0, 0.0, FREE, 0.0, FREE)
    if is_far(wall, capsule, limit):
        return places
    count, step = _sample(wall, capsule, limit, samples)
    deepest = 0
    for i in range(1, count):
        if samples[i] < samples[deepest]:
            deepest = i
    half = capsule.half_length
    for i in range(count):
        close, left_out = _candidate(samples, count, i, deepest, capsule.caps)
        t, value = -half + i * step, samples[i]
        if not close or value > limit + step:
            continue
        if half > 0.0:
            t, value = _refine(wall, capsule, t, value, step)
            if left_out and samples[i] - value < _DENT:
                continue
        if value <= limit:
            places = _with(places, t, value)
    return places
