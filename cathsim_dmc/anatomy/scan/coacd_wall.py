"""Convex decomposition (CoACD) of the shell around a scan's lumen.

The alternative to the merged prisms of ``scan_wall``: what most simulators use, and
here to compare with. The shell is cut across the vessels into short rings and these
into sectors, and each such block is decomposed by itself, in millimetres and along
its own axes, because CoACD cuts parallel to the axes and its search grows faster
than the number of triangles. Blocks whose hulls would stop the device are decomposed
again with half the threshold.

Wei et al., Approximate Convex Decomposition for 3D Meshes with Collision-Aware
Concavity and Tree Search, SIGGRAPH 2022.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.scan.wall import (
    CLEARANCE,
    DEVICE_RADIUS,
    THICKNESS,
    free_thickness,
    outward_normals,
)
from cathsim_dmc.anatomy.wall.depth import DepthField

THRESHOLD = 3.5e-3  # m, CoACD's concavity of a piece; 3 mm gives 1,700 pieces
THRESHOLDS = (0.1e-3, 10e-3)  # m, allowed
SHARE = 1.05  # of the lumen's radius: narrow vessels get a smaller threshold
# CoACD's concavity of a sector of a ring over the height of its chord: 2 to 4 when
# an ideal ring (radius 10 mm) was decomposed at 1 to 3 mm.
CHORDS = 3.0
SECTION = 15e-3  # m, length of a ring along its vessel
HALVINGS = 3  # of the threshold of a block that stops the device
SLIVER = 1e-12  # m^2, smaller triangles are left out
# Coarser than CoACD's own search (20, 150, 3): blocks are simple, and there are many.
SEARCH = {"mcts_nodes": 10, "mcts_iterations": 30, "mcts_max_depth": 2}


@dataclass(frozen=True)
class CoacdReport:
    """How the wall came about.

    Attributes:
        blocks: sectors of rings, decomposed one by one.
        pieces: hulls in all.
        refined: blocks that took a smaller threshold to let the device pass.
        prisms: blocks that stopped it still and became one prism per triangle.
    """

    blocks: int
    pieces: int
    refined: int
    prisms: int


def load_coacd():
    """The package coacd, quiet."""
    import coacd

    coacd.set_log_level("error")
    return coacd


def check_threshold(threshold: float) -> float:
    """``threshold`` (m) if it is one; ValueError says what is allowed."""
    low, high = THRESHOLDS
    return bounds.number("threshold", threshold, low, high, "m")


def decompose_wall(
    vertices: np.ndarray,
    faces: np.ndarray,
    field: DepthField,
    tree: VesselTree,
    *,
    threshold: float = THRESHOLD,
    thickness: float = THICKNESS,
    progress: Callable[[str], None] | None = None,
) -> tuple[tuple[np.ndarray, ...], CoacdReport]:
    """Convex pieces that surround a lumen, by CoACD.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3) int, normals out of the lumen; open where the device enters.
        field: depth of the lumen.
        tree: vessels, along which the shell is cut into blocks.
        threshold: m, largest concavity of a piece as CoACD measures it, no bound of
            how far it stands in the lumen; less where the lumen is narrow.
        thickness: m, of the wall.
        progress: called with a line of text now and then.

    Returns:
        (vertices of each convex piece (n_i, 3) m, report).

    Raises:
        ValueError: if the threshold is out of range.
    """
    coacd, threshold = load_coacd(), check_threshold(threshold)
    say = progress or (lambda text: None)
    normals = outward_normals(vertices, faces)
    reach = free_thickness(field, vertices, normals, thickness)
    outer = vertices + reach[:, None] * normals
    centres = np.concatenate([v.centreline.points for v in tree.vessels.values()])
    passage = _Passage(centres, field(centres))
    blocks = list(_blocks(vertices, outer, faces, tree, threshold))
    say(f"wall: CoACD on {len(blocks)} blocks")
    hulls: list[np.ndarray] = []
    refined = prisms = 0
    for number, (solid, frame, radius) in enumerate(blocks):
        limit = min(threshold, SHARE * radius)
        for halving in range(HALVINGS + 1):
            pieces = _decompose(coacd, solid, frame, limit * 0.5**halving)
            if passage.free(pieces):
                refined += halving > 0
                break
        else:
            prisms += 1
            pieces = solid.prisms()
        hulls += pieces
        if number % 200 == 199:
            say(f"wall: {number + 1} blocks, {len(hulls)} pieces")
    report = CoacdReport(len(blocks), len(hulls), refined, prisms)
    say(f"wall: {len(hulls)} pieces, {refined} blocks refined, {prisms} of prisms")
    return tuple(hulls), report


@dataclass(frozen=True)
class _Solid:
    """Part of the shell: inner and outer points (n, 3) m over triangles (m, 3)."""

    inner: np.ndarray
    outer: np.ndarray
    triangles: np.ndarray

    def closed(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (2 n, 3) and triangles of the closed surface, normals outwards."""
        n = len(self.inner)
        edges = self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        key = edges[:, 0] * n + edges[:, 1]
        border = edges[~np.isin(key, edges[:, 1] * n + edges[:, 0])]
        a, b = border.T
        faces = np.concatenate(
            [
                self.triangles[:, ::-1],
                self.triangles + n,
                np.stack([a, b, b + n], -1),
                np.stack([a, b + n, a + n], -1),
            ]
        )
        return np.concatenate([self.inner, self.outer]), faces

    def prisms(self) -> list[np.ndarray]:
        """One piece (6, 3) per triangle."""
        rows = [np.concatenate([self.inner[t], self.outer[t]]) for t in self.triangles]
        return [piece for piece in rows if _hull(piece) is not None]


