"""Looking up a field, compiled; see `anatomy.field.Field` for what the arrays hold."""

from __future__ import annotations

import math

from cathsim_dmc.compiled import compiled

# Places in the head of a field.
ORIGIN, EDGE, SHAPE, QUANTUM, ENDS = 0, 3, 4, 7, 8
# Numbers of an open end: position, outward direction, radii of lumen and of its hole.
END, FIRST_END = 8, 9
FREE = 1.0  # m, depth of what lies behind an open end
# As far behind an open end a device is free, m: two bricks more than the lattices there
# belong to it. Farther off another vessel may pass.
_NEAR = 28e-3
# Past the plane of an open end, no wall is so thick, m.
_THICK = 5e-3


@compiled
def behind(head, x, y, z):
    """How far (m) a point lies behind an open end of the lumen; 0 for all others."""
    for number in range(int(head[ENDS])):
        at = FIRST_END + END * number
        dx, dy, dz = x - head[at], y - head[at + 1], z - head[at + 2]
        level = dx * head[at + 3] + dy * head[at + 4] + dz * head[at + 5]
        if 0.0 < level < _NEAR:
            across = dx * dx + dy * dy + dz * dz - level * level
            if across < min(head[at + 6], head[at + 7]) ** 2:
                return level
    return 0.0


@compiled
def capped(head, value, x, y, z):
    """Depth (m) where flat caps leave holes in open ends, from that without caps."""
    for number in range(int(head[ENDS])):
        at = FIRST_END + END * number
        radius, hole = head[at + 6], head[at + 7]
        if hole >= radius:
            continue
        dx, dy, dz = x - head[at], y - head[at + 1], z - head[at + 2]
        level = dx * head[at + 3] + dy * head[at + 4] + dz * head[at + 5]
        across = math.sqrt(max(dx * dx + dy * dy + dz * dz - level * level, 0.0))
        if hole < across <= radius:
            value = min(value, -level)
        elif across <= hole and level <= 0.0:
            value = min(value, math.hypot(level, hole - across))
    return value


@compiled
def boxed(head, x, y, z):
    """Whether a point lies in the box of the field."""
    edge = head[EDGE]
    return (
        0.0 <= x - head[0] <= edge * head[SHAPE]
        and 0.0 <= y - head[1] <= edge * head[SHAPE + 1]
        and 0.0 <= z - head[2] <= edge * head[SHAPE + 2]
    )


@compiled
def past(head, x, y, z):
    """Whether a point lies past the plane of an open end."""
    for number in range(int(head[ENDS])):
        at = FIRST_END + END * number
        level = (x - head[at]) * head[at + 3] + (y - head[at + 1]) * head[at + 4]
        if level + (z - head[at + 2]) * head[at + 5] > 0.0:
            return True
    return False


@compiled
def trilinear(values, first, sy, sz, i, j, k, u, v, w):
    """Value between the eight corners of cell (i, j, k) of a lattice."""
    at = first + (i * sy + j) * sz + k
    low = (1.0 - v) * ((1.0 - w) * values[at] + w * values[at + 1])
    low += v * ((1.0 - w) * values[at + sz] + w * values[at + sz + 1])
    at += sy * sz
    high = (1.0 - v) * ((1.0 - w) * values[at] + w * values[at + 1])
    high += v * ((1.0 - w) * values[at + sz] + w * values[at + sz + 1])
    return (1.0 - u) * low + u * high


@compiled
def depth_at(head, coarse, index, samples, x, y, z):
    """Depth (m) at a point, open ends not looked at."""
    edge = head[EDGE]
    a, b, c = int(head[SHAPE]), int(head[SHAPE + 1]), int(head[SHAPE + 2])
    u, v, w = (x - head[0]) / edge, (y - head[1]) / edge, (z - head[2]) / edge
    uu = min(max(u, 0.0), a - 1e-9)
    vv = min(max(v, 0.0), b - 1e-9)
    ww = min(max(w, 0.0), c - 1e-9)
    i, j, k = int(uu), int(vv), int(ww)
    beyond = 0.0
    if u != uu or v != vv or w != ww:
        beyond = edge * math.sqrt((u - uu) ** 2 + (v - vv) ** 2 + (w - ww) ** 2)
    start = index[(i * b + j) * c + k]
    uu, vv, ww = uu - i, vv - j, ww - k
    if start < 0:
        value = trilinear(coarse, 0, b + 1, c + 1, i, j, k, uu, vv, ww)
    else:
        n = samples[start]
        uu, vv, ww = uu * n, vv * n, ww * n
        i, j, k = int(uu), int(vv), int(ww)
        uu, vv, ww = uu - i, vv - j, ww - k
        value = trilinear(samples, start + 1, n + 1, n + 1, i, j, k, uu, vv, ww)
    depth = head[QUANTUM] * value
    # Beyond the box nothing is inside, though a lumen may leave it by an open end.
    return depth if beyond == 0.0 else min(depth, 0.0) - beyond


@compiled
def walled_at(head, coarse, index, samples, x, y, z):
    """Depth (m) at a point, without the holes of open ends."""
    return capped(head, depth_at(head, coarse, index, samples, x, y, z), x, y, z)


@compiled
def clearance_at(head, coarse, index, samples, x, y, z):
    """Depth (m) at a point; `FREE` behind an open end, and beside it but for a wall."""
    if behind(head, x, y, z) > 0.0:
        return FREE
    depth = walled_at(head, coarse, index, samples, x, y, z)
    if (depth < -_THICK or not boxed(head, x, y, z)) and past(head, x, y, z):
        return FREE
    return depth


@compiled
def depths(head, coarse, index, samples, points, free, out):
    """Depths (n,) m at points (n, 3) m; behind open ends `FREE`, or outside."""
    for n in range(len(points)):
        x, y, z = points[n]
        if free:
            out[n] = clearance_at(head, coarse, index, samples, x, y, z)
            continue
        level = behind(head, x, y, z)
        out[n] = depth_at(head, coarse, index, samples, x, y, z)
        if level > 0.0:
            out[n] = -level


@compiled
def gradient_at(head, coarse, index, samples, x, y, z, step):
    """Central differences of the depth at a point, over `step` (m) to each side."""
    return (
        walled_at(head, coarse, index, samples, x + step, y, z)
        - walled_at(head, coarse, index, samples, x - step, y, z),
        walled_at(head, coarse, index, samples, x, y + step, z)
        - walled_at(head, coarse, index, samples, x, y - step, z),
        walled_at(head, coarse, index, samples, x, y, z + step)
        - walled_at(head, coarse, index, samples, x, y, z - step),
    )


@compiled
def gradients(head, coarse, index, samples, points, step, out):
    """Gradients (n, 3) of the depth at points (n, 3) m."""
    for n in range(len(points)):
        x, y, z = points[n]
        gx, gy, gz = gradient_at(head, coarse, index, samples, x, y, z, step)
        out[n, 0], out[n, 1], out[n, 2] = gx, gy, gz
        out[n] /= 2.0 * step
