"""Merging of convex pieces whose hulls stay out of the lumen.

The hull of two pieces contains both, so merging opens no gap.
"""

import heapq
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy.spatial import ConvexHull, QhullError

_LONG = 2.5e-3  # m; triangles of a hull with longer edges are sampled densely
_ORDER = 6  # subdivision of these triangles
# Extra cost of a hull by its radius, m of depth per m, so that long ones merge last.
_PER_RADIUS = 0.01

Depth = Callable[[np.ndarray], np.ndarray]


def merged(
    pieces: Sequence[np.ndarray],
    pairs: Iterable[Sequence[int]],
    depth: Depth,
    tolerance: float,
) -> list[np.ndarray]:
    """Merges neighbouring convex pieces, first those with the shallowest hull.

    Args:
        pieces: Vertices (n_i, 3) m.
        pairs: Pairs of indices of neighbouring pieces.
        depth: Depth (n,) m of points (n, 3) in the lumen, negative outside.
        tolerance: Largest depth that a merged hull may have, m.

    Returns:
        Vertices (n_i, 3) m of the merged hulls and of the pieces left alone.
    """
    alive = dict(enumerate(pieces))
    near: dict[int, set[int]] = {number: set() for number in alive}
    queue: list[tuple[float, int, int]] = []

    def propose(first: int, second: int) -> None:
        points = np.concatenate([alive[first], alive[second]])
        deepest = float(depth(hull_points(points)[0]).max())
        if deepest <= tolerance:
            reach = np.linalg.norm(points - points.mean(axis=0), axis=1).max()
            cost = max(deepest, 0.0) + _PER_RADIUS * float(reach)
            heapq.heappush(queue, (cost, first, second))

    for first, second in pairs:
        near[first].add(second)
        near[second].add(first)
        propose(first, second)
    number = len(pieces)
    while queue:
        _, first, second = heapq.heappop(queue)
        if first not in alive or second not in alive:
            continue
        both = np.concatenate([alive.pop(first), alive.pop(second)])
        alive[number] = hull_points(both)[1]
        near[number] = (near.pop(first) | near.pop(second)) - {first, second}
        for other in near[number]:
            near[other] = near[other] - {first, second} | {number}
            propose(other, number)
        number += 1
    return list(alive.values())


def hull_points(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (n, 3) of the convex hull of points (m, 3), and its vertices."""
    try:
        hull = ConvexHull(1e3 * points)
    except QhullError:  # nearly flat
        hull = ConvexHull(1e3 * points, qhull_options="QJ")
    corners = points[hull.simplices]
    a, b, c = np.moveaxis(corners, 1, 0)
    found = [a, b, c, (a + b) / 2, (b + c) / 2, (a + c) / 2, (a + b + c) / 3]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    a, b, c = np.moveaxis(corners[edges.max(axis=1) > _LONG], 1, 0)
    for i in range(_ORDER + 1):
        for j in range(_ORDER + 1 - i):
            found.append((i * a + j * b + (_ORDER - i - j) * c) / _ORDER)
    return np.concatenate(found), points[hull.vertices]
