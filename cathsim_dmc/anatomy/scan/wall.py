"""Convex wall pieces around the lumen of a scan.

Every triangle of the lumen surface carries a prism that reaches outwards along the
vertex normals; neighbours share their side faces, so nothing can pass between two of
them. Prisms are then merged, the cheapest pair first, into the convex hull of both,
as long as that hull stands less than a tolerance inside the lumen. Half of what a
hull stands inside is given back by moving its vertices outwards, equally for all
hulls that share a vertex, which keeps the wall closed.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from cathsim_dmc.anatomy.parts import Inlet
from cathsim_dmc.anatomy.wall.depth import DepthField
from cathsim_dmc.anatomy.wall.pieces import INLET_HOLE_RADIUS

THICKNESS = 4e-3  # m, of the wall where no other lumen is near
THINNEST = 0.3e-3  # m, of the wall between two lumens
TOLERANCE = 0.65e-3  # m, largest chord inside the lumen before moving outwards
CHORD = 0.4e-3  # m, largest chord after it; pieces above are split again
MOVE = 0.3e-3  # m, largest outward movement of a vertex
FLAT = 0.02e-3  # m, triangles this close to one plane merge without asking
EXTENT = 40e-3  # m, largest piece; longer ones slow the broad phase
DEVICE_RADIUS = 0.84e-3  # m, 5 Fr catheter (1 Fr = 1/3 mm diameter)
CLEARANCE = 0.1e-3  # m, kept between that device on the centreline and a merged hull
CAP_OVERLAP = 2e-3  # m, of the inlet's cap under the wall around it
CAPS = (1.0, 0.5, 0.25, 0.1)  # shares of the thickness tried for a lone triangle
_ORDER = 6  # subdivision of a hull's triangles where its depth is sampled


@dataclass(frozen=True)
class WallReport:
    """How the wall came about: counts and the intrusion seen while building (m)."""

    triangles: int
    pieces: int
    worst: float
    moved: float


def build_wall(
    vertices: np.ndarray,
    faces: np.ndarray,
    field: DepthField,
    centres: np.ndarray,
    *,
    tolerance: float = TOLERANCE,
    thickness: float = THICKNESS,
    move: float = MOVE,
    progress: Callable[[str], None] | None = None,
) -> tuple[tuple[np.ndarray, ...], WallReport]:
    """Convex pieces that surround a lumen.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3) int, normals out of the lumen; open where the device enters.
        field: depth of the lumen.
        centres: (n, 3) m, places a device must be able to pass.
        tolerance: m, how far the hull of a merged piece may cut into the lumen.
        thickness: m, of the wall.
        move: m, largest outward movement of the inner vertices.
        progress: called with a line of text now and then.

    Returns:
        (vertices of each convex piece (n_i, 3) m, report).
    """
    say = progress or (lambda text: None)
    builder = _Builder(vertices, faces, field, centres, thickness)
    patches = _flat_patches(builder.vertices, builder.faces, EXTENT)
    say(f"wall: {len(faces)} triangles in {len(patches)} flat patches")
    pieces = builder.merge(patches, tolerance, say)
    for _ in range(5):
        builder.shift = builder.relax(pieces, move)
        after = [builder.after(piece) for piece in pieces]
        bad = [
            piece
            for piece, cost in zip(pieces, after, strict=True)
            if cost > CHORD and len(piece.faces) > 1
        ]
        if not bad:
            break
        # Where moving outwards did not help, merge again more carefully.
        tolerance *= 0.6
        good = [piece for piece in pieces if not any(piece is other for other in bad)]
        split = [[face] for piece in bad for face in piece.faces]
        say(f"wall: {len(bad)} pieces cut too deep; merged again")
        pieces = good + builder.merge(split, tolerance, say)
    hulls, worst = builder.hulls(pieces), max(after, default=0.0)
    moved = float(builder.shift.max(initial=0.0))
    report = WallReport(len(faces), len(hulls), worst, moved)
    say(f"wall: {report.pieces} pieces, chords up to {worst * 1e3:.2f} mm")
    return hulls, report


@dataclass
class _Piece:
    faces: list[int]
    ids: np.ndarray  # vertices that span the hull
    cap: float  # share of the thickness
    cost: float  # m, deepest point of the hull in the lumen


class _Builder:
    def __init__(self, vertices, faces, field, centres, thickness):
        self.vertices = np.asarray(vertices, dtype=np.float64)
        self.faces = np.asarray(faces)
        self.field = field
        self.normals = outward_normals(self.vertices, self.faces)
        self.reach = free_thickness(field, self.vertices, self.normals, thickness)
        self.shift = np.zeros(len(self.vertices))
        self._centres = centres
        depth = field(centres) if len(centres) else np.zeros(0)
        self._required = np.minimum(DEVICE_RADIUS + CLEARANCE, 0.8 * depth)
        self._near = cKDTree(centres) if len(centres) else None
        self._pattern = _barycentric(_ORDER)

    def corners(self, ids, cap):
        """Inner and outer corners (2 n, 3) over the vertices ``ids``."""
        base, normal = self.vertices[ids], self.normals[ids]
        inner = self.shift[ids]
        outer = inner + np.maximum(self.reach[ids] * cap, THINNEST)
        return np.concatenate(
            [base + inner[:, None] * normal, base + outer[:, None] * normal]
        )

    def measure(self, ids, cap, limit):
        """Deepest point of the hull in the lumen, and the ids that span it."""
        points = self.corners(ids, cap)
        low, high = points.min(0), points.max(0)
        if limit < np.inf and np.linalg.norm(high - low) > EXTENT:
            return np.inf, ids
        try:
            hull = ConvexHull(points)
        except QhullError:
            return np.inf, ids
        corners = points[hull.simplices]
        samples = np.einsum("pk,nkd->npd", self._pattern, corners).reshape(-1, 3)
        cost = float(self.field(samples).max())
        if cost <= limit < np.inf and self._near is not None:
            middle = 0.5 * (low + high)
            radius = 0.5 * np.linalg.norm(high - low) + 1.5e-3
            close = self._near.query_ball_point(middle, radius)
            if close:
                gap = (
                    self._centres[close] @ hull.equations[:, :3].T
                    + hull.equations[:, 3]
                ).max(axis=1)
                if (gap < self._required[close]).any():
                    return np.inf, ids
        return cost, ids[np.unique(hull.vertices % len(ids))]

    def lone(self, faces):
        """A piece over one patch, as thick as its surroundings allow."""
        every = np.unique(self.faces[faces])
        best = None
        for cap in CAPS:
            cost, ids = self.measure(every, cap, np.inf)
            if best is None or cost < best.cost - 1e-6:
                best = _Piece(list(faces), ids, cap, cost)
            if cost <= 0.05e-3:
                break
        assert best is not None  # there are CAPS
        return best

    def merge(self, patches, tolerance, say):
        """Merge pieces greedily, the pair whose hull cuts the least first."""
        self.shift = np.zeros(len(self.vertices))
        pieces = {}
        for index, patch in enumerate(patches):
            piece = self.lone(patch)
            if piece.cost > tolerance and len(patch) > 1:
                for face in patch:
                    pieces[len(patches) + face] = self.lone([face])
            else:
                pieces[index] = piece
        owner = np.full(len(self.faces), -1, dtype=np.int64)
        for key, piece in pieces.items():
            owner[piece.faces] = key
        neighbours = {key: set() for key in pieces}
        for a, b in adjacent_faces(self.faces):
            if owner[a] != owner[b] and min(owner[a], owner[b]) >= 0:
                neighbours[owner[a]].add(owner[b])
                neighbours[owner[b]].add(owner[a])
        fresh = itertools.count(len(patches) + len(self.faces))
        heap = []

        def propose(a, b):
            one, two = pieces[a], pieces[b]
            ids = np.union1d(one.ids, two.ids)
            cap = min(one.cap, two.cap)
            cost, ids = self.measure(ids, cap, tolerance)
            if cost <= tolerance:
                heapq.heappush(heap, (cost, a, b, cap, ids))

        for a in list(neighbours):
            for b in neighbours[a]:
                if a < b:
                    propose(a, b)
        say(f"wall: {len(pieces)} pieces, {len(heap)} pairs can merge")
        while heap:
            cost, a, b, cap, ids = heapq.heappop(heap)
            if a not in pieces or b not in pieces:
                continue
            one, two = pieces.pop(a), pieces.pop(b)
            key = next(fresh)
            pieces[key] = _Piece(one.faces + two.faces, ids, cap, cost)
            around = (neighbours.pop(a) | neighbours.pop(b)) - {a, b}
            neighbours[key] = around
            for other in around:
                neighbours[other] -= {a, b}
                neighbours[other].add(key)
                propose(key, other)
        return list(pieces.values())

    def relax(self, pieces, move):
        """Outward movement (V,) m: half of the chords around every vertex."""
        shift = np.zeros(len(self.vertices))
        for piece in pieces:
            ids = np.unique(self.faces[piece.faces])
            shift[ids] = np.maximum(shift[ids], 0.5 * max(piece.cost, 0.0))
        # Between two lumens there is no room to move into.
        return np.minimum(np.minimum(shift, move), 0.5 * self.reach)

    def after(self, piece):
        """Deepest point (m) of a piece's hull in the lumen after the movement."""
        return self.measure(np.unique(self.faces[piece.faces]), piece.cap, np.inf)[0]

    def hulls(self, pieces):
        """Hull vertices (n, 3) m of every piece after the movement."""
        hulls = []
        for piece in pieces:
            every = np.unique(self.faces[piece.faces])
            points = self.corners(every, piece.cap)
            hulls.append(points[ConvexHull(points).vertices])
        return tuple(hulls)