class _Passage:
    """Whether a device on the centrelines stays clear of wall pieces."""

    def __init__(self, centres, depth):
        self._centres = centres
        self._required = np.minimum(DEVICE_RADIUS + CLEARANCE, 0.8 * depth)
        self._tree = cKDTree(centres)

    def free(self, pieces) -> bool:
        for piece in pieces:
            middle = 0.5 * (piece.min(0) + piece.max(0))
            radius = np.linalg.norm(piece - middle, axis=1).max() + 1.5e-3
            close = self._tree.query_ball_point(middle, radius)
            if not close:
                continue
            planes = ConvexHull(piece).equations
            gap = self._centres[close] @ planes[:, :3].T + planes[:, 3]
            if (gap.max(axis=1) < self._required[close]).any():
                return False
        return True


def _hull(points):
    try:
        return ConvexHull(points * 1e3)
    except QhullError:
        return None


def _decompose(coacd, solid: _Solid, frame, threshold) -> list[np.ndarray]:
    """Hulls (n, 3) m of a solid; ``frame`` (3, 3) has its axes as rows."""
    points, faces = solid.closed()
    origin = points.mean(0)
    parts = coacd.run_coacd(
        coacd.Mesh((points - origin) @ frame.T * 1e3, faces),
        threshold=threshold * 1e3,
        real_metric=True,
        preprocess_mode="off",  # the solid is closed as it is
        seed=0,
        **SEARCH,
    )
    hulls = []
    for part, _ in parts:
        hull = _hull(np.asarray(part) * 1e-3)
        if hull is not None:
            hulls.append(hull.points[hull.vertices] * 1e-3 @ frame + origin)
    return hulls


