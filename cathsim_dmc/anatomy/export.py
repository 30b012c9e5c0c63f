"""Export of an anatomy as MJCF with convex wall pieces, and their deviations.

A prism stands on every triangle of the lumen's surface, outwards along the vertex
normals; neighbours share their side faces, so nothing can pass between two of them.
Neighbouring prisms are merged while their hull stays out of the lumen.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial import ConvexHull, cKDTree

from cathsim_dmc import bounds, extras, files
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.merging import merged
from cathsim_dmc.anatomy.parts import INLET_HOLE_RADIUS, Inlet
from cathsim_dmc.anatomy.scan.places import cut_open
from cathsim_dmc.anatomy.scan.topology import adjacent, decimated
from cathsim_dmc.anatomy.scan.ways import DEVICE_RADIUS
from cathsim_dmc.anatomy.surface import sampled

TRIANGLES = 3_000  # of the surface that carries prisms; others are decimated
THICKNESS = 4e-3  # m, of the wall where no other lumen is near
THINNEST = 0.3e-3  # m, of the wall between two lumens
SHIFT = 0.2e-3  # m, of the wall outwards; it offsets the chords of the triangles
MOVE = 0.6e-3  # m, largest outward movement of a vertex
TOLERANCE = 0.25e-3  # m, that a merged piece may protrude into the lumen
_CHORD = 0.08e-3  # m, that a prism may protrude into the lumen
CAP_OVERLAP = 2e-3  # m, of the inlet's cap under the wall around it
CAP_SECTORS = 12
_BEHIND = 0.05e-3  # m, of the surface that is cut off ahead of the inlet's flat cap
_AHEAD = 1e-3  # m from an open end, beyond which the depth is that of the wall alone
_LONGER = 6e-3  # m, by which the lumen is extended behind an open end
_PLACES = 10_000  # sample points of the wall
# Offsets (m) along the normal at which pieces are searched, > 0 in the lumen.
_LEVELS = np.arange(-1.5e-3, 1.5e-3, 0.05e-3)
_GRAZE = 0.05e-3  # m, allowed overlap of a piece and a 5 Fr catheter on a centreline
_OFF = 0.3e-3  # m; surface points farther from the wall are on an open end


class _Shell(NamedTuple):
    """The wall as a thick surface.

    Attributes:
        inner: (V, 3) m, on the lumen.
        outer: (V, 3) m, where the wall ends.
        faces: (F, 3) triangles of both, without the inlet's cap.
        cap: pieces that close the inlet except for its hole.
        depth: (n,) m of points (n, 3) in the lumen, extended behind the inlet.
    """

    inner: np.ndarray
    outer: np.ndarray
    faces: np.ndarray
    cap: list[np.ndarray]
    depth: Callable[[np.ndarray], np.ndarray]


def wall_pieces(anatomy: Anatomy, wall: str = "merged") -> tuple[np.ndarray, ...]:
    """Vertices (n_i, 3) m of convex pieces around the lumen.

    The pieces protrude into the lumen by some tenths of a millimetre at most. A cap
    closes the inlet except for a hole of `INLET_HOLE_RADIUS`.

    Args:
        wall: Division of the wall, a key of `WALLS`: "merged" prisms, "prisms", one
            for each triangle, or "coacd".

    Raises:
        ValueError: if there is no such wall.
        ModuleNotFoundError: if "coacd" is chosen and CoACD is not installed.
    """
    check_wall(wall)
    shell = _shell(bounds.instance("anatomy", anatomy, Anatomy))
    return (*WALLS[wall](shell), *shell.cap)


def check_wall(wall: str) -> None:
    """Raise ValueError or ModuleNotFoundError if this wall cannot be made."""
    bounds.choice("wall", wall, WALLS)
    if wall == "coacd":
        extras.require("export", "coacd")


def _shell(anatomy: Anatomy) -> _Shell:
    inlet, depth = anatomy.inlet, _depth(anatomy)
    vertices, faces = anatomy.surface.vertices.copy(), anatomy.surface.faces
    # Decimation would round the rim of the inlet's flat cap. The cap is moved away, and
    # the part behind the inlet is cut off afterwards.
    behind = (vertices - inlet.position) @ inlet.direction < 2 * _BEHIND
    around = np.linalg.norm(vertices - inlet.position, axis=1) < 1.5 * inlet.radius
    vertices[behind & around] -= _LONGER * inlet.direction
    vertices, faces = decimated(vertices, faces, TRIANGLES)
    at = inlet.position + _BEHIND * inlet.direction
    points, shell, cap = cut_open(vertices, faces, replace(inlet, position=at))
    normals = _outward_normals(points, shell)
    used = np.unique(shell)
    points[used] += depth(points[used])[:, None] * normals[used]
    # How far each vertex can move out before another lumen comes near.
    reach = np.full(len(points), THINNEST)
    going = np.ones(len(points), dtype=bool)
    for s in np.arange(0.4e-3, THICKNESS + 1e-9, 0.2e-3):
        going &= -depth(points + s * normals) > 0.35 * s
        reach[going] = s
    # The movement is limited where another lumen is near.
    room = np.minimum(MOVE, 0.5 * reach)
    moved = np.minimum(SHIFT, room)
    for _ in range(4):
        corners = (points + moved[:, None] * normals)[shell]
        middles = (corners + np.roll(corners, 1, axis=1)) / 2
        places = np.concatenate([middles, corners.mean(axis=1, keepdims=True)], axis=1)
        over = (depth(places).max(axis=1) - _CHORD).clip(0.0)
        push = np.zeros(len(points))
        np.maximum.at(push, shell, over[:, None])
        moved = np.minimum(moved + push, room)
    outward = np.maximum(reach, moved + THINNEST)
    inner, outer = (points + far[:, None] * normals for far in (moved, outward))
    return _Shell(inner, outer, shell, _inlet_cap(points[cap[:, :2]], inlet), depth)


def _depth(anatomy: Anatomy) -> Callable[[np.ndarray], np.ndarray]:
    """Depth function (m) of the lumen, extended behind the inlet by a straight tube."""
    inlet = anatomy.inlet

    def depth(points: np.ndarray) -> np.ndarray:
        return anatomy.lumen(
            _before(points, inlet.position, inlet.direction, inlet.radius)
        )

    return depth


def _before(
    points: np.ndarray, position: np.ndarray, inward: np.ndarray, radius: float
) -> np.ndarray:
    """Points (..., 3), with those at or behind an open end moved `_AHEAD` of it."""
    away = points - position
    height = away @ inward
    aside = np.linalg.norm(away - height[..., None] * inward, axis=-1)
    near = (np.abs(height) < _LONGER) & (height < _AHEAD) & (aside < 1.5 * radius)
    return points + np.where(near, _AHEAD - height, 0.0)[..., None] * inward


def _prisms(shell: _Shell) -> Sequence[np.ndarray]:
    """One prism for each triangle."""
    ends = shell.inner[shell.faces], shell.outer[shell.faces]
    return list(np.concatenate(ends, axis=1))


def _merged(shell: _Shell) -> Sequence[np.ndarray]:
    """Prisms, merged while they stay out of the lumen."""
    pairs = adjacent(shell.faces).tolist()
    return merged(_prisms(shell), pairs, shell.depth, TOLERANCE)


def _coacd(shell: _Shell) -> Sequence[np.ndarray]:
    """Pieces by convex decomposition (CoACD) of patches of the wall."""
    import coacd
    from tqdm import tqdm

    coacd.set_log_level("error")
    inner, outer, faces = shell.inner, shell.outer, shell.faces
    sides = np.diff(inner[faces], axis=1)
    flat = np.cross(sides[:, 0], sides[:, 1])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    # A patch lies on one side of its vessel.
    features = np.hstack([1e3 * inner[faces].mean(axis=1), 4.0 * flat])
    count = len(faces) // _PATCH + 1
    label = kmeans2(features, count, minit="++", seed=0)[1]
    solid, size = 1e3 * np.concatenate([inner, outer]), len(inner)
    pieces = []
    # This takes minutes: a terminal shows a progress bar.
    for k in tqdm(np.unique(label), "CoACD", unit=" patches", disable=None):
        patch = faces[label == k]
        edges = patch[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        paired = (edges[:, None] == edges[:, ::-1]).all(axis=-1).any(axis=1)
        a, b = edges[~paired].T
        sides = np.stack([a, b, b + size, a, b + size, a + size], axis=-1)
        closed = [patch[:, ::-1], patch + size, sides.reshape(-1, 3)]
        mesh = coacd.Mesh(solid, np.concatenate(closed))
        found = coacd.run_coacd(mesh, real_metric=True, **_COACD)
        pieces += [1e-3 * np.asarray(vertices) for vertices, _ in found]
    return pieces


WALLS = {"merged": _merged, "prisms": _prisms, "coacd": _coacd}
_PATCH = 24  # triangles of a patch that CoACD divides
# Largest concavity, mm, and the least search: patches are nearly convex.
_COACD: dict[str, Any] = {
    "threshold": 1.0, "preprocess_mode": "off", "resolution": 500, "seed": 0,
    "mcts_iterations": 10, "mcts_nodes": 5, "mcts_max_depth": 1,
}  # fmt: skip


def _inlet_cap(border: np.ndarray, inlet: Inlet) -> list[np.ndarray]:
    """Convex sectors of the cap behind the edges (n, 2, 3), m, of the cut."""
    spokes = border - inlet.position
    reach = np.linalg.norm(spokes, axis=-1, keepdims=True)
    spokes = spokes / np.maximum(reach, 1e-9)
    first = spokes[0, 0]
    second = np.cross(inlet.direction, first)
    angle = np.arctan2(spokes @ second, spokes @ first) % (2 * np.pi)
    sector = (angle * CAP_SECTORS / (2 * np.pi)).astype(int)
    sectors = []
    for k in range(CAP_SECTORS):
        # An edge across the border of two sectors belongs to both.
        rows = (sector == k).any(axis=1)
        middle = 2 * np.pi * (k + 0.5) / CAP_SECTORS
        span = np.abs((angle[rows] - middle + np.pi) % (2 * np.pi) - np.pi)
        if not rows.any():
            continue
        # A chord between two spokes stays out of the hole.
        hole = INLET_HOLE_RADIUS / np.cos(span.max())
        own, far = spokes[rows].reshape(-1, 3), reach[rows].reshape(-1, 1)
        if far.max() <= hole:
            continue
        face = np.concatenate([hole * own, (np.maximum(far, hole) + CAP_OVERLAP) * own])
        face = face + inlet.position
        sectors.append(np.concatenate([face, face - THICKNESS * inlet.direction]))
    return sectors


def _outward_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit vertex normals (V, 3) that point outwards from all adjacent triangles."""
    import igl

    flat = igl.per_face_normals(vertices, faces, np.zeros(3))
    weighting = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
    normals = igl.per_vertex_normals(vertices, faces, weighting)
    normals[~np.isfinite(normals)] = 0.0  # of vertices without triangles
    # At a sharp fold the mean normal may point into one of the triangles.
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


