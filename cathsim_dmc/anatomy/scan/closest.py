"""Distance from points to the nearest of many triangles: the compiled loops.

Importing numba takes longer than loading a task, so `mesh_depth` imports this module
only when there is something to measure. Numba compiles it when it is first called and
keeps the result beside it.
"""

import math

import numpy as np

from cathsim_dmc.compiled import compiled

_STACK = 64  # nodes; a tree over 2^60 triangles would not fill it


@compiled
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _difference(a, b):
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@compiled
def _nearest(p, triangle):
    """Vector from the nearest point of a triangle to ``p``, and where that lies.

    The place is the column of a table of pseudonormals: 0 to 2 the corners, 3 to 5
    the edges opposite to them, 6 the inside. Regions as in Ericson, Real-Time
    Collision Detection, section 5.1.5.
    """
    a, b, c = triangle[0], triangle[1], triangle[2]
    ab, ac = _difference(b, a), _difference(c, a)
    ap, bp, cp = _difference(p, a), _difference(p, b), _difference(p, c)
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return ap, 0
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return bp, 1
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and d1 > d3:
        t = d1 / (d1 - d3)
        return (ap[0] - t * ab[0], ap[1] - t * ab[1], ap[2] - t * ab[2]), 5
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return cp, 2
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0 and d2 > d6:
        t = d2 / (d2 - d6)
        return (ap[0] - t * ac[0], ap[1] - t * ac[1], ap[2] - t * ac[2]), 4
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 >= d3 and d5 >= d6 and (d4 - d3) + (d5 - d6) > 0.0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        bc = _difference(c, b)
        return (bp[0] - t * bc[0], bp[1] - t * bc[1], bp[2] - t * bc[2]), 3
    total = va + vb + vc
    if not total > 0.0:
        return ap, 0  # a triangle of no area has no inside
    v, w = vb / total, vc / total
    return (
        ap[0] - v * ab[0] - w * ac[0],
        ap[1] - v * ab[1] - w * ac[1],
        ap[2] - v * ab[2] - w * ac[2],
    ), 6


@compiled
def _outside(p, box):
    """Squared distance of ``p`` from an axis-parallel box (2, 3)."""
    total = 0.0
    for k in range(3):
        gap = max(box[0, k] - p[k], p[k] - box[1, k], 0.0)
        total += gap * gap
    return total


@compiled
def _to_nearest(p, triangles, boxes, leaf, first):
    """Distance of ``p`` from the nearest triangle."""
    best = math.inf
    stack = np.empty(_STACK, np.int64)
    stack[0], size = 0, 1
    while size:
        size -= 1
        node = stack[size]
        if _outside(p, boxes[node]) >= best:
            continue
        if node >= first:
            start = (node - first) * leaf
            for row in range(start, min(start + leaf, len(triangles))):
                gap, _ = _nearest(p, triangles[row])
                best = min(best, _dot(gap, gap))
            continue
        left, right = 2 * node + 1, 2 * node + 2
        # The nearer child last, so that it comes off the stack first.
        if _outside(p, boxes[left]) < _outside(p, boxes[right]):
            left, right = right, left
        stack[size], stack[size + 1] = left, right
        size += 2
    return math.sqrt(best)


@compiled
def _within(p, reach, triangles, boxes, leaf, first, found, gaps):
    """Rows of all triangles nearer than ``reach``, and how far each is; their count."""
    stack = np.empty(_STACK, np.int64)
    stack[0], size, count = 0, 1, 0
    while size:
        size -= 1
        node = stack[size]
        if _outside(p, boxes[node]) > reach * reach:
            continue
        if node >= first:
            start = (node - first) * leaf
            for row in range(start, min(start + leaf, len(triangles))):
                gap, _ = _nearest(p, triangles[row])
                square = _dot(gap, gap)
                if square <= reach * reach:
                    found[count], gaps[count] = row, math.sqrt(square)
                    count += 1
            continue
        stack[size], stack[size + 1] = 2 * node + 1, 2 * node + 2
        size += 2
    return count


