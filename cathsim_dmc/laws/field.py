"""Signed depth in a lumen, interpolated on sparse bricks of a lattice.

The depth is the distance to the wall, > 0 inside. Space is divided into cubic bricks.
A brick beside the wall holds a finer lattice of its own; every other brick has the
depths at its eight corners. Between the points of a lattice the depth is trilinear
(https://en.wikipedia.org/wiki/Trilinear_interpolation). `anatomy.field.Field` samples
the arrays.

An open end lets a device pass: behind it, in the straight continuation of the lumen,
the clearance is `FREE`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from cathsim_dmc.compiled import inlined, law

# Offsets in the head of a field.
EDGE, SHAPE, QUANTUM, ENDS = 3, 4, 7, 8
# Numbers of an open end: position, outward direction, radii of the lumen and of the
# hole in its cap.
END, FIRST_END = 8, 9
FREE = 1.0  # m, clearance of a place behind an open end
# m behind an open end in which a device is free; another vessel may lie farther off.
BEHIND = 28e-3
_THICK = 5e-3  # m, above the thickness of any wall past the plane of an open end


class FieldArrays(NamedTuple):
    """Arrays of a field; see `anatomy.field.Field`, whose `index` is `bricks` here.

    Attributes:
        head: float64; origin (3) m, edge of a brick m, bricks along x, y and z (3),
            m per unit of depth, number of open ends, and each of these (`END`).
        coarse: int16, depths at the corners of the bricks.
        bricks: int32, first place of a brick in `samples`, -1 for none.
        samples: int16; of each brick the number n of cells along its edge, then
            (n + 1)³ depths.
    """

    head: Any
    coarse: Any
    bricks: Any
    samples: Any


@inlined
def _over(head, number, point):
    """Height (m) of a point over an open end, and squared distance from its axis."""
    at = FIRST_END + END * number
    dx, dy, dz = point[0] - head[at], point[1] - head[at + 1], point[2] - head[at + 2]
    level = dx * head[at + 3] + dy * head[at + 4] + dz * head[at + 5]
    return level, dx * dx + dy * dy + dz * dz - level * level


@inlined
def behind(head, point):
    """Distance (m) of a point behind an open end of the lumen; 0 elsewhere."""
    for number in range(int(head[ENDS])):
        level, across = _over(head, number, point)
        at = FIRST_END + END * number
        if 0.0 < level < BEHIND and across < min(head[at + 6], head[at + 7]) ** 2:
            return level
    return 0.0


@inlined
def _trilinear(values, corner, strides, share):
    """Value in the cell of a lattice whose first corner is `values[corner]`."""
    (sy, sz), (u, v, w), at = strides, share, corner
    low = (1.0 - v) * ((1.0 - w) * values[at] + w * values[at + 1])
    low += v * ((1.0 - w) * values[at + sz] + w * values[at + sz + 1])
    at += sy * sz
    high = (1.0 - v) * ((1.0 - w) * values[at] + w * values[at + 1])
    high += v * ((1.0 - w) * values[at + sz] + w * values[at + sz + 1])
    return (1.0 - u) * low + u * high


@inlined
def depth_at(field, point):
    """Depth (m) at a point (3) m, open ends not considered."""
    head, (x, y, z) = field.head, point
    edge = head[EDGE]
    a, b, c = int(head[SHAPE]), int(head[SHAPE + 1]), int(head[SHAPE + 2])
    u, v, w = (x - head[0]) / edge, (y - head[1]) / edge, (z - head[2]) / edge
    # NaN goes to the first cell: `max` would keep NaN, which is no valid index.
    uu = min(u if u > 0.0 else 0.0, a - 1e-9)
    vv = min(v if v > 0.0 else 0.0, b - 1e-9)
    ww = min(w if w > 0.0 else 0.0, c - 1e-9)
    i, j, k = int(uu), int(vv), int(ww)
    beyond = 0.0
    if u != uu or v != vv or w != ww:
        beyond = edge * math.sqrt((u - uu) ** 2 + (v - vv) ** 2 + (w - ww) ** 2)
    start = field.bricks[(i * b + j) * c + k]
    uu, vv, ww = uu - i, vv - j, ww - k
    if start < 0:
        corner, strides = (i * (b + 1) + j) * (c + 1) + k, (b + 1, c + 1)
        value = _trilinear(field.coarse, corner, strides, (uu, vv, ww))
    else:
        n = int(field.samples[start])
        uu, vv, ww = uu * n, vv * n, ww * n
        i, j, k = int(uu), int(vv), int(ww)
        corner, strides = start + 1 + (i * (n + 1) + j) * (n + 1) + k, (n + 1, n + 1)
        share = (uu - i, vv - j, ww - k)
        value = _trilinear(field.samples, corner, strides, share)
    depth = head[QUANTUM] * value
    # Points beyond the box are outside, even where a lumen leaves it at an open end.
    return depth if beyond == 0.0 else min(depth, 0.0) - beyond


@inlined
def _cap_distance(level, across, hole):
    """Signed distance (m) of a flat cap with a hole (m), > 0 outside of the cap.

    Args:
        level: m behind the front of the cap.
        across: m from the axis of the hole.
        hole: Radius of the hole, m.
    """
    if across > hole:
        # A tilted sheath leaves the straight continuation of the hole. Past `_THICK`,
        # `field_clearance` takes the depth -level for free.
        if level <= 0.0 or level >= _THICK:
            return -level
        return -min(level, across - hole)
    if level >= _THICK:
        return FREE
    return math.hypot(min(level, 0.0), hole - across)


@inlined
def walled_depth(field, point):
    """Depth (m) at a point (3) m, with flat caps that leave holes in open ends.

    A cap reaches back to `BEHIND`.
    """
    head, value = field.head, depth_at(field, point)
    for number in range(int(head[ENDS])):
        at = FIRST_END + END * number
        radius, hole = head[at + 6], head[at + 7]
        if hole >= radius:
            continue
        level, across = _over(head, number, point)
        across = math.sqrt(max(across, 0.0))
        if level < BEHIND and across <= radius:
            value = min(value, _cap_distance(level, across, hole))
    return value


@inlined
def field_clearance(field, point):
    """Depth (m) at a point (3) m; `FREE` past open ends, except inside a wall there."""
    head = field.head
    if behind(head, point) > 0.0:
        return FREE
    depth = walled_depth(field, point)
    edge = head[EDGE]
    boxed = (
        0.0 <= point[0] - head[0] <= edge * head[SHAPE]
        and 0.0 <= point[1] - head[1] <= edge * head[SHAPE + 1]
        and 0.0 <= point[2] - head[2] <= edge * head[SHAPE + 2]
    )
    if depth < -_THICK or not boxed:
        for number in range(int(head[ENDS])):
            if _over(head, number, point)[0] > 0.0:
                return FREE
    return depth


@law
def field_gradient(field, point, step):
    """Central differences (3) of the depth at a point (3) m, `step` m to each side.

    They are 2 `step` times the gradient. Points past open ends are not `FREE`.
    """
    slopes = (0.0, 0.0, 0.0)
    for axis in range(3):
        dx = step if axis == 0 else 0.0
        dy = step if axis == 1 else 0.0
        dz = step if axis == 2 else 0.0
        high = (point[0] + dx, point[1] + dy, point[2] + dz)
        low = (point[0] - dx, point[1] - dy, point[2] - dz)
        slope = walled_depth(field, high) - walled_depth(field, low)
        slopes = (slopes[1], slopes[2], slope)
    return slopes


@law
def depths(field, points, free, out):
    """Writes depths (n,) m at points (n, 3) m, NaN where these are not finite.

    Behind an open end the depth is `FREE`, or, where `free` is false, minus the
    distance from the plane of the end.
    """
    for n in range(len(points)):
        x, y, z = points[n]
        if not math.isfinite(x + y + z):
            out[n] = math.nan
        elif free:
            out[n] = field_clearance(field, (x, y, z))
        else:
            level = behind(field.head, (x, y, z))
            out[n] = -level if level > 0.0 else depth_at(field, (x, y, z))


@law
def gradients(field, points, step, out):
    """Writes gradients (n, 3) of the depth at points (n, 3) m, NaN if not finite."""
    for n in range(len(points)):
        x, y, z = points[n]
        out[n] = math.nan
        if math.isfinite(x + y + z):
            slopes = field_gradient(field, (x, y, z), step)
            for axis in range(3):
                out[n, axis] = slopes[axis] / (2.0 * step)
