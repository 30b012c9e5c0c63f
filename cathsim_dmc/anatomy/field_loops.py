"""Looking up a field, compiled; see `anatomy.field.Field` for what the arrays hold."""

from __future__ import annotations

import math

from cathsim_dmc.compiled import compiled

# Places in the head of a field.
ORIGIN, EDGE, SHAPE, QUANTUM, ENDS = 0, 3, 4, 7, 8
# Numbers of an open end: position, outward direction, radii of lumen and of its hole.
END, FIRST_END = 8, 9
MARGIN = 4e-3  # m, by which the box of a field exceeds the lumen
FREE = 1.0  # m, depth of what lies behind an open end
# m behind an open end, in which a device is free; farther off a vessel may pass.
_NEAR = 28e-3
_THICK = 5e-3  # m, more than any wall past the plane of an open end


@compiled
def _over(head, number, x, y, z):
    """Height (m) of a point over an open end, and squared distance from its axis."""
    at = FIRST_END + END * number
    dx, dy, dz = x - head[at], y - head[at + 1], z - head[at + 2]
    level = dx * head[at + 3] + dy * head[at + 4] + dz * head[at + 5]
    return level, dx * dx + dy * dy + dz * dz - level * level


@compiled
def behind(head, x, y, z):
    """How far (m) a point lies behind an open end of the lumen; 0 for all others."""
    for number in range(int(head[ENDS])):
        level, across = _over(head, number, x, y, z)
        at = FIRST_END + END * number
        if 0.0 < level < _NEAR and across < min(head[at + 6], head[at + 7]) ** 2:
            return level
    return 0.0


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
    """Depth (m) at a point where flat caps leave holes in open ends."""
    value = depth_at(head, coarse, index, samples, x, y, z)
    for number in range(int(head[ENDS])):
        at = FIRST_END + END * number
        radius, hole = head[at + 6], head[at + 7]
        if hole >= radius:
            continue
        level, across = _over(head, number, x, y, z)
        across = math.sqrt(max(across, 0.0))
        if hole < across <= radius:
            value = min(value, -level)
        elif across <= hole and level <= 0.0:
            value = min(value, math.hypot(level, hole - across))
    return value


@compiled
def clearance_at(head, coarse, index, samples, x, y, z):
    """Depth (m) at a point; `FREE` behind an open end, and beside it but for a wall."""
    if behind(head, x, y, z) > 0.0:
        return FREE
    depth = walled_at(head, coarse, index, samples, x, y, z)
    edge = head[EDGE]
    boxed = (
        0.0 <= x - head[0] <= edge * head[SHAPE]
        and 0.0 <= y - head[1] <= edge * head[SHAPE + 1]
        and 0.0 <= z - head[2] <= edge * head[SHAPE + 2]
    )
    if depth < -_THICK or not boxed:
        for number in range(int(head[ENDS])):
            if _over(head, number, x, y, z)[0] > 0.0:
                return FREE
    return depth


@compiled
def depths(field, points, free, out):
    """Depths (n,) m at points (n, 3) m; behind open ends `FREE`, or outside."""
    for n in range(len(points)):
        x, y, z = points[n]
        if not math.isfinite(x + y + z):
            out[n] = math.nan
        elif free:
            out[n] = clearance_at(*field, x, y, z)
        else:
            level = behind(field[0], x, y, z)
            out[n] = -level if level > 0.0 else depth_at(*field, x, y, z)


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
def gradients(field, points, step, out):
    """Gradients (n, 3) of the depth at points (n, 3) m."""
    for n in range(len(points)):
        x, y, z = points[n]
        out[n] = math.nan
        if math.isfinite(x + y + z):
            out[n, 0], out[n, 1], out[n, 2] = gradient_at(*field, x, y, z, step)
            out[n] /= 2.0 * step
