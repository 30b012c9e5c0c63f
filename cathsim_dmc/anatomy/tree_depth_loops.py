"""Distances to the wall of a vessel tree, compiled; see `anatomy.tree_depth`."""

from __future__ import annotations

import math

import numpy as np

from cathsim_dmc.compiled import compiled

# A place on a wall that lies no further than this inside another vessel is wall, m.
_TOUCHING = 5e-6
# As far behind an open end, m, its lumen goes on; another vessel may pass farther off.
_BEHIND = 20e-3


@compiled
def ring(nodes, k, u, x, y, z):
    """A ring between nodes k and k + 1: axial and radial place of a point, radius.

    Nodes are rows of centre (3), unit tangent (3) and radius.
    """
    v = 1.0 - u
    a, b = nodes[k], nodes[k + 1]
    dx = x - (v * a[0] + u * b[0])
    dy = y - (v * a[1] + u * b[1])
    dz = z - (v * a[2] + u * b[2])
    tx, ty, tz = v * a[3] + u * b[3], v * a[4] + u * b[4], v * a[5] + u * b[5]
    axial = (dx * tx + dy * ty + dz * tz) / math.sqrt(tx * tx + ty * ty + tz * tz)
    across = max(dx * dx + dy * dy + dz * dz - axial * axial, 0.0)
    return axial, math.sqrt(across), v * a[6] + u * b[6]


@compiled
def squared(nodes, k, u, x, y, z):
    """Squared distance of a point from a ring."""
    axial, radial, radius = ring(nodes, k, u, x, y, z)
    return axial * axial + (radial - radius) ** 2


@compiled
def at_node(nodes, k, x, y, z):
    """Squared distance of a point from the ring of a node."""
    dx, dy, dz = x - nodes[k, 0], y - nodes[k, 1], z - nodes[k, 2]
    axial = dx * nodes[k, 3] + dy * nodes[k, 4] + dz * nodes[k, 5]
    whole = dx * dx + dy * dy + dz * dz
    radius = nodes[k, 6]
    # axial² + (radial - radius)²
    across = math.sqrt(max(whole - axial * axial, 0.0))
    return whole + radius * (radius - 2.0 * across)


@compiled
def nearest(nodes, first, last, chosen, count, x, y, z):
    """The ring of one vessel that is nearest to a point: (segment, share, square)."""
    best, at = np.inf, first
    for n in range(count):
        k = chosen[n]
        value = at_node(nodes, k, x, y, z)
        if value < best:
            best, at = value, k
    # In a segment the square is a parabola, but for how much the tangent turns.
    place, value = min(at, last - 1), best
    share = 1.0 if at == last else 0.0
    for k in range(max(at - 1, first), min(at + 1, last)):
        f0, f1 = at_node(nodes, k, x, y, z), at_node(nodes, k + 1, x, y, z)
        middle = squared(nodes, k, 0.5, x, y, z)
        bend, slope = 2.0 * f0 - 4.0 * middle + 2.0 * f1, 4.0 * middle - 3.0 * f0 - f1
        if bend <= 0.0 or slope >= 0.0 or -slope >= 2.0 * bend:
            continue
        u = -0.5 * slope / bend
        lower = squared(nodes, k, u, x, y, z)
        if lower < value:
            place, share, value = k, u, lower
    return place, share, value


