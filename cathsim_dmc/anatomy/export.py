"""Export of an anatomy as MJCF with convex wall pieces, and their deviations.

A prism stands on every triangle of the lumen's surface, outwards along the vertex
normals; neighbours share their side faces, so nothing can pass between two of them.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from cathsim_dmc import files
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.parts import INLET_HOLE_RADIUS, Inlet
from cathsim_dmc.anatomy.scan.extract import DEVICE_RADIUS
from cathsim_dmc.anatomy.scan.places import cut_open
from cathsim_dmc.anatomy.scan.topology import decimated
from cathsim_dmc.anatomy.surface import sampled

TRIANGLES = 3_000  # of the surface that carries prisms; others are decimated
THICKNESS = 4e-3  # m, of the wall where no other lumen is near
THINNEST = 0.3e-3  # m, of the wall between two lumens
MOVE = 0.3e-3  # m, largest outward movement of a vertex
CAP_OVERLAP = 2e-3  # m, of the inlet's cap under the wall around it
_BEHIND = 0.05e-3  # m, of the surface that is cut off ahead of the inlet's flat cap
_PLACES = 10_000  # of the wall that are looked at
_NEAR = 1.5e-3  # m from an open end, where there is no wall
# Levels (m) along the normal at which pieces are looked for, > 0 in the lumen.
_LEVELS = np.arange(-1.5e-3, 1.5e-3, 0.05e-3)
_GRAZE = 0.05e-3  # m, by which a piece may touch a 5 Fr catheter on a centreline
_OFF = 0.3e-3  # m; farther from the wall a place of the surface is on an open end


def wall_pieces(anatomy: Anatomy) -> tuple[np.ndarray, ...]:
    """Vertices (n_i, 3) m of convex pieces around the lumen; takes seconds.

    The pieces lie outside the lumen but for some tenths of a millimetre. The inlet is
    closed but for a hole of `INLET_HOLE_RADIUS`.
    """
    inlet, lumen, surface = anatomy.inlet, anatomy.lumen, anatomy.surface
    vertices, faces = decimated(surface.vertices, surface.faces, TRIANGLES)
    at = inlet.position + _BEHIND * inlet.direction
    points, shell, cap = cut_open(vertices, faces, replace(inlet, position=at))
    normals = _outward_normals(points, shell)
    # How far each vertex can move out before another lumen comes near.
    reach = np.full(len(points), THINNEST)
    going = np.ones(len(points), dtype=bool)
    for s in np.arange(0.4e-3, THICKNESS + 1e-9, 0.2e-3):
        going &= -lumen(points + s * normals) > 0.35 * s
        reach[going] = s
    chords = lumen(points[shell].mean(axis=1)).clip(0.0, MOVE)
    move = np.zeros(len(points))
    np.maximum.at(move, shell, chords[:, None])
    # Between two lumens there is no room to move into.
    inner = points + np.minimum(move, 0.5 * reach)[:, None] * normals
    outer = inner + reach[:, None] * normals
    prisms = np.concatenate([inner[shell], outer[shell]], axis=1)
    return (*prisms, *_inlet_cap(points[cap[:, :2]], inlet))


def _inlet_cap(border: np.ndarray, inlet: Inlet) -> list[np.ndarray]:
    """Convex sectors on edges (n, 2, 3) m of the cut that close it but for the hole."""
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
    """Unit normals (V, 3) that lean outwards from all triangles around a vertex."""
    import igl

    flat = igl.per_face_normals(vertices, faces, np.zeros(3))
    weighting = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
    normals = igl.per_vertex_normals(vertices, faces, weighting)
    normals[~np.isfinite(normals)] = 0.0  # of vertices without triangles
    # Where the surface folds sharply the mean may point into one of the triangles.
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
        Over `places` all over the wall, mean, 95th percentile and maximum of how far
        the pieces stand in the lumen (`intrusion_mm`), and of how far they stay behind
        the wall (`recession_mm`); `open_places`, where no piece is met within 1.5 mm
        behind the wall; and the vessels whose centreline is `closed_to_5fr`.
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
    """Places (n, 3) m all over the wall, and unit normals (n, 3) into the lumen."""
    points, _ = sampled(anatomy.surface, _PLACES)
    depth, inward = anatomy.lumen(points), anatomy.lumen.gradient(points)
    inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-9)
    wall = np.abs(depth) < _OFF
    for end in anatomy.ends:
        beyond = (points - end.position) @ end.direction > -_NEAR
        near = np.linalg.norm(points - end.position, axis=1) < 3.0 * end.radius
        wall &= ~(end.open & beyond & near)
    return (points - depth[:, None] * inward)[wall], inward[wall]


def write_mjcf(anatomy: Anatomy, path: str | os.PathLike[str]) -> dict[str, Any]:
    """Write an anatomy as a model of convex geoms, with a site at the inlet and goals.

    Args:
        path: of the file, which must end in .xml; lengths in it are metres.

    Returns:
        Number of `pieces`, and how well they stand for the lumen, see `fidelity`.

    Raises:
        ValueError: if the file name has another ending.
    """
    import mujoco

    with files.atomic_path(path, ".xml") as temporary:
        wall = wall_pieces(anatomy)
        spec = mujoco.MjSpec()
        spec.modelname = anatomy.name
        for index, piece in enumerate(wall):
            name = f"wall_{index:04d}"
            mesh = spec.add_mesh(name=name, uservert=piece.ravel().tolist())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            shape = mujoco.mjtGeom.mjGEOM_MESH
            spec.worldbody.add_geom(name=name, type=shape, meshname=name)
        for name, place in {"inlet": anatomy.inlet, **anatomy.goals}.items():
            spec.worldbody.add_site(name=name, pos=place.position.tolist())
        spec.compile()
        temporary.write_text(spec.to_xml())
    return {"pieces": len(wall), **fidelity(anatomy, wall)}