def inlet_cap(
    border: np.ndarray, inlet: Inlet, thickness: float = THICKNESS
) -> list[np.ndarray]:
    """Convex sectors that close the cut at the inlet but for the sheath's hole.

    Args:
        border: (n, 2, 3) m, edges of the cut through the lumen.
        inlet: the plane of the cut and the middle of the hole.
        thickness: m, of the cap, which lies behind the plane.
    """
    # A chord between two spokes cuts into the hole less than this at 12 sectors.
    hole = INLET_HOLE_RADIUS / np.cos(np.pi / 12)
    spokes = border - inlet.position
    reach = np.linalg.norm(spokes, axis=-1, keepdims=True)
    spokes = spokes / np.maximum(reach, 1e-9)
    sectors = []
    for spoke, far in zip(spokes, reach, strict=True):
        if far.max() <= hole:
            continue
        face = inlet.position + np.concatenate(
            [hole * spoke, np.maximum(far, hole) * spoke + CAP_OVERLAP * spoke]
        )
        sectors.append(np.concatenate([face, face - thickness * inlet.direction]))
    return sectors


def outward_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3) that lean outwards from all triangles around a vertex.

    The angle-weighted mean can point into one of the triangles where the surface
    folds sharply; the worst triangle is then added until it no longer does.
    """
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30)
    normals = np.zeros_like(vertices)
    for k in range(3):
        u = corners[:, (k + 1) % 3] - corners[:, k]
        v = corners[:, (k + 2) % 3] - corners[:, k]
        size = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
        cosine = np.einsum("nd,nd->n", u, v) / np.maximum(size, 1e-30)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        np.add.at(normals, faces[:, k], angle[:, None] * flat)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    for _ in range(20):
        lean = np.einsum("fkd,fd->fk", normals[faces], flat)
        push = np.zeros_like(vertices)
        for k in range(3):
            low = lean[:, k] < 0.2
            np.add.at(push, faces[low, k], 0.25 * flat[low])
        if not push.any():
            break
        normals = normals + push
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return normals


def free_thickness(field, vertices, normals, thickness):
    """How far (V,) m each vertex can move out before another lumen comes near."""
    reach = np.full(len(vertices), THINNEST)
    going = np.ones(len(vertices), dtype=bool)
    for s in np.arange(0.4e-3, thickness + 1e-9, 0.2e-3):
        outside = -field(vertices + s * normals)
        going &= outside > 0.35 * s
        reach[going] = s
    return reach


def _barycentric(order: int) -> np.ndarray:
    """Weights of a regular sampling of a triangle, corners left out."""
    rows = [
        (i, j, order - i - j) for i in range(order + 1) for j in range(order + 1 - i)
    ]
    weights = np.array([row for row in rows if max(row) < order]) / order
    return weights


def adjacent_faces(faces: np.ndarray) -> np.ndarray:
    """Pairs (n, 2) of triangles that share an edge."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    return np.stack([owner[:-1][same], owner[1:][same]], -1)


def _flat_patches(vertices, faces, extent) -> list[list[int]]:
    """Triangles grouped where they lie in one plane: a fine scan has many such."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(area, 1e-30)[:, None]
    neighbours: list[list[int]] = [[] for _ in range(len(faces))]
    for a, b in adjacent_faces(faces):
        neighbours[a].append(int(b))
        neighbours[b].append(int(a))
    patch = np.full(len(faces), -1)
    patches = []
    for seed in np.argsort(-area):
        if patch[seed] >= 0:
            continue
        origin, axis = corners[seed].mean(0), normal[seed]
        group, queue = [int(seed)], [int(seed)]
        patch[seed] = len(patches)
        while queue:
            for other in neighbours[queue.pop()]:
                if patch[other] >= 0 or normal[other] @ axis < 0.95:
                    continue
                away = corners[other] - origin
                if np.abs(away @ axis).max() > FLAT:
                    continue
                if np.linalg.norm(away, axis=1).max() > 0.25 * extent:
                    continue
                patch[other] = len(patches)
                group.append(other)
                queue.append(other)
        patches.append(group)
    return patches