@compiled
def signed_depths(blocks, points, triangles, normals, boxes, leaf, first):
    """Signed depths of points that lie in blocks, and the nearest triangles.

    Args:
        blocks: (n, 3) m, added to ``points``.
        points: (m, 3) m, of one block.
        triangles: (F, 3, 3) m, in the order of the tree.
        normals: (F, 7, 3) pseudonormals of corners, edges and inside.
        boxes: (2^k - 1, 2, 3) m, of the tree's nodes.
        leaf: triangles per leaf.
        first: number of the first leaf among the nodes.

    Returns:
        (depth (n, m) m, > 0 inside; row of the nearest triangle (n, m)).
    """
    depth = np.empty((len(blocks), len(points)))
    owner = np.empty((len(blocks), len(points)), np.int64)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for point in points:
        for k in range(3):
            low[k], high[k] = min(low[k], point[k]), max(high[k], point[k])
    middle = 0.5 * (low + high)
    half = 0.0
    off = np.empty(len(points))
    for i in range(len(points)):
        gap = _difference(points[i], middle)
        off[i] = math.sqrt(_dot(gap, gap))
        half = max(half, off[i])
    found, gaps = np.empty(len(triangles), np.int64), np.empty(len(triangles))
    for b in range(len(blocks)):
        centre = blocks[b] + middle
        reach = _to_nearest(centre, triangles, boxes, leaf, first) + 2.0 * half
        reach = reach * (1.0 + 1e-9) + 1e-12
        count = _within(centre, reach, triangles, boxes, leaf, first, found, gaps)
        order = np.argsort(gaps[:count])
        for i in range(len(points)):
            p = blocks[b] + points[i]
            best, sign, own = math.inf, 1.0, 0
            for rank in order:
                # No point of the block is nearer to a triangle than this.
                bound = gaps[rank] - off[i]
                if bound > 0.0 and bound * bound >= best:
                    break
                row = found[rank]
                gap, place = _nearest(p, triangles[row])
                square = _dot(gap, gap)
                if square < best:
                    best, own = square, row
                    sign = -1.0 if _dot(gap, normals[row, place]) > 0.0 else 1.0
            depth[b, i], owner[b, i] = sign * math.sqrt(best), own
    return depth, owner


@compiled
def _cross(a, b):
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@compiled
def _hit(p, ray, triangle):
    """Where the line p + t ray meets a triangle: t, or infinity if it does not.

    Moeller & Trumbore, Fast Minimum Storage Ray/Triangle Intersection, 1997; edges
    and corners do not count.
    """
    a, b, c = triangle[0], triangle[1], triangle[2]
    ab, ac, ap = _difference(b, a), _difference(c, a), _difference(p, a)
    n = _cross(ab, ac)
    slope = _dot(n, ray)
    size = math.sqrt(_dot(n, n) * _dot(ray, ray))
    if abs(slope) <= 1e-9 * size or size == 0.0:
        return math.inf
    q = _cross(ray, ap)
    u = _dot(ac, q) / slope
    v = -_dot(ab, q) / slope
    if u <= 1e-6 or v <= 1e-6 or u + v >= 1.0 - 1e-6:
        return math.inf
    return -_dot(n, ap) / slope


@compiled
def _misses(p, inverse, reach, box):
    """Whether the ray from ``p`` passes a box (2, 3) within ``reach`` by."""
    near, far = 0.0, reach
    for k in range(3):
        if math.isinf(inverse[k]):
            if p[k] < box[0, k] or p[k] > box[1, k]:
                return True
            continue
        t1, t2 = (box[0, k] - p[k]) * inverse[k], (box[1, k] - p[k]) * inverse[k]
        near, far = max(near, min(t1, t2)), min(far, max(t1, t2))
    return not near <= far


