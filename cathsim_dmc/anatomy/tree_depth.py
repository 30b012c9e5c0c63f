"""Signed distance to the wall of a vessel tree, > 0 inside."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from cathsim_dmc.anatomy.centreline import Array, Centreline, VesselTree
from cathsim_dmc.anatomy.parts import End
from cathsim_dmc.compiled import compiled

_SLACK = 3e-3  # m; a vessel that is less deep by more does not affect a point
_AROUND = 120  # points of a ring that are seeds of the search for creases
_SEED, _APART = 1.5e-3, 0.1e-3  # m, distance of a seed from a wall; thinning grid
_GROUP = 2.5  # points along each axis of a group, about
_ROUNDS = 30  # projections on both walls; walls that meet at 30° need the most
_MEETING = 3e-5  # m, largest distance of a crease from both walls
_TOUCHING = 5e-6  # m, largest depth of a wall point in another vessel
_BEHIND = 20e-3  # m behind an open end, over which the lumen continues


class TreeDepth:
    """Signed distance to the wall of a union of tubes, m, > 0 inside.

    A tube is the union of its cross-sections: rings normal to the centreline, whose
    centres, directions and radii change linearly between its points. A ring inside
    another vessel is no wall. Two walls meet in a crease, which is stored as points.
    Closed ends are flat walls; an open end continues as a straight tube.
    """

    def __init__(self, tree: VesselTree, ends: Sequence[End] = ()):
        """Finds the creases; flat ends that are not in `ends` are closed."""
        lines = [vessel.centreline for vessel in tree.vessels.values()]
        stops = np.cumsum([0, *(len(line.points) for line in lines)])
        free = [end.position for end in ends if end.open]

        def closed(point: Array) -> bool:
            return all(np.linalg.norm(point - place) >= 1e-6 for place in free)

        # Centres (3), unit tangents (3) and radii of all rings; the first and the last
        # of each vessel; its two ends: 0 open, 1 closed, 2 within another vessel.
        rings = [rings_of(line) for line in lines]
        self._nodes = np.concatenate(rings)
        self._spans = np.stack([stops[:-1], stops[1:] - 1], axis=1)
        first = [2 if row else closed(x.points[0]) for row, x in enumerate(lines)]
        last = [closed(line.points[-1]) for line in lines]
        self._tree = self._nodes, self._spans, np.stack([first, last], 1).astype(int)
        self._creases = self._find_creases(rings)

    def __call__(self, points: Array) -> Array:
        """Signed distances (n,) m at points (n, 3) m, > 0 inside."""
        return self.around(points, np.zeros((1, 3)))[:, 0]

    def around(self, blocks: Array, points: Array) -> Array:
        """Signed distances (n, m) m at blocks (n, 3) + points (m, 3) m, > 0 inside."""
        blocks, points = (
            np.ascontiguousarray(each, dtype=np.float64) for each in (blocks, points)
        )
        reach = float(np.linalg.norm(points, axis=1).max())
        out = np.empty((len(blocks), len(points)))
        groups = _grouped(points)
        _tree_depths(self._tree, self._creases, blocks, points, reach, groups, out)
        return out

    @property
    def box(self) -> tuple[Array, Array]:
        """Corners (3,), (3,), m, of a box around the lumen."""
        return _box(self._nodes)

    def _find_creases(self, rings: list[Array]) -> Array:
        found = [np.empty((0, 3))]
        for one, two in combinations(range(len(rings)), 2):
            seeds = on_walls(rings[two])
            low, high = _box(rings[one])
            seeds = seeds[((seeds > low) & (seeds < high)).all(axis=1)]
            seeds = seeds[np.abs(self._onto(one, two, seeds, 0)[:, 0]) < _SEED]
            left = self._onto(one, two, seeds, _ROUNDS)
            seeds = seeds[(np.abs(left) < _MEETING).all(axis=1)]
            for other in set(range(len(rings))) - {one, two}:
                inside = self._onto(other, two, seeds, 0)[:, 0] > _TOUCHING
                seeds = seeds[~inside]
            # Many seeds converge to one point.
            _, kept = np.unique(np.rint(seeds / _APART), axis=0, return_index=True)
            found.append(seeds[kept])
        return np.concatenate(found)

    def _onto(self, one: int, two: int, seeds: Array, rounds: int) -> Array:
        """Moves seeds (n, 3) onto both walls; returns their depths (n, 2), m."""
        left = np.empty((len(seeds), 2))
        _onto_creases(self._tree, (one, two), seeds, rounds, left)
        return left


def on_walls(nodes: Array) -> Array:
    """Points (n, 3) on the rings of a vessel, m."""
    across = np.eye(3)[np.abs(nodes[:, 3:6]).argmin(axis=1)]
    u = np.cross(nodes[:, 3:6], across)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(nodes[:, 3:6], u)
    angle = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)[:, None, None]
    spokes = np.cos(angle) * u + np.sin(angle) * v
    return (nodes[:, :3] + nodes[:, 6:] * spokes).reshape(-1, 3)


def rings_of(line: Centreline) -> Array:
    """Centres, unit tangents and radii (n, 7) of the rings at a centreline's points."""
    steps = np.diff(line.points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return np.concatenate([line.points, tangents, line.radii[:, None]], axis=1)


def _box(nodes: Array) -> tuple[Array, Array]:
    centres, radii = nodes[:, :3], nodes[:, 6:]
    return (centres - radii).min(axis=0), (centres + radii).max(axis=0)


def _grouped(points: Array) -> tuple[np.ndarray, Array, Array]:
    """Labels (m,) of groups of near points (m, 3), their middles and radii (g,)."""
    along = max(1, round(len(points) ** (1 / 3) / _GROUP))
    size = max(float(np.ptp(points, axis=0).max()), 1e-9) / along
    cells = ((points - points.min(axis=0)) / size).astype(int).clip(0, along - 1)
    _, groups = np.unique(cells @ (1, along, along**2), return_inverse=True)
    numbers = range(groups.max() + 1)
    middles = np.array([points[groups == group].mean(axis=0) for group in numbers])
    reaches = np.zeros(len(middles))
    np.maximum.at(reaches, groups, np.linalg.norm(points - middles[groups], axis=1))
    return groups, middles, reaches


@compiled
def _ring(nodes, k, u, x, y, z):
    """Axial and radial place of a point at the ring between nodes k, k + 1; radius."""
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
def _from_ring(nodes, k, u, x, y, z):
    """Squared distance of a point from the ring at share u of nodes k to k + 1."""
    axial, radial, radius = _ring(nodes, k, u, x, y, z)
    return axial * axial + (radial - radius) ** 2


@compiled
def _from_node(nodes, k, x, y, z):
    """Squared distance of a point from the ring of a node."""
    dx, dy, dz = x - nodes[k, 0], y - nodes[k, 1], z - nodes[k, 2]
    axial = dx * nodes[k, 3] + dy * nodes[k, 4] + dz * nodes[k, 5]
    whole = dx * dx + dy * dy + dz * dz
    radius = nodes[k, 6]
    # axial² + (radial - radius)²
    across = math.sqrt(max(whole - axial * axial, 0.0))
    return whole + radius * (radius - 2.0 * across)


@compiled
def _nearest(nodes, first, last, chosen, x, y, z):
    """The ring of one vessel that is nearest to a point: (segment, share, square)."""
    best, at = np.inf, first
    for k in chosen:
        value = _from_node(nodes, k, x, y, z)
        if value < best:
            best, at = value, k
    # In a segment the square is nearly a parabola, as the tangent turns little.
    place, value = min(at, last - 1), best
    share = 1.0 if at == last else 0.0
    for k in range(max(at - 1, first), min(at + 1, last)):
        f0, f1 = _from_node(nodes, k, x, y, z), _from_node(nodes, k + 1, x, y, z)
        middle = _from_ring(nodes, k, 0.5, x, y, z)
        bend, slope = 2.0 * f0 - 4.0 * middle + 2.0 * f1, 4.0 * middle - 3.0 * f0 - f1
        if bend <= 0.0 or slope >= 0.0 or -slope >= 2.0 * bend:
            continue
        u = -0.5 * slope / bend
        lower = _from_ring(nodes, k, u, x, y, z)
        if lower < value:
            place, share, value = k, u, lower
    return place, share, value


@compiled
def _signed(tree, vessel, chosen, x, y, z, out):
    """Signed depth (m) in one vessel, and the nearest place of its wall in `out`."""
    nodes, (first, last), flats = tree[0], tree[1][vessel], tree[2][vessel]
    k, u, value = _nearest(nodes, first, last, chosen, x, y, z)
    axial, radial, radius = _ring(nodes, k, u, x, y, z)
    inside = radial < radius
    # Point of the ring in the half plane of the given point.
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
    for end in range(2):
        k, u, way = (first, 0.0, -1.0) if end == 0 else (last - 1, 1.0, 1.0)
        axial, radial, radius = _ring(nodes, k, u, x, y, z)
        level = way * axial
        if radial > radius or (level <= 0.0 and flats[end] != 1):
            continue
        if level > 0.0:
            node = nodes[first] if end == 0 else nodes[last]
            ways = (cx - node[0]) ** 2 + (cy - node[1]) ** 2 + (cz - node[2]) ** 2
            if ways > radius * radius:
                continue  # the point is near another part of a curved vessel
            # Beyond an open end the lumen continues as a straight tube.
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
    """Depth in one vessel's rings; `chosen` gets the count and indices of near ones."""
    best, deepest, count = np.inf, -np.inf, 0
    for k in among:
        best = min(best, _from_node(nodes, k, x, y, z))
        deepest = max(deepest, nodes[k, 6] - math.sqrt(_square(nodes[k], x, y, z)))
    limit = (math.sqrt(best) + margin) ** 2
    for k in among:
        if _from_node(nodes, k, x, y, z) <= limit:
            count += 1
            chosen[count] = k
    chosen[0] = count
    return deepest


@compiled
def _at_flat_ends(tree, vessel, deepest, x, y, z):
    """Depth in a vessel's rings, limited by its flat ends, which spheres reach over."""
    nodes, ends, flats = tree[0], tree[1][vessel], tree[2][vessel]
    for end in range(2):
        node = nodes[ends[end]]
        dx, dy, dz = x - node[0], y - node[1], z - node[2]
        level = dx * node[3] + dy * node[4] + dz * node[5]
        if end == 0:
            level = -level
        near = dx * dx + dy * dy + dz * dz < 4.0 * node[6] * node[6]
        if flats[end] != 0 and near:
            deepest = min(deepest, -level)
    return deepest


@compiled
def _creases_near(creases, among, x, y, z, margin, near):
    """Indices of the creases that may be nearest around a point, a part of `near`."""
    closest, found = np.inf, 0
    for c in among:
        closest = min(closest, _square(creases[c], x, y, z))
    limit = (math.sqrt(closest) + margin) ** 2
    for c in among:
        if _square(creases[c], x, y, z) <= limit:
            near[found] = c
            found += 1
    return near[:found]


@compiled
def _tree_depths(tree, creases, blocks, points, reach, groups, out):
    """Signed distances (n, q) m at blocks (n, 3) + points (q, 3) within `reach`, m."""
    nodes, spans, _ = tree
    group, middles, reaches = groups
    vessels = len(spans)
    rings, edges = np.arange(len(nodes)), np.arange(len(creases))
    wide = np.empty((vessels, len(nodes) + 1), np.int64)
    close = np.empty((vessels, len(nodes) + 1), np.int64)
    level, depths = np.empty(vessels), np.empty(vessels)
    first, second = np.empty(len(creases), np.int64), np.empty(len(creases), np.int64)
    places = np.empty((2, 3))
    for n in range(len(blocks)):
        x, y, z = blocks[n]
        margin = 2.0 * reach + _SLACK
        for v in range(vessels):
            among = rings[spans[v, 0] : spans[v, 1] + 1]
            deepest = _rings_near(nodes, among, x, y, z, margin, wide[v])
            level[v] = _at_flat_ends(tree, v, deepest, x, y, z)
        bar = level.max() - margin
        around = _creases_near(creases, edges, x, y, z, 2.0 * reach + 1e-6, first)
        for g in range(len(middles)):
            gx, gy, gz = x + middles[g, 0], y + middles[g, 1], z + middles[g, 2]
            margin = 2.0 * reaches[g] + 1e-6
            for v in range(vessels):
                depths[v] = -np.inf
                if level[v] >= bar:
                    among = wide[v, 1 : 1 + wide[v, 0]]
                    deepest = _rings_near(nodes, among, gx, gy, gz, margin, close[v])
                    depths[v] = _at_flat_ends(tree, v, deepest, gx, gy, gz)
            lowest = depths.max() - 2.0 * reaches[g] - _SLACK
            near = _creases_near(creases, around, gx, gy, gz, margin, second)
            here = depths >= lowest, close, level >= bar - _SLACK, wide, places
            for q in range(len(points)):
                if group[q] == g:
                    px, py, pz = x + points[q, 0], y + points[q, 1], z + points[q, 2]
                    depth = _tree_depth(tree, here, px, py, pz)
                    closest = np.inf
                    for c in near:
                        closest = min(closest, _square(creases[c], px, py, pz))
                    distance = min(abs(depth), math.sqrt(closest))
                    out[n, q] = math.copysign(distance, depth)


@compiled
def _tree_depth(tree, here, x, y, z):
    """Signed distance (m) of one point from the walls, without creases."""
    # Near vessels and their rings; the same of vessels that may hold the wall of
    # another one; work array.
    matters, close, others, wide, places = here
    inside, distance = False, np.inf
    for v in range(len(matters)):
        if not matters[v]:
            continue
        rings, wall = close[v, 1 : 1 + close[v, 0]], places[0]
        depth = _signed(tree, v, rings, x, y, z, wall)
        inside = inside or depth > 0.0
        if abs(depth) >= distance:
            continue
        valid = True
        for w in range(len(others)):
            if valid and w != v and others[w]:
                rings, (a, b, c) = wide[w, 1 : 1 + wide[w, 0]], wall
                valid = _signed(tree, w, rings, a, b, c, places[1]) <= _TOUCHING
        if valid:
            distance = abs(depth)
    return distance if inside else -distance


@compiled
def _onto_creases(tree, pair, seeds, rounds, left):
    """Moves seeds (n, 3) to the crease of two vessels; `left` (n, 2) gets depths."""
    nodes, spans, _ = tree
    every, place = np.arange(len(nodes)), np.empty(3)
    for n in range(len(seeds)):
        for turn in range(rounds + 1):
            for row in range(2):
                first, last = spans[pair[row]]
                x, y, z = seeds[n]
                rings = every[first : last + 1]
                left[n, row] = _signed(tree, pair[row], rings, x, y, z, place)
                if turn < rounds:
                    seeds[n] = place
