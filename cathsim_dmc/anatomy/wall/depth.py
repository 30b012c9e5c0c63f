"""Signed depth inside a closed surface, precomputed on a sparse grid.

A lumen taken from a scan has no formula for its depth, and the exact distance to a
few thousand triangles costs tens of microseconds per point. ``DepthField`` stores
the depth on a fine lattice near the surface (cubes of 8x8x8 cells, called bricks)
and on a coarse one elsewhere, and interpolates linearly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

BRICK = 8  # cells along the edge of a brick
SPACING = 0.5e-3  # m, fine lattice: a third of the smallest vessel's radius
DEEP = 4e-3  # m, bricks entirely deeper than this keep the coarse lattice
OUTER = 0.5e-3  # m, bricks entirely further out than this keep the coarse lattice
SAMPLE_SPACING = 1.2e-3  # m, of the surface samples that propose near triangles
CANDIDATES = 6  # surface samples asked for per point
QUANTUM = 1e-6  # m, resolution of the stored depths (int16 reaches +-32 mm)


@dataclass(frozen=True, eq=False)
class DepthField:
    """Depth on a sparse lattice, trilinear in between.

    Attributes:
        origin: (3,) float64, m, world position of lattice point (0, 0, 0).
        spacing: m, fine lattice; the coarse one is ``BRICK`` times wider.
        coarse: (a+1, b+1, c+1) float32, m, depth at the corners of the bricks.
        index: (a, b, c) int32, row of ``bricks``, or -1 where there is none.
        bricks: (n, 9, 9, 9) int16, depth in units of ``QUANTUM``.
    """

    origin: np.ndarray
    spacing: float
    coarse: np.ndarray
    index: np.ndarray
    bricks: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Depth (m) at ``points`` (..., 3) (m), > 0 inside; (...,) float64.

        Outside the lattice's box the depth at the box's nearest point is reduced
        by the distance to that point, which bounds the true depth from above.
        """
        points = np.asarray(points, dtype=np.float64)
        flat = points.reshape(-1, 3)
        wide = self.spacing * BRICK
        top = np.asarray(self.index.shape) - 1e-9
        cell = (flat - self.origin) / wide
        inside = np.clip(cell, 0.0, top)
        beyond = np.linalg.norm(cell - inside, axis=-1) * wide
        corner = inside.astype(np.int64)
        rest = inside - corner
        row = self.index[tuple(corner.T)]
        depth = np.empty(len(flat))
        rough = row < 0
        if rough.any():
            ijk = corner[rough]
            depth[rough] = _trilinear(
                self.coarse.ravel(), ijk, rest[rough], self.coarse.shape, None
            )
        fine = ~rough
        if fine.any():
            scaled = rest[fine] * BRICK
            ijk = np.minimum(scaled.astype(np.int64), BRICK - 1)
            shape = self.bricks.shape[1:]
            depth[fine] = QUANTUM * _trilinear(
                self.bricks.ravel(), ijk, scaled - ijk, shape, row[fine]
            )
        return (depth - beyond).reshape(points.shape[:-1])

    def gradient(self, points: np.ndarray, step: float | None = None) -> np.ndarray:
        """Central difference of the depth, (..., 3), at ``points`` (..., 3) (m)."""
        points = np.asarray(points, dtype=np.float64)
        step = self.spacing if step is None else step
        offsets = step * np.concatenate([np.eye(3), -np.eye(3)])
        values = self(points[..., None, :] + offsets)
        return (values[..., :3] - values[..., 3:]) / (2.0 * step)

    def lattice(self, spacing: float, above: float = 0.0):
        """Points of a regular lattice that lie deeper than ``above``.

        Args:
            spacing: m, of the lattice.
            above: m, smallest depth kept.

        Returns:
            (ijk (n, 3) int64, points (n, 3) m, depth (n,) m).
        """
        wide = self.spacing * BRICK
        kept_ijk, kept_depth = [], []
        possible = (self.index >= 0) | (self.coarse[:-1, :-1, :-1] > above)
        planes = np.unique(np.nonzero(possible)[0])
        for plane in planes:
            low = int(np.ceil(plane * wide / spacing - 1e-9))
            high = int(np.ceil((plane + 1) * wide / spacing - 1e-9))
            jk = np.argwhere(possible[plane])
            first = np.ceil(jk * wide / spacing - 1e-9).astype(np.int64)
            last = np.ceil((jk + 1) * wide / spacing - 1e-9).astype(np.int64)
            span = np.arange(int((last - first).max()))
            grid = np.stack(np.meshgrid(span, span, indexing="ij"), -1).reshape(-1, 2)
            cells = first[:, None, :] + grid
            cells = cells[(cells < last[:, None, :]).all(-1)]
            slab = np.arange(low, high)
            ijk = np.concatenate(
                [
                    np.repeat(slab, len(cells))[:, None],
                    np.tile(cells, (len(slab), 1)),
                ],
                axis=1,
            )
            depth = self(self.origin + spacing * ijk)
            keep = depth > above
            kept_ijk.append(ijk[keep])
            kept_depth.append(depth[keep])
        ijk = np.concatenate(kept_ijk)
        return ijk, self.origin + spacing * ijk, np.concatenate(kept_depth)

    def arrays(self) -> dict[str, np.ndarray]:
        """The field as plain arrays, for an npz file."""
        return {
            "origin": self.origin,
            "spacing": np.float64(self.spacing),
            "coarse": self.coarse,
            "index": self.index,
            "bricks": self.bricks,
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> DepthField:
        """Inverse of ``arrays``."""
        return cls(
            origin=np.asarray(arrays["origin"], dtype=np.float64),
            spacing=float(arrays["spacing"]),
            coarse=np.asarray(arrays["coarse"], dtype=np.float32),
            index=np.asarray(arrays["index"], dtype=np.int32),
            bricks=np.asarray(arrays["bricks"], dtype=np.int16),
        )

    @classmethod
    def from_mesh(
        cls,
        vertices: np.ndarray,
        faces: np.ndarray,
        spacing: float = SPACING,
        margin: float = 8e-3,
    ) -> DepthField:
        """Sample the depth inside a closed mesh with outward normals.

        Args:
            vertices: (V, 3) m.
            faces: (F, 3) int.
            spacing: m, of the fine lattice.
            margin: m, by which the lattice exceeds the mesh's bounding box.
        """
        vertices = np.asarray(vertices, dtype=np.float64)
        measure = MeshDepth(vertices, faces)
        wide = spacing * BRICK
        origin = vertices.min(0) - margin
        shape = np.ceil((vertices.max(0) + margin - origin) / wide).astype(int)
        axes = [origin[k] + wide * np.arange(shape[k] + 1) for k in range(3)]
        corners = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        coarse = measure(corners.reshape(-1, 3)).reshape(corners.shape[:-1])
        # Depth changes by at most the distance moved, so the corners bound a brick.
        low, high = _corner_range(coarse)
        reach = wide * np.sqrt(3.0) / 2.0
        wanted = (high + reach > -OUTER) & (low - reach < DEEP)
        rows = np.argwhere(wanted)
        index = np.full(tuple(shape), -1, dtype=np.int32)
        index[tuple(rows.T)] = np.arange(len(rows))
        steps = spacing * np.arange(BRICK + 1)
        local = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1)
        bricks = np.empty((len(rows),) + (BRICK + 1,) * 3, dtype=np.int16)
        for start in range(0, len(rows), 512):
            base = origin + wide * rows[start : start + 512]
            depth = measure((base[:, None, :] + local.reshape(-1, 3)).reshape(-1, 3))
            depth = np.clip(np.rint(depth / QUANTUM), -32767, 32767)
            bricks[start : start + 512] = depth.reshape(-1, *bricks.shape[1:])
        return cls(origin, float(spacing), coarse.astype(np.float32), index, bricks)