def _blocks(vertices, outer, faces, tree, threshold):
    """Blocks of the shell: solids, axes (3, 3) to cut them along, lumen radii.

    Planes of equal arc length cut the shell into rings, planes through the axis of
    a ring cut it into as many sectors as an ideal ring of its radius needs to keep
    to the threshold. What is left for CoACD is where the lumen is no such ring.
    """
    gaps, arcs = [], []
    lines = [vessel.centreline for vessel in tree.vessels.values()]
    for line in lines:
        place = line.project(vertices)
        gaps.append(place.distance - place.radius)
        arcs.append(place.arc_length)
    # A triangle belongs to the vessel whose tube its corners are nearest to.
    owner = np.abs(np.stack(gaps))[:, faces].sum(-1).argmin(0)
    for number, line in enumerate(lines):
        count = max(1, round(line.length / SECTION))
        length = line.length / count
        rings: dict[int, list] = {}
        for face in faces[owner == number]:
            level = arcs[number][face] / length
            first = int(np.clip(np.floor(level.min()), 0, count - 1))
            last = int(np.clip(np.ceil(level.max()) - 1, first, count - 1))
            for ring in range(first, last + 1):
                corners = np.eye(3)
                if ring > first:
                    corners = _clip(corners, level - ring)
                if ring < last:
                    corners = _clip(corners, ring + 1 - level)
                if len(corners) > 2:
                    rings.setdefault(ring, []).append((face, corners))
        for ring, polygons in sorted(rings.items()):
            middle = line.at((ring + 0.5) * length)
            radius, axes = float(middle.radius), _axes(middle.tangent)
            limit = min(threshold, SHARE * radius) / CHORDS
            sectors = int(np.ceil(np.pi / np.arccos(1.0 - limit / radius)))
            spokes = vertices @ axes[:2].T - axes[:2] @ middle.position
            for sector in range(max(3, sectors)):
                triangles = _sector(polygons, spokes, sector, max(3, sectors))
                angle = 2.0 * np.pi * (sector + 0.5) / max(3, sectors)
                out = np.cos(angle) * axes[0] + np.sin(angle) * axes[1]
                frame = np.stack([out, np.cross(axes[2], out), axes[2]])
                for solid in _solids(vertices, outer, triangles):
                    yield solid, frame, radius


def _sector(polygons, spokes, sector, count):
    """Triangles (face, barycentric corners (3, 3)) of one sector of a ring."""
    triangles = []
    start, end = 2.0 * np.pi * np.array([sector, sector + 1]) / count
    for face, corners in polygons:
        x, y = spokes[face].T
        corners = _clip(corners, np.cos(start) * y - np.sin(start) * x)
        corners = _clip(corners, np.sin(end) * x - np.cos(end) * y)
        for k in range(1, len(corners) - 1):
            triangles.append((face, corners[[0, k, k + 1]]))
    return triangles


def _clip(corners, height) -> np.ndarray:
    """Part (m, 3) of a barycentric polygon (n, 3) where ``height`` (3,) is > 0."""
    heights = corners @ height
    kept = []
    for i, corner in enumerate(corners):
        before = corners[i - 1]
        if (heights[i] > 0.0) != (heights[i - 1] > 0.0):
            t = heights[i - 1] / (heights[i - 1] - heights[i])
            kept.append(before + t * (corner - before))
        if heights[i] > 0.0:
            kept.append(corner)
    return np.array(kept).reshape(-1, 3)


def _axes(tangent) -> np.ndarray:
    """Orthonormal rows (3, 3), the last one along ``tangent`` (3,)."""
    side = np.cross(tangent, np.eye(3)[np.abs(tangent).argmin()])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(tangent, side), tangent])


def _solids(vertices, outer, triangles):
    """One solid per connected group of triangles."""
    if not triangles:
        return
    weights = np.array([corners for _, corners in triangles])
    faces = np.array([face for face, _ in triangles])
    inner = np.einsum("nck,nkd->ncd", weights, vertices[faces]).reshape(-1, 3)
    above = np.einsum("nck,nkd->ncd", weights, outer[faces]).reshape(-1, 3)
    # Points that come from the same place of an edge are one, up to rounding.
    _, first, index = np.unique(
        np.rint(inner * 1e8), axis=0, return_index=True, return_inverse=True
    )
    cells = index.reshape(-1, 3)
    corners = inner[first][cells]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cells = cells[0.5 * np.linalg.norm(cross, axis=1) > SLIVER]
    edges = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, edge = np.unique(edges, axis=0, return_inverse=True)
    owner = np.repeat(np.arange(len(cells)), 3)
    order = np.argsort(edge, kind="stable")
    same = edge[order][1:] == edge[order][:-1]
    pairs = (owner[order][:-1][same], owner[order][1:][same])
    link = coo_matrix((np.ones(same.sum()), pairs), shape=(len(cells),) * 2)
    count, label = connected_components(link, directed=False)
    for group in range(count):
        used, local = np.unique(cells[label == group], return_inverse=True)
        rows = first[used]
        yield _Solid(inner[rows], above[rows], local.reshape(-1, 3))