def fidelity(anatomy: Anatomy, pieces: Sequence[np.ndarray]) -> dict[str, Any]:
    """Measures convex pieces (n_i, 3) m against the lumen of an anatomy.

    Returns:
        `intrusion_mm` and `recession_mm`: mean, 95th percentile and maximum, over
        sample points of the wall, of the protrusion of the pieces into the lumen and
        of their distance behind the wall. `places`: number of sample points.
        `open_places`: number of those without a piece within 1.5 mm behind the wall.
        `closed_to_5fr`: vessels whose centreline a 5 Fr catheter cannot follow.
    """
    points, inward = _wall_places(anatomy)
    met = _within(points[:, None] + _LEVELS[:, None] * inward[:, None], pieces)
    inside = np.where(met, _LEVELS, 0.0).max(axis=1).clip(0.0)
    behind = np.where(met, -_LEVELS, np.inf).min(axis=1).clip(0.0)
    closed = np.isfinite(behind)
    blocked = []
    directions = np.random.default_rng(0).normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for name, vessel in anatomy.tree.vessels.items():
        line, margin = vessel.centreline, 1.5 * DEVICE_RADIUS
        s = np.arange(margin, max(line.length - margin, 1.1 * margin), 1e-3)
        place = line.at(s).position
        free = np.minimum(DEVICE_RADIUS, 0.8 * anatomy.lumen(place)) - _GRAZE
        around = place[:, None] + free[:, None, None] * directions
        if _within(np.concatenate([around, place[:, None]], axis=1), pieces).any():
            blocked.append(name)
    return {
        "intrusion_mm": _summary(inside),
        "recession_mm": _summary(behind[closed]),
        "places": len(points),
        "open_places": int((~closed).sum()),
        "closed_to_5fr": blocked,
    }