@compiled
def signed(nodes, first, last, flats, chosen, count, x, y, z, out):
    """Signed depth (m) in one vessel, and the nearest place of its wall in `out`.

    `flats` says of the first and of the last end: 0 open, 1 closed by a flat wall.
    """
    k, u, value = nearest(nodes, first, last, chosen, count, x, y, z)
    axial, radial, radius = ring(nodes, k, u, x, y, z)
    inside = radial < radius
    # The place on the ring, in the point's half plane.
    a, b, v = nodes[k], nodes[k + 1], 1.0 - u
    tx, ty, tz = v * a[3] + u * b[3], v * a[4] + u * b[4], v * a[5] + u * b[5]
    shift = axial / math.sqrt(tx * tx + ty * ty + tz * tz)
    cx, cy, cz = v * a[0] + u * b[0], v * a[1] + u * b[1], v * a[2] + u * b[2]
    ex, ey, ez = x - cx - shift * tx, y - cy - shift * ty, z - cz - shift * tz
    length = math.sqrt(ex * ex + ey * ey + ez * ez)
    if length < 1e-12:
        ex, ey, ez = ty - tz, tz - tx, tx - ty
        length = math.sqrt(ex * ex + ey * ey + ez * ez)
    scale = radius / length
    out[0], out[1], out[2] = cx + scale * ex, cy + scale * ey, cz + scale * ez
    distance = math.sqrt(max(value, 0.0))
    place = k + u
    for end in range(2):
        k, u, way = (first, 0.0, -1.0) if end == 0 else (last - 1, 1.0, 1.0)
        axial, radial, radius = ring(nodes, k, u, x, y, z)
        level = way * axial
        if radial > radius or (level <= 0.0 and flats[end] != 1):
            continue
        if level > 0.0:
            if abs(place - k - u) > 0.01:
                continue  # beside another part of a vessel that turns back
            # Beyond an open end the lumen goes on as a straight tube.
            inside = flats[end] == 0 and level < _BEHIND
        if flats[end] == 1 and abs(level) < distance:
            distance = abs(level)
            node = nodes[first] if end == 0 else nodes[last]
            out[0] = x - axial * node[3]
            out[1] = y - axial * node[4]
            out[2] = z - axial * node[5]
    return distance if inside else -distance


@compiled
def _square(place, x, y, z):
    return (place[0] - x) ** 2 + (place[1] - y) ** 2 + (place[2] - z) ** 2


@compiled
def _rings_near(nodes, among, x, y, z, margin, chosen):
    """Those of the rings of one vessel that matter around a place, and its depth.

    They are put into `chosen`; the first is their number.
    """
    best, deepest, count = np.inf, -np.inf, 0
    for k in among:
        best = min(best, at_node(nodes, k, x, y, z))
        deepest = max(deepest, nodes[k, 6] - math.sqrt(_square(nodes[k], x, y, z)))
    limit = (math.sqrt(best) + margin) ** 2
    for k in among:
        if at_node(nodes, k, x, y, z) <= limit:
            chosen[count] = k
            count += 1
    return count, deepest


@compiled
def _creases_near(creases, among, x, y, z, margin, near):
    """Number of the creases that matter around a place, which are put into `near`."""
    closest, found = np.inf, 0
    for c in among:
        closest = min(closest, _square(creases[c], x, y, z))
    limit = (math.sqrt(closest) + margin) ** 2
    for c in among:
        if _square(creases[c], x, y, z) <= limit:
            near[found] = c
            found += 1
    return found


