"""Signed distance to a triangulated surface, by libigl."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array

from cathsim_dmc.anatomy.centreline import Array
from cathsim_dmc.anatomy.parts import MARGIN, End, Surface

# Least cosine between normals of neighbours at a smooth place, and least cosine between
# normal and direction at which a normal tells inside from outside at a sharp one.
_SMOOTH, _BEFORE = 0.5, 0.9
_CAP = 1e-6  # m, within which a triangle lies in the plane of an open end
_SAME = 1e-6  # m; nearer points are evaluated once


class SurfaceDepth:
    """Signed distance to a closed surface, m, > 0 inside."""

    def __init__(self, surface: Surface, ends: Sequence[End] = ()):
        """Takes a surface with outward normals; its open ends are no wall."""
        import igl

        faces = np.ascontiguousarray(surface.faces, dtype=np.int64)
        vertices = np.ascontiguousarray(surface.vertices)
        self._free = [end for end in ends if end.open]
        cap = np.zeros(len(faces), dtype=bool)
        for end in self._free:
            level = np.abs((vertices - end.position) @ end.direction)
            cap |= (level[faces] < _CAP).all(axis=1)
        self._vertices, self._wall = vertices, faces[~cap]
        self._boxes = igl.AABB()
        self._boxes.init(vertices, self._wall)
        self._winding = igl.FastWindingNumberBVH()
        self._winding.init(vertices, faces, 2)
        corners = vertices[self._wall]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        sizes = np.linalg.norm(normals, axis=1, keepdims=True)
        self._normals = normals / np.maximum(sizes, 1e-300)
        # Triangles with a neighbour, by a common corner, whose normal differs much.
        count = len(self._wall)
        places = np.repeat(np.arange(count), 3), self._wall.ravel()
        at = coo_array((np.ones(3 * count), places), (count, len(vertices))).tocsr()
        one, other = (at @ at.T).nonzero()
        sharp = np.vecdot(self._normals[one], self._normals[other]) < _SMOOTH
        self._sharp = np.bincount(one, sharp, count) > 0

    def __call__(self, points: Array) -> Array:
        """Signed distances (...) m at points (..., 3) m, > 0 inside."""
        shape = np.shape(points)[:-1]
        points = np.ascontiguousarray(np.reshape(points, (-1, 3)), dtype=np.float64)
        squared, face, place = self._boxes.squared_distance(
            self._vertices, self._wall, points
        )
        distance = np.sqrt(squared)
        # The normal of a triangle gives the side of a point, except where the surface
        # turns sharply; there, and at an open end, the winding number does.
        level = np.vecdot(place - points, self._normals[face])
        depth = np.copysign(distance, level)
        doubtful = self._sharp[face] & (np.abs(level) < _BEFORE * distance)
        # Beyond an open end the lumen continues as a straight tube.
        moved = points.copy()
        for end in self._free:
            offset = points - end.position
            level = offset @ end.direction
            across = np.linalg.norm(offset - level[:, None] * end.direction, axis=1)
            beyond = (level > -_CAP) & (across < 2.0 * end.radius)
            beyond &= level < 5.0 * MARGIN
            moved[beyond] -= (level[beyond] + 2.0 * _CAP)[:, None] * end.direction
            doubtful |= beyond
        if doubtful.any():
            inside = self._winding.winding_number(moved[doubtful], 2.0) > 0.5
            depth[doubtful] = np.where(inside, 1.0, -1.0) * distance[doubtful]
        return depth.reshape(shape)

    @property
    def box(self) -> tuple[Array, Array]:
        """Corners (3,), (3,), m, of a box around the surface."""
        return self._vertices.min(axis=0), self._vertices.max(axis=0)

    def around(self, blocks: Array, points: Array) -> Array:
        """Signed distances (n, m) m at blocks (n, 3) + points (m, 3) m, > 0 inside."""
        every = np.asarray(blocks)[:, None] + points
        # Lattices of neighbouring blocks share their faces.
        cell = np.rint((every - every.min(axis=(0, 1))) / _SAME).astype(np.int64)
        _, y, z = cell.max(axis=(0, 1)) + 1
        key = (cell[..., 0] * y + cell[..., 1]) * z + cell[..., 2]
        _, first, same = np.unique(key, return_index=True, return_inverse=True)
        return self(every.reshape(-1, 3)[first])[same].reshape(every.shape[:-1])