def _summary(lengths: np.ndarray) -> dict[str, float]:
    figures = lengths.mean(), np.percentile(lengths, 95), lengths.max()
    rounded = [round(1e3 * float(figure), 3) for figure in figures]
    return dict(zip(("mean", "p95", "max"), rounded, strict=True))


def _within(points: np.ndarray, pieces: Sequence[np.ndarray]) -> np.ndarray:
    """Whether points (..., 3) lie in any of the pieces."""
    flat = points.reshape(-1, 3)
    found, near = np.zeros(len(flat), dtype=bool), cKDTree(flat)
    for piece in pieces:
        middle = piece.mean(axis=0)
        reach = np.linalg.norm(piece - middle, axis=1).max()
        if rows := near.query_ball_point(middle, reach):
            planes = ConvexHull(1e3 * piece).equations * (1, 1, 1, 1e-3)
            height = flat[rows] @ planes[:, :3].T + planes[:, 3]
            found[rows] |= (height < 1e-6).all(axis=-1)
    return found.reshape(points.shape[:-1])


def _wall_places(anatomy: Anatomy) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (n, 3), m, of the wall, and unit normals (n, 3) into the lumen."""
    points, _ = sampled(anatomy.surface, _PLACES)
    inside = points
    for end in anatomy.ends:
        if end.open:
            inside = _before(inside, end.position, -end.direction, end.radius)
    depth, inward = anatomy.lumen(inside), anatomy.lumen.gradient(inside)
    inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-9)
    wall = np.abs(depth) < _OFF
    for end in anatomy.ends:
        beyond = (points - end.position) @ end.direction > -_BEHIND
        near = np.linalg.norm(points - end.position, axis=1) < 3.0 * end.radius
        wall &= ~(end.open & beyond & near)
    return (points - depth[:, None] * inward)[wall], inward[wall]


def write_mjcf(
    anatomy: Anatomy, path: str | os.PathLike[str], wall: str = "merged"
) -> dict[str, Any]:
    """Write an anatomy as a model of convex geoms, with a site at the inlet and goals.

    Args:
        path: of the file, which must end in .xml; lengths in it are metres.
        wall: Division of the wall, see `wall_pieces`.

    Returns:
        Number of `pieces`, and their deviations from the lumen, see `fidelity`.

    Raises:
        ValueError: if the file name has another ending, or there is no such wall.
        ModuleNotFoundError: if "coacd" is chosen and CoACD is not installed.
    """
    import mujoco

    check_wall(wall)
    with files.atomic_path(path, ".xml") as temporary:
        pieces = wall_pieces(anatomy, wall)
        spec = mujoco.MjSpec()
        spec.modelname = anatomy.name
        for index, piece in enumerate(pieces):
            name = f"wall_{index:04d}"
            mesh = spec.add_mesh(name=name, uservert=piece.ravel().tolist())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            shape = mujoco.mjtGeom.mjGEOM_MESH
            spec.worldbody.add_geom(name=name, type=shape, meshname=name)
        for name, place in {"inlet": anatomy.inlet, **anatomy.goals}.items():
            spec.worldbody.add_site(name=name, pos=place.position.tolist())
        spec.compile()
        temporary.write_text(spec.to_xml(), encoding="utf-8")
    return {"pieces": len(pieces), **fidelity(anatomy, pieces)}
