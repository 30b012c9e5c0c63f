"""Places of a capsule that are nearest to the wall of a field, compiled."""

from __future__ import annotations

import math

import numpy as np

from cathsim_dmc.anatomy.field_loops import FREE, clearance_at, gradient_at
from cathsim_dmc.collision.native import numbers, shorts, wholes, word
from cathsim_dmc.collision.table import BORE
from cathsim_dmc.compiled import compiled

EVERY = 1e-3  # m, apart are the places of a capsule that are looked at first
_PLACES = 65  # at most
# A dent of the clearance must be so deep, m, to be a contact of its own: a capsule
# that lies flat on a wall has many that are none.
_DENT = 5e-6
_FLAT = 2e-6
_BISECTIONS = 6
_STEP = 0.25e-3  # m, to both sides, over which the wall's normal is taken
_FAR = 1e-3  # m, by which the coarse lattice may be wrong far from the wall
NONE = (0, 0.0, FREE, 0.0, FREE)  # of `touches`


@compiled
def bore_at(head, x, y, z):
    """Clearance in a bore around a line, m, and the way (3) m to the nearest place."""
    count = int(head[0])
    best, value, way = np.inf, FREE, (0.0, 0.0, 0.0)
    for k in range(count - 1):
        a, b = 1 + 4 * k, 5 + 4 * k
        dx, dy = head[b] - head[a], head[b + 1] - head[a + 1]
        dz = head[b + 2] - head[a + 2]
        px, py, pz = x - head[a], y - head[a + 1], z - head[a + 2]
        u = (px * dx + py * dy + pz * dz) / (dx * dx + dy * dy + dz * dz)
        beyond = (k == 0 and u < 0.0) or (k == count - 2 and u > 1.0)
        u = min(max(u, 0.0), 1.0)
        qx, qy, qz = px - u * dx, py - u * dy, pz - u * dz
        square = qx * qx + qy * qy + qz * qz
        if square < best:
            best = square
            value = FREE
            if not beyond:
                value = (1.0 - u) * head[a + 3] + u * head[b + 3] - math.sqrt(square)
            way = (-qx, -qy, -qz)
    return value, way


@compiled
def lumen(entry):
    """Head, coarse lattice, index and samples of an entry's `Field`."""
    coarse, index = shorts(word(entry + 32)), wholes(word(entry + 40))
    return numbers(word(entry + 24)), coarse, index, shorts(word(entry + 48))


@compiled
def clearance(entry, x, y, z):
    """Distance (m) from the wall of an entry's field, `FREE` past its open ends."""
    if word(entry + 8) == BORE:
        return bore_at(numbers(word(entry + 24)), x, y, z)[0]
    return clearance_at(*lumen(entry), x, y, z)


@compiled
def length(way):
    """Length of a vector (3)."""
    return math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)


@compiled
def across(one, other):
    """Cross product (3) of two vectors."""
    return (
        one[1] * other[2] - one[2] * other[1],
        one[2] * other[0] - one[0] * other[2],
        one[0] * other[1] - one[1] * other[0],
    )


@compiled
def away(entry, x, y, z):
    """Unit vector (3) away from the wall; zeros where there is none."""
    if word(entry + 8) == BORE:
        way = bore_at(numbers(word(entry + 24)), x, y, z)[1]
    else:
        way = gradient_at(*lumen(entry), x, y, z, _STEP)
    norm = length(way)
    if norm < 1e-12:
        return (0.0, 0.0, 0.0)
    return (way[0] / norm, way[1] / norm, way[2] / norm)


@compiled
def along(centre, axis, t):
    """Place (3) m along a capsule's axis."""
    x, y, z = centre
    return (x + t * axis[0], y + t * axis[1], z + t * axis[2])


@compiled
def clearance_along(entry, centre, axis, t):
    """Clearance (m) of a place along a capsule's axis."""
    x, y, z = along(centre, axis, t)
    return clearance(entry, x, y, z)


@compiled
def dented(values, count, i, closed):
    """Whether the clearance rises to both sides of a place: it is a contact by itself.

    It rises by `_DENT`, or up to an end that is no contact.
    """
    for side, way in enumerate((-1, 1)):
        rise, k = 0.0, i + way
        while 0 <= k < count and values[k] >= values[i] and rise < _DENT:
            rise = max(rise, values[k] - values[i])
            k += way
        if rise >= _DENT:
            continue
        if 0 <= k < count or not closed[side]:
            return False
        if values[k - way] <= values[k - 2 * way] + _FLAT:
            return False
    return True


@compiled
def lowest(entry, centre, axis, half, t, value, step):
    """Place (m along a capsule) of the least clearance within a step of t, and it.

    Bisected, because the clearance has a kink at an edge of the wall; then a parabola.
    """
    left, right = max(t - step, -half), min(t + step, half)
    before = clearance_along(entry, centre, axis, left)
    after = clearance_along(entry, centre, axis, right)
    for _ in range(_BISECTIONS):
        upper = right - t > t - left
        place = 0.5 * (t + (right if upper else left))
        there = clearance_along(entry, centre, axis, place)
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
    one, other = (after - value) * (t - left), (before - value) * (right - t)
    if one > 0.0 and other > 0.0:
        place = t + 0.5 * (other * (right - t) - one * (t - left)) / (one + other)
        there = clearance_along(entry, centre, axis, place)
        if there < value:
            t, value = place, there
    return t, value


