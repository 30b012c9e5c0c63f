"""Signed depth inside a closed surface, precomputed on a sparse grid.

A lumen taken from a scan has no formula for its depth, and the exact distance to a
few thousand triangles costs tens of microseconds per point. ``DepthField`` stores
the depth on a fine lattice near the surface (cubes of 8x8x8 cells, called bricks)
and on a coarse one elsewhere, and interpolates linearly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BRICK = 8  # cells along the edge of a brick
SPACING = 0.5e-3  # m, fine lattice: a third of the smallest vessel's radius
DEEP = 4e-3  # m, bricks entirely deeper than this keep the coarse lattice
OUTER = 0.5e-3  # m, bricks entirely further out than this keep the coarse lattice
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
            "spacing": np.array(self.spacing),
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