@compiled
def blocked_share(points, rays, normals, triangles, boxes, leaf, first):
    """Share (n,) of the rays into the half space of a normal that meet a triangle.

    Args:
        points: (n, 3) m, off the surface.
        rays: (m, 3), unit.
        normals: (n, 3); zeros take all rays.
        triangles: (F, 3, 3) m, in the order of the tree.
        boxes: (2^k - 1, 2, 3) m, of the tree's nodes.
        leaf: triangles per leaf.
        first: number of the first leaf among the nodes.
    """
    share = np.zeros(len(points))
    stack = np.empty(_STACK, np.int64)
    for i in range(len(points)):
        shot, met = 0, 0
        for ray in rays:
            if _dot(ray, normals[i]) < 0.0:
                continue
            shot += 1
            inverse = (1.0 / ray[0], 1.0 / ray[1], 1.0 / ray[2])
            stack[0], size = 0, 1
            while size:
                size -= 1
                node = stack[size]
                if _misses(points[i], inverse, math.inf, boxes[node]):
                    continue
                if node < first:
                    stack[size], stack[size + 1] = 2 * node + 1, 2 * node + 2
                    size += 2
                    continue
                start = (node - first) * leaf
                for row in range(start, min(start + leaf, len(triangles))):
                    t = _hit(points[i], ray, triangles[row])
                    if 0.0 < t < math.inf:
                        met, size = met + 1, 0
                        break
        share[i] = met / max(shot, 1)
    return share


@compiled
def crossing_faces(edges, points, faces, triangles, boxes, leaf, first):
    """Rows of edges and faces (n, 2) that cross without a common vertex.

    Args:
        edges: (E, 2) vertices.
        points: (V, 3) m.
        faces: (F, 3) vertices, in the order of the tree.
        triangles: (F, 3, 3) m, in the order of the tree.
        boxes: (2^k - 1, 2, 3) m, of the tree's nodes.
        leaf: triangles per leaf.
        first: number of the first leaf among the nodes.
    """
    found = [(0, 0) for _ in range(0)]
    stack = np.empty(_STACK, np.int64)
    for number in range(len(edges)):
        a, b = edges[number]
        ray = _difference(points[b], points[a])
        inverse = (1.0 / ray[0], 1.0 / ray[1], 1.0 / ray[2])
        stack[0], size = 0, 1
        while size:
            size -= 1
            node = stack[size]
            if _misses(points[a], inverse, 1.0, boxes[node]):
                continue
            if node < first:
                stack[size], stack[size + 1] = 2 * node + 1, 2 * node + 2
                size += 2
                continue
            start = (node - first) * leaf
            for row in range(start, min(start + leaf, len(triangles))):
                shared = False
                for k in range(3):
                    shared = shared or faces[row, k] == a or faces[row, k] == b
                if shared:
                    continue
                t = _hit(points[a], ray, triangles[row])
                if 1e-6 < t < 1.0 - 1e-6:
                    found.append((number, row))
    return found


@compiled
def _mixed(values, i, j, k, x, y, z):
    """Trilinear interpolation in a cell (i, j, k) of a lattice."""
    total = 0.0
    for a in range(2):
        wx = x if a else 1.0 - x
        for b in range(2):
            wxy = wx * (y if b else 1.0 - y)
            total += wxy * (
                (1.0 - z) * values[i + a, j + b, k] + z * values[i + a, j + b, k + 1]
            )
    return total


@compiled
def lattice_depths(points, origin, spacing, cells, quantum, coarse, index, bricks):
    """Depths (n,) m at points (n, 3) m; see ``DepthField.__call__``."""
    out = np.empty(len(points))
    wide = spacing * cells
    corner, rest = np.empty(3, np.int64), np.empty(3)
    for n in range(len(points)):
        beyond = 0.0
        for k in range(3):
            cell = (points[n, k] - origin[k]) / wide
            inside = min(max(cell, 0.0), index.shape[k] - 1e-9)
            beyond += (cell - inside) ** 2
            corner[k] = int(inside)
            rest[k] = inside - corner[k]
        row = index[corner[0], corner[1], corner[2]]
        if row < 0:
            depth = _mixed(
                coarse, corner[0], corner[1], corner[2], rest[0], rest[1], rest[2]
            )
        else:
            for k in range(3):
                scaled = rest[k] * cells
                corner[k] = min(int(scaled), cells - 1)
                rest[k] = scaled - corner[k]
            depth = quantum * _mixed(
                bricks[row], corner[0], corner[1], corner[2], rest[0], rest[1], rest[2]
            )
        out[n] = depth - math.sqrt(beyond) * wide
    return out