@compiled
def tree_depths(
    nodes, spans, flats, creases, blocks, points, reach, groups, middles, reaches,
    slack, out,
):  # fmt: skip
    """Signed distance to the wall at every point of every block.

    Args:
        nodes: (m, 7) centres, unit tangents and radii of all vessels.
        spans: (v, 2) first and last node of each vessel.
        flats: (v, 2) 0 open, 1 closed, 2 within another vessel, of both ends.
        creases: (c, 3) points where walls of two vessels meet.
        blocks: (n, 3) middles of the blocks, m.
        points: (q, 3) relative to the middle of a block, m, within `reach`.
        reach: m.
        groups: (q,) number of the group of each point.
        middles: (g, 3) of the groups, relative to the middle of a block, m.
        reaches: (g,) of the groups, m.
        slack: m; farther vessels do not matter.
        out: (n, q) m, > 0 inside.
    """
    vessels = len(spans)
    rings, edges = np.arange(len(nodes)), np.arange(len(creases))
    wide = np.empty((vessels, len(nodes)), np.int64)
    close = np.empty((vessels, len(nodes)), np.int64)
    many, few = np.empty(vessels, np.int64), np.empty(vessels, np.int64)
    level, depths = np.empty(vessels), np.empty(vessels)
    around, near = np.empty(len(creases), np.int64), np.empty(len(creases), np.int64)
    wall, there = np.empty(3), np.empty(3)
    for n in range(len(blocks)):
        x, y, z = blocks[n]
        for v in range(vessels):
            first, last = spans[v]
            many[v], level[v] = _rings_near(
                nodes, rings[first : last + 1], x, y, z, 2.0 * reach + slack, wide[v]
            )
        bar = level.max() - 2.0 * reach - slack
        margin = 2.0 * reach + 1e-6
        found = _creases_near(creases, edges, x, y, z, margin, around)
        for g in range(len(middles)):
            gx, gy, gz = x + middles[g, 0], y + middles[g, 1], z + middles[g, 2]
            margin = 2.0 * reaches[g] + 1e-6
            for v in range(vessels):
                if level[v] >= bar:
                    few[v], depths[v] = _rings_near(
                        nodes, wide[v, : many[v]], gx, gy, gz, margin, close[v]
                    )
                else:
                    depths[v] = -np.inf
            lowest = depths.max() - 2.0 * reaches[g] - slack
            left = _creases_near(creases, around[:found], gx, gy, gz, margin, near)
            for q in range(len(points)):
                if groups[q] == g:
                    out[n, q] = _tree_depth(
                        nodes, spans, flats, wide, many, close, few, depths, lowest,
                        level, bar - slack, creases, near[:left],
                        x + points[q, 0], y + points[q, 1], z + points[q, 2],
                        wall, there,
                    )  # fmt: skip


@compiled
def _tree_depth(
    nodes, spans, flats, wide, many, close, few, depths, lowest, level, bar, creases,
    near, x, y, z, wall, there,
):  # fmt: skip
    """Signed distance of one point, m; rings and creases that matter are given."""
    inside, distance = False, np.inf
    for v in range(len(spans)):
        if depths[v] < lowest:
            continue
        first, last = spans[v]
        depth = signed(nodes, first, last, flats[v], close[v], few[v], x, y, z, wall)
        inside = inside or depth > 0.0
        if abs(depth) >= distance:
            continue
        valid = True
        for w in range(len(spans)):
            if w == v or level[w] < bar:
                continue
            first, last = spans[w]
            other = signed(
                nodes, first, last, flats[w], wide[w], many[w],
                wall[0], wall[1], wall[2], there,
            )  # fmt: skip
            if other > _TOUCHING:
                valid = False
                break
        if valid:
            distance = abs(depth)
    closest = np.inf
    for c in near:
        closest = min(closest, _square(creases[c], x, y, z))
    distance = min(distance, math.sqrt(closest))
    return distance if inside else -distance


@compiled
def onto_creases(nodes, spans, flats, one, two, seeds, rounds, out):
    """Moves seeds (n, 3) to where the walls of two vessels meet; (n, 2) depths left."""
    place = np.empty(3)
    first1, last1 = spans[one]
    first2, last2 = spans[two]
    all1, all2 = np.arange(first1, last1 + 1), np.arange(first2, last2 + 1)
    for n in range(len(seeds)):
        for _ in range(rounds):
            x, y, z = seeds[n]
            signed(nodes, first1, last1, flats[one], all1, len(all1), x, y, z, place)
            x, y, z = place
            signed(nodes, first2, last2, flats[two], all2, len(all2), x, y, z, place)
            seeds[n, 0], seeds[n, 1], seeds[n, 2] = place[0], place[1], place[2]
        x, y, z = seeds[n]
        for row in range(2):
            v = one if row == 0 else two
            first, last = spans[v]
            nodes_of = all1 if row == 0 else all2
            out[n, row] = signed(
                nodes, first, last, flats[v], nodes_of, len(nodes_of), x, y, z, place
            )
