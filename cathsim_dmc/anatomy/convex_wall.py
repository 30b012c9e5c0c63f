"""Convex pieces around a lumen, for engines that collide nothing but convex shapes.

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
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.parts import INLET_HOLE_RADIUS, Inlet
from cathsim_dmc.anatomy.scan.extract import DEVICE_RADIUS
from cathsim_dmc.anatomy.scan.inlet import cut_open
from cathsim_dmc.anatomy.scan.topology import adjacent, decimated

TRIANGLES = 5_000  # of the surface that carries prisms; others are decimated
THICKNESS = 4e-3  # m, of the wall where no other lumen is near
THINNEST = 0.3e-3  # m, of the wall between two lumens
TOLERANCE = 0.65e-3  # m, largest chord inside the lumen before moving outwards
CHORD = 0.4e-3  # m, largest chord after it; pieces above are split again
MOVE = 0.3e-3  # m, largest outward movement of a vertex
EXTENT = 40e-3  # m, largest piece; longer ones slow the broad phase
CLEARANCE = 0.1e-3  # m, kept between a 5 Fr device on the centreline and a merged hull
CAP_OVERLAP = 2e-3  # m, of the inlet's cap under the wall around it
CAPS = (1.0, 0.5, 0.25, 0.1)  # shares of the thickness tried for a lone triangle
_ORDER = 6  # subdivision of a hull's triangles where its depth is sampled
_BEHIND = 0.05e-3  # m, of the surface that is cut off ahead of the inlet's flat cap


def wall_pieces(anatomy: Anatomy) -> tuple[np.ndarray, ...]:
    """Vertices (n_i, 3) m of convex pieces around the lumen; takes seconds.

    The pieces lie outside the lumen but for chords of some tenths of a millimetre. The
    inlet is closed but for a hole of `INLET_HOLE_RADIUS`.
    """
    inlet, surface = anatomy.inlet, anatomy.surface
    vertices, faces = decimated(surface.vertices, surface.faces, TRIANGLES)
    at = inlet.position + _BEHIND * inlet.direction
    points, shell, cap = cut_open(vertices, faces, replace(inlet, position=at))
    lines = [vessel.centreline for vessel in anatomy.tree.vessels.values()]
    builder = _Builder(points, shell, anatomy.lumen, [line.points for line in lines])
    tolerance = TOLERANCE
    pieces = builder.merge(range(len(builder.faces)), tolerance)
    for _ in range(5):
        builder.relax(pieces)
        bad = [each for each in pieces if len(each.faces) > 1 and builder.after(each)]
        if not bad:
            break
        # Where moving outwards did not help, merge again more carefully.
        tolerance *= 0.6
        kept = [each for each in pieces if all(each is not other for other in bad)]
        pieces = kept + builder.merge(
            [f for each in bad for f in each.faces], tolerance
        )
    return (*builder.hulls(pieces), *_inlet_cap(points[cap[:, :2]], inlet))


@dataclass
class _Piece:
    faces: list[int]
    ids: np.ndarray  # vertices that span the hull
    cap: float  # share of the thickness
    cost: float  # m, deepest point of the hull in the lumen


class _Builder:
    def __init__(self, vertices, faces, field, lines):
        self.vertices, self.faces, self.field = vertices, faces, field
        self.normals = _outward_normals(vertices, faces)
        self.reach = _free_thickness(field, vertices, self.normals)
        self.shift = np.zeros(len(vertices))
        self._centres = np.concatenate(lines)
        depth = field(self._centres)
        self._required = np.minimum(DEVICE_RADIUS + CLEARANCE, 0.8 * depth)
        self._near = cKDTree(self._centres)
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
        if cost <= limit < np.inf:
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

    def lone(self, face):
        """A piece over one triangle, as thick as its surroundings allow."""
        best = None
        for cap in CAPS:
            cost, ids = self.measure(np.unique(self.faces[face]), cap, np.inf)
            if best is None or cost < best.cost - 1e-6:
                best = _Piece([face], ids, cap, cost)
            if cost <= 0.05e-3:
                break
        assert best is not None  # there are CAPS
        return best

    def merge(self, faces, tolerance):
        """Merge triangles greedily, the pair whose hull cuts the least first."""
        self.shift = np.zeros(len(self.vertices))
        pieces = {face: self.lone(face) for face in faces}
        neighbours = {key: set() for key in pieces}
        for a, b in adjacent(self.faces).tolist():
            if a in pieces and b in pieces:
                neighbours[a].add(b)
                neighbours[b].add(a)
        fresh = itertools.count(len(self.faces))
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

    def relax(self, pieces):
        """Move vertices outwards by half of the chords around them."""
        shift = np.zeros(len(self.vertices))
        for piece in pieces:
            ids = np.unique(self.faces[piece.faces])
            shift[ids] = np.maximum(shift[ids], 0.5 * max(piece.cost, 0.0))
        # Between two lumens there is no room to move into.
        self.shift = np.minimum(np.minimum(shift, MOVE), 0.5 * self.reach)

    def after(self, piece):
        """Whether a piece's hull cuts too deep after the movement."""
        ids = np.unique(self.faces[piece.faces])
        return self.measure(ids, piece.cap, np.inf)[0] > CHORD

    def hulls(self, pieces):
        """Hull vertices (n, 3) m of every piece after the movement."""
        for piece in pieces:
            points = self.corners(np.unique(self.faces[piece.faces]), piece.cap)
            yield points[ConvexHull(points).vertices]


def _inlet_cap(border: np.ndarray, inlet: Inlet) -> list[np.ndarray]:
    """Convex sectors that close the cut at the inlet but for the sheath's hole.

    Args:
        border: (n, 2, 3) m, edges of the cut through the lumen.
        inlet: the plane of the cut and the middle of the hole.
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
        sectors.append(np.concatenate([face, face - THICKNESS * inlet.direction]))
    return sectors


def _outward_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3) that lean outwards from all triangles around a vertex.

    The angle-weighted mean can point into one of the triangles where the surface
    folds sharply; the worst triangle is then added until it no longer does.
    """
    import igl

    flat = igl.per_face_normals(vertices, faces, np.zeros(3))
    weighting = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
    normals = igl.per_vertex_normals(vertices, faces, weighting)
    normals[~np.isfinite(normals)] = 0.0  # of vertices without triangles
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


def _free_thickness(field, vertices, normals):
    """How far (V,) m each vertex can move out before another lumen comes near."""
    reach = np.full(len(vertices), THINNEST)
    going = np.ones(len(vertices), dtype=bool)
    for s in np.arange(0.4e-3, THICKNESS + 1e-9, 0.2e-3):
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