class MeshDepth:
    """Exact signed depth inside a closed triangle mesh (slow, vectorised).

    The sign comes from the angle-weighted pseudonormal of the nearest face, edge or
    vertex (Baerentzen & Aanaes 2005), which is right where nearest features meet.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        """Prepare for ``vertices`` (V, 3) m and ``faces`` (F, 3), normals outward."""
        self.triangles = np.asarray(vertices, dtype=np.float64)[faces]
        self._normals = _feature_normals(self.triangles, faces, len(vertices))
        samples, self._owner = _surface_samples(self.triangles, SAMPLE_SPACING)
        self._tree = cKDTree(samples)

    def __call__(self, points: np.ndarray, chunk: int = 200_000) -> np.ndarray:
        """Depth (n,) m at ``points`` (n, 3) m, > 0 inside."""
        points = np.asarray(points, dtype=np.float64)
        parts = [
            self._depth(points[i : i + chunk]) for i in range(0, len(points), chunk)
        ]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _depth(self, points: np.ndarray) -> np.ndarray:
        # The proposals need not be exact: 0.05 mm more or less does not change
        # which triangles are near, and the tree search is much faster.
        _, near = self._tree.query(points, k=CANDIDATES, eps=0.05)
        owner = np.sort(self._owner[near], axis=1)
        best = np.full(len(points), np.inf)
        sign = np.ones(len(points))
        for column in range(CANDIDATES):
            todo = np.ones(len(points), dtype=bool)
            if column:
                todo = owner[:, column] != owner[:, column - 1]
            rows = np.nonzero(todo)[0]
            which = owner[rows, column]
            corners = self.triangles[which]
            weights = _closest_weights(corners, points[rows])
            nearest = np.einsum("nk,nkd->nd", weights, corners)
            gap = points[rows] - nearest
            square = np.einsum("nd,nd->n", gap, gap)
            better = square < best[rows]
            rows, which = rows[better], which[better]
            best[rows] = square[better]
            feature = _feature(weights[better])
            normal = self._normals[which, feature]
            sign[rows] = np.where(
                np.einsum("nd,nd->n", gap[better], normal) > 0.0, -1.0, 1.0
            )
        return sign * np.sqrt(best)


def _trilinear(values, ijk, rest, shape, row):
    """Interpolate in a flattened lattice (or in one brick per point)."""
    stride = (shape[1] * shape[2], shape[2], 1)
    base = ijk @ np.asarray(stride)
    if row is not None:
        base = base + row.astype(np.int64) * (shape[0] * shape[1] * shape[2])
    x, y, z = rest.T
    total = np.zeros(len(ijk))
    for i in (0, 1):
        wx = x if i else 1.0 - x
        for j in (0, 1):
            wxy = wx * (y if j else 1.0 - y)
            at = base + i * stride[0] + j * stride[1]
            total += wxy * ((1.0 - z) * values[at] + z * values[at + 1])
    return total


def _corner_range(lattice):
    """Smallest and largest of the eight corner values of every cell."""
    a, b, c = (n - 1 for n in lattice.shape)
    corners = [
        lattice[i : i + a, j : j + b, k : k + c]
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    ]
    return np.minimum.reduce(corners), np.maximum.reduce(corners)


def _surface_samples(triangles, spacing):
    """Points on every triangle about ``spacing`` apart, and their triangle."""
    edges = triangles - np.roll(triangles, 1, axis=1)
    longest = np.linalg.norm(edges, axis=-1).max(axis=1)
    level = np.clip(np.ceil(longest / spacing), 1, 60).astype(int)
    points, owners = [], []
    for n in np.unique(level):
        rows = np.nonzero(level == n)[0]
        i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
        keep = i + j < n
        # Centres of the small triangles that point the same way as the big one.
        u = (i[keep] + 1.0 / 3.0) / n
        v = (j[keep] + 1.0 / 3.0) / n
        weights = np.stack([1.0 - u - v, u, v], axis=-1)
        points.append(np.einsum("pk,nkd->npd", weights, triangles[rows]).reshape(-1, 3))
        owners.append(np.repeat(rows, len(weights)))
    return np.concatenate(points), np.concatenate(owners)


def _closest_weights(corners, points):
    """Barycentric weights (n, 3) of the point of each triangle nearest to a point.

    Regions of the triangle's plane as in Ericson, Real-Time Collision Detection,
    section 5.1.5.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac = b - a, c - a

    def dot(u, v):
        return np.einsum("nd,nd->n", u, v)

    ap, bp, cp = points - a, points - b, points - c
    d1, d2 = dot(ab, ap), dot(ac, ap)
    d3, d4 = dot(ab, bp), dot(ac, bp)
    d5, d6 = dot(ab, cp), dot(ac, cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    with np.errstate(divide="ignore", invalid="ignore"):
        total = va + vb + vc
        weights = np.stack([va, vb, vc], -1) / total[:, None]

        def put(mask, w):
            weights[mask] = np.stack(np.broadcast_arrays(*w), -1)[mask]

        zero, one = np.zeros_like(d1), np.ones_like(d1)
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        put((va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0), (zero, 1 - t, t))
        t = d2 / (d2 - d6)
        put((vb <= 0) & (d2 >= 0) & (d6 <= 0), (1 - t, zero, t))
        t = d1 / (d1 - d3)
        put((vc <= 0) & (d1 >= 0) & (d3 <= 0), (1 - t, t, zero))
        put((d6 >= 0) & (d5 <= d6), (zero, zero, one))
        put((d3 >= 0) & (d4 <= d3), (zero, one, zero))
        put((d1 <= 0) & (d2 <= 0), (one, zero, zero))
    # A triangle of no area has no inside: its first corner is near enough.
    bad = ~np.isfinite(weights).all(axis=1)
    weights[bad] = (1.0, 0.0, 0.0)
    return weights


def _feature(weights, eps=1e-9):
    """Column of the normals' table: 0-2 corner, 3-5 edge opposite it, 6 face."""
    zero = weights < eps
    feature = np.full(len(weights), 6)
    single = zero.sum(axis=1) == 1
    feature[single] = 3 + np.argmax(zero[single], axis=1)
    double = zero.sum(axis=1) >= 2
    feature[double] = np.argmax(weights[double], axis=1)
    return feature


def _feature_normals(triangles, faces, count):
    """Pseudonormals (F, 7, 3) of each face's corners, edges and inside."""
    faces = np.asarray(faces)
    cross = np.cross(
        triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    )
    area = np.linalg.norm(cross, axis=1, keepdims=True)
    normal = cross / np.maximum(area, 1e-30)
    corner = np.zeros((count, 3))
    for k in range(3):
        u = triangles[:, (k + 1) % 3] - triangles[:, k]
        v = triangles[:, (k + 2) % 3] - triangles[:, k]
        cosine = np.einsum("nd,nd->n", u, v) / np.maximum(
            np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1), 1e-30
        )
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        np.add.at(corner, faces[:, k], angle[:, None] * normal)
    table = np.empty((len(faces), 7, 3))
    table[:, 6] = normal
    sides = [np.sort(faces[:, [(k + 1) % 3, (k + 2) % 3]], axis=1) for k in range(3)]
    _, edge = np.unique(np.concatenate(sides), axis=0, return_inverse=True)
    edge = edge.reshape(3, -1)
    edge_sum = np.zeros((edge.max() + 1, 3))
    for k in range(3):
        np.add.at(edge_sum, edge[k], normal)
    for k in range(3):
        table[:, k] = corner[faces[:, k]]
        table[:, 3 + k] = edge_sum[edge[k]]
    return table