@compiled
def straight(entry):
    """Whether an entry is a bore with one piece."""
    return word(entry + 8) == BORE and numbers(word(entry + 24))[0] == 2.0


@compiled
def in_straight_bore(head, centre, axis, half, closed, limit):
    """As `touches`, in a bore with one piece: nearest to it are ends, or its rim.

    Within, the clearance is a concave function of the place along the capsule.
    """
    dx, dy, dz = head[5] - head[1], head[6] - head[2], head[7] - head[3]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / length, dy / length, dz / length
    level = (centre[0] - head[1]) * dx + (centre[1] - head[2]) * dy
    level += (centre[2] - head[3]) * dz
    rate = axis[0] * dx + axis[1] * dy + axis[2] * dz
    low, high, first, second = -half, half, closed[0], closed[1]
    if abs(rate) > 1e-9:
        near, far = -level / rate, (length - level) / rate
        near, far = min(near, far), max(near, far)
        if near > low:
            low, first = near, True
        if far < high:
            high, second = far, True
    elif not 0.0 <= level <= length:
        return NONE
    if low > high:
        return NONE
    lower, higher = FREE, FREE
    for end in range(1 if half == 0.0 else 2):
        if not (second if end else first):
            continue
        x, y, z = along(centre, axis, high if end else low)
        px, py, pz = x - head[1], y - head[2], z - head[3]
        way = px * dx + py * dy + pz * dz
        qx, qy, qz = px - way * dx, py - way * dy, pz - way * dz
        radius = head[4] + (head[8] - head[4]) * way / length
        value = radius - math.sqrt(qx * qx + qy * qy + qz * qz)
        if end:
            higher = value
        else:
            lower = value
    if lower > limit:
        return (int(higher <= limit), high, higher, 0.0, FREE)
    return (1 + int(higher <= limit), low, lower, high, higher)


@compiled
def apart(entry, centre, axis, half, limit):
    """Whether a capsule is farther from the wall than the limit, m, by its middle."""
    middle = clearance(entry, centre[0], centre[1], centre[2])
    if middle < FREE:
        return middle - half > limit + _FAR
    return (
        half > 0.0
        and clearance_along(entry, centre, axis, -half) >= FREE
        and clearance_along(entry, centre, axis, half) >= FREE
    )


@compiled
def sampled(entry, centre, axis, half, limit):
    """Clearances (n,) m of places along a capsule, and their distance apart, m.

    No places: the wall is farther than the limit, m. What the clearance of a neighbour
    keeps away from the wall is not looked up: it changes by at most the way, but where
    an open end begins.
    """
    count = 1
    if half > 0.0:
        count += min(max(int(math.ceil(2.0 * half / EVERY)), 2), _PLACES - 1)
    values = np.empty(count)
    step = 2.0 * half / max(count - 1, 1)
    least, i = np.inf, 0
    while i < count:
        value = values[i] = clearance_along(entry, centre, axis, -half + i * step)
        least = min(least, value)
        i += 1
        while i < count and value < FREE and value - step > limit + _FAR:
            value -= step
            values[i] = value
            i += 1
    if least > limit + step:
        return values[:0], 0.0
    return values, step


@compiled
def candidate(values, i, deepest, closed):
    """Whether a place is looked at closely, and whether it is an end left open."""
    count, value = len(values), values[i]
    if i == 0 or i == count - 1:
        beside = values[min(1, count - 1)] if i == 0 else values[i - 1]
        return value <= beside + _FLAT, not closed[0 if i == 0 else 1]
    if not (value <= values[i - 1] and value < values[i + 1]):
        return False, False
    return i == deepest or dented(values, count, i, closed), False


@compiled
def nearest(seen, t, value):
    """The two places that are nearest to the wall of those seen and one beyond them."""
    found, first, low, second, lower = seen
    if found == 2:
        if value >= max(low, lower):
            return seen
        if low > lower:
            first, low = second, lower
        found = 1
    if found:
        return (2, first, low, t, value)
    return (1, t, value, second, lower)


@compiled
def touches(entry, centre, axis, half, closed, limit):
    """Places of a capsule's axis that are nearest to the wall, two at most.

    Args:
        entry: address of the field's entry.
        centre: (3) m, of the capsule.
        axis: (3) unit vector along it.
        half: m, half its length without the round ends.
        closed: (2) whether the ends at -half and half are looked at.
        limit: m; what is farther from the wall does not count.

    Returns:
        Number of places; of each, m along the axis and the clearance there, m.
    """
    if straight(entry):
        head = numbers(word(entry + 24))
        return in_straight_bore(head, centre, axis, half, closed, limit)
    seen = NONE
    if apart(entry, centre, axis, half, limit):
        return seen
    values, step = sampled(entry, centre, axis, half, limit)
    if len(values) == 0:
        return seen
    deepest = 0
    for i in range(1, len(values)):
        if values[i] < values[deepest]:
            deepest = i
    for i in range(len(values)):
        close, left_open = candidate(values, i, deepest, closed)
        t, value = -half + i * step, values[i]
        if not close or value > limit + step:
            continue
        if half > 0.0:
            t, value = lowest(entry, centre, axis, half, t, value, step)
            if left_open and values[i] - value < _DENT:
                continue
        if value <= limit:
            seen = nearest(seen, t, value)
    return seen
