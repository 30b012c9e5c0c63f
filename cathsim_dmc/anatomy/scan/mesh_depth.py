"""Signed depth inside a closed triangle mesh, exact and sampled on a lattice."""

from __future__ import annotations

import numpy as np

from cathsim_dmc.anatomy.wall.depth import (
    BRICK,
    DEEP,
    OUTER,
    QUANTUM,
    SPACING,
    DepthField,
)

LEAF = 4  # triangles in a leaf of the search tree
MARGIN = 8e-3  # m, by which a lattice exceeds the mesh's bounding box


class MeshDepth:
    """Exact signed depth inside a closed triangle mesh.

    The sign comes from the angle-weighted pseudonormal of the nearest face, edge or
    vertex (Baerentzen & Aanaes 2005), which is right where nearest features meet.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        """Prepare for ``vertices`` (V, 3) m and ``faces`` (F, 3), normals outward."""
        self._points = np.ascontiguousarray(vertices, dtype=np.float64)
        self._faces = faces = np.asarray(faces, dtype=np.int64)
        triangles = np.asarray(vertices, dtype=np.float64)[faces]
        normals = _feature_normals(triangles, faces, len(vertices))
        self._order = _along_a_curve(triangles.mean(axis=1))
        self._triangles = np.ascontiguousarray(triangles[self._order])
        self._normals = np.ascontiguousarray(normals[self._order])
        self._boxes, self._first = _box_tree(self._triangles)

    @property
    def mean_area(self) -> float:
        """Mean area of the triangles, m^2."""
        a, b, c = (self._triangles[:, k] for k in range(3))
        return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).mean())

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Depth (n,) m at ``points`` (n, 3) m, > 0 inside."""
        return self.nearest(points)[0]

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth (n,) m at ``points`` (n, 3) m, and the nearest face (n,)."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        depth, owner = self.around(points, np.zeros((1, 3)))
        return depth[:, 0], owner[:, 0]

    def around(
        self, blocks: np.ndarray, points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Depth (n, m) m at ``blocks`` (n, 3) + ``points`` (m, 3), m; nearest face.

        Much faster than point by point where the points of a block lie together.
        """
        from cathsim_dmc.anatomy.scan.closest import signed_depths

        depth, owner = signed_depths(
            np.ascontiguousarray(blocks, dtype=np.float64),
            np.ascontiguousarray(points, dtype=np.float64),
            self._triangles,
            self._normals,
            self._boxes,
            LEAF,
            self._first,
        )
        return depth, self._order[owner]

    def blocked_share(
        self, points: np.ndarray, rays: np.ndarray, normals: np.ndarray
    ) -> np.ndarray:
        """Share (n,) of rays (m, 3) on the side of ``normals`` (n, 3) that hit.

        The rays start at ``points`` (n, 3) m; a normal of zero takes all of them.
        """
        from cathsim_dmc.anatomy.scan.closest import blocked_share

        arrays = [np.ascontiguousarray(each, np.float64) for each in (points, rays)]
        return blocked_share(
            *arrays,
            np.ascontiguousarray(normals, np.float64),
            self._triangles,
            self._boxes,
            LEAF,
            self._first,
        )

    def crossings(self) -> tuple[np.ndarray, np.ndarray]:
        """Faces that an edge of another face pierces, and those edges' vertices.

        Returns:
            (faces (n,), edges (n, 2)), one pair for every crossing.
        """
        from cathsim_dmc.anatomy.scan.closest import crossing_faces

        edges = np.sort(self._faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges = np.unique(edges, axis=0)
        found = crossing_faces(
            edges,
            self._points,
            np.ascontiguousarray(self._faces[self._order]),
            self._triangles,
            self._boxes,
            LEAF,
            self._first,
        )
        pairs = np.array(found, dtype=np.int64).reshape(-1, 2)
        return self._order[pairs[:, 1]], edges[pairs[:, 0]]


def depth_field(
    vertices: np.ndarray,
    faces: np.ndarray,
    spacing: float = SPACING,
    margin: float = MARGIN,
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
    # The smaller a block, the fewer triangles it asks about: bricks are cut into as
    # many as suit the triangles' size, the last one in each direction with the planes
    # that bricks share.
    edge = np.sqrt(measure.mean_area)
    cells = BRICK // 2 if spacing * BRICK < 4.0 * edge else BRICK // 4
    stops = [*range(0, BRICK, cells), BRICK + 1]
    parts = [slice(*pair) for pair in zip(stops[:-1], stops[1:], strict=True)]
    for start in range(0, len(rows), 4096):
        base = origin + wide * rows[start : start + 4096]
        for i in parts:
            for j in parts:
                for k in parts:
                    points = local[i, j, k]
                    depth, _ = measure.around(base, points.reshape(-1, 3))
                    depth = np.clip(np.rint(depth / QUANTUM), -32767, 32767)
                    part = depth.reshape(-1, *points.shape[:-1])
                    bricks[start : start + 4096, i, j, k] = part
    return DepthField(origin, float(spacing), coarse.astype(np.float32), index, bricks)


def _along_a_curve(points: np.ndarray) -> np.ndarray:
    """Order (n,) of points along a Z-shaped curve: neighbours in it lie together."""
    low, size = points.min(0), np.maximum(np.ptp(points, axis=0).max(), 1e-12)
    cell = ((points - low) / size * 1023.0).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _box_tree(triangles: np.ndarray) -> tuple[np.ndarray, int]:
    """Boxes (n, 2, 3) of a complete binary tree, and the number of its first leaf."""
    leaves = 1 << int(np.ceil(np.log2(max(1, -(-len(triangles) // LEAF)))))
    boxes = np.empty((2 * leaves - 1, 2, 3))
    boxes[:, 0], boxes[:, 1] = np.inf, -np.inf
    owner = leaves - 1 + np.arange(len(triangles)) // LEAF
    np.minimum.at(boxes[:, 0], owner, triangles.min(axis=1))
    np.maximum.at(boxes[:, 1], owner, triangles.max(axis=1))
    first = leaves - 1
    while first:
        above = (first - 1) // 2
        pairs = boxes[first : 2 * first + 1].reshape(-1, 2, 2, 3)
        boxes[above:first, 0] = pairs[:, :, 0].min(axis=1)
        boxes[above:first, 1] = pairs[:, :, 1].max(axis=1)
        first = above
    return boxes, leaves - 1


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
