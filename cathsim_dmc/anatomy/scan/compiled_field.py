"""A depth field whose interpolation is compiled, for the many calls of an import."""

from __future__ import annotations

import numpy as np

from cathsim_dmc.anatomy.wall.depth import BRICK, QUANTUM, DepthField


class CompiledField(DepthField):
    """The same field: equal values but for rounding, many times faster to ask.

    It is not what tasks use: importing numba takes longer than loading one.
    """

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Depth (m) at ``points`` (..., 3) (m), > 0 inside; (...,) float64."""
        from cathsim_dmc.anatomy.scan.closest import lattice_depths

        points = np.asarray(points, dtype=np.float64)
        depth = lattice_depths(
            np.ascontiguousarray(points.reshape(-1, 3)),
            self.origin,
            self.spacing,
            BRICK,
            QUANTUM,
            self.coarse,
            self.index,
            self.bricks,
        )
        return depth.reshape(points.shape[:-1])


def compiled(field: DepthField) -> CompiledField:
    """A field (the same arrays) whose interpolation is compiled."""
    return CompiledField(
        field.origin, field.spacing, field.coarse, field.index, field.bricks
    )


def plain(field: DepthField) -> DepthField:
    """A field (the same arrays) as tasks use it."""
    return DepthField(
        field.origin, field.spacing, field.coarse, field.index, field.bricks
    )
