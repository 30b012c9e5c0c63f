"""Convex polytopes held as their vertices: clipping, volume and width."""

from __future__ import annotations

import numpy as np

from cathsim_dmc.anatomy.centreline import Array

# Vertices this close to a plane (m) count as lying on it.
_ON_PLANE = 1e-9


def _cross(a: Array, b: Array) -> Array:
    # np.cross takes most of its time, and so of the wall's, to look at the shapes.
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _planar_hull(points: Array, normal: Array) -> Array:
    """Extreme points of coplanar `points` (n, 3); `normal` (3,) of their plane."""
    axis = np.zeros(3)
    axis[np.abs(normal).argmin()] = 1.0
    u = _cross(normal, axis)
    flat = points @ np.stack([u, _cross(normal, u)], axis=1)
    order = np.lexsort((flat[:, 1], flat[:, 0]))
    xy = flat[order].tolist()
    # Monotone chain; the tolerance drops points within nanometres of an edge.
    keep: list[int] = []
    for indices in (range(len(xy)), range(len(xy) - 1, -1, -1)):
        chain: list[int] = []
        for i in indices:
            while len(chain) >= 2:
                (ax, ay), (bx, by) = xy[chain[-2]], xy[chain[-1]]
                turn = (bx - ax) * (xy[i][1] - ay) - (by - ay) * (xy[i][0] - ax)
                if turn > 1e-12:
                    break
                chain.pop()
            chain.append(i)
        keep += chain[:-1]
    return points[order[keep]]


def clip(vertices: Array, normal: Array, offset: float) -> Array | None:
    """Part of a convex polytope where normal . x >= offset; None when empty.

    Args:
        vertices: (n, 3) extreme points.
        normal: (3,) of the half-space kept.
        offset: same unit as the vertices times the length of the normal.

    Returns:
        (k, 3) extreme points, or None if no more than a facet is left.
    """
    height = vertices @ normal - offset
    inside = height > _ON_PLANE
    if not inside.any():
        return None
    outside = height < -_ON_PLANE
    if not outside.any():
        return vertices
    kept, cut = vertices[~outside], vertices[outside]
    # Every segment from a kept to a cut vertex lies in the polytope, so the
    # crossings of all of them span the same facet as those of the edges.
    above, below = height[inside], height[outside]
    t = above[:, None] / (above[:, None] - below[None, :])
    start = vertices[inside]
    crossing = start[:, None] + t[..., None] * (cut[None] - start[:, None])
    on_plane = kept[height[~outside] <= _ON_PLANE]
    facet = _planar_hull(np.concatenate([crossing.reshape(-1, 3), on_plane]), normal)
    return np.concatenate([start, facet])


def clip_all(vertices: Array | None, normals: Array, offsets: Array) -> Array | None:
    """`clip` by several half-spaces: normals (n, 3), offsets (n,)."""
    for normal, offset in zip(normals, offsets, strict=True):
        if vertices is None:
            return None
        vertices = clip(vertices, normal, offset)
    return vertices


def volume_and_width(vertices: Array) -> tuple[float, float]:
    """Volume (m^3) and least facet-to-vertex width (m); zeros when degenerate."""
    from scipy.spatial import ConvexHull, QhullError

    if len(vertices) < 4:
        return 0.0, 0.0
    try:
        # Qhull's tolerances suit coordinates of order one: use millimetres.
        hull = ConvexHull((vertices - vertices[0]) * 1e3)
    except QhullError:
        return 0.0, 0.0
    reach = hull.equations[:, :3] @ hull.points[hull.vertices].T
    width = -(reach + hull.equations[:, 3:]).min(axis=1).max()
    return float(hull.volume) * 1e-9, float(width) * 1e-3
