"""Clearance in a round bore around a polyline: the inside of an introducer sheath.

A bore is one float64 array, `line`: the number of its points, then x, y, z and radius,
m, of each. Its ends are open.

The clearance at a point is the radius, interpolated at the nearest place of the line,
minus the distance from that place. Past an open end it is `FREE`.
"""

import math

import numpy as np

from cathsim_dmc.compiled import inlined, law
from cathsim_dmc.laws.field import FREE
from cathsim_dmc.laws.places import Places
from cathsim_dmc.laws.vectors import along

_LEVEL = 1e-9  # cosine of capsule and bore below which they are perpendicular


@law
def bore_clearance(line, point):
    """Clearance (m) at a point (3) m, and the vector (3) m to the nearest place."""
    count = int(line[0])
    x, y, z = point
    best, value, way = np.inf, FREE, (0.0, 0.0, 0.0)
    for k in range(count - 1):
        a, b = 1 + 4 * k, 5 + 4 * k
        dx, dy = line[b] - line[a], line[b + 1] - line[a + 1]
        dz = line[b + 2] - line[a + 2]
        px, py, pz = x - line[a], y - line[a + 1], z - line[a + 2]
        u = (px * dx + py * dy + pz * dz) / (dx * dx + dy * dy + dz * dz)
        beyond = (k == 0 and u < 0.0) or (k == count - 2 and u > 1.0)
        u = min(max(u, 0.0), 1.0)
        qx, qy, qz = px - u * dx, py - u * dy, pz - u * dz
        square = qx * qx + qy * qy + qz * qz
        if square < best:
            best = square
            value = FREE
            if not beyond:
                value = (1.0 - u) * line[a + 3] + u * line[b + 3] - math.sqrt(square)
            way = (-qx, -qy, -qz)
    return value, way


@inlined
def straight_bore_places(line, capsule, limit):
    """Places of a capsule nearest to the wall of a bore of one segment.

    Within the bore the clearance is a concave function of the place along the capsule.
    Its minima are therefore at the capsule's ends, or where the capsule crosses an end
    plane of the bore. Arguments and result are those of `capsule.nearest_places`.
    """
    centre, axis, half = capsule.centre, capsule.axis, capsule.half_length
    dx, dy, dz = line[5] - line[1], line[6] - line[2], line[7] - line[3]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / length, dy / length, dz / length
    level = (centre[0] - line[1]) * dx + (centre[1] - line[2]) * dy
    level += (centre[2] - line[3]) * dz
    rate = axis[0] * dx + axis[1] * dy + axis[2] * dz
    low, high = -half, half
    first, second = capsule.caps[0], capsule.caps[1]
    none = Places(0, 0.0, FREE, 0.0, FREE)
    if abs(rate) > _LEVEL:
        near, far = -level / rate, (length - level) / rate
        near, far = min(near, far), max(near, far)
        if near > low:
            low, first = near, True
        if far < high:
            high, second = far, True
    elif not 0.0 <= level <= length:
        return none
    if low > high:
        return none
    lower, higher = FREE, FREE
    for end in range(1 if half == 0.0 else 2):
        if not (second if end else first):
            continue
        x, y, z = along(centre, axis, high if end else low)
        px, py, pz = x - line[1], y - line[2], z - line[3]
        way = px * dx + py * dy + pz * dz
        qx, qy, qz = px - way * dx, py - way * dy, pz - way * dz
        radius = line[4] + (line[8] - line[4]) * way / length
        value = radius - math.sqrt(qx * qx + qy * qy + qz * qz)
        if end:
            higher = value
        else:
            lower = value
    if lower > limit:
        return Places(int(higher <= limit), high, higher, 0.0, FREE)
    return Places(1 + int(higher <= limit), low, lower, high, higher)
