"""Convex pieces around a lumen, for engines that collide nothing but convex shapes.

A prism stands on every triangle of the lumen's surface and reaches outwards along the
vertex normals; neighbours share their side faces, so nothing can pass between two of
them. The vertices are moved outwards by what the triangles around them stand in the
lumen.
"""

from dataclasses import replace

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.parts import INLET_HOLE_RADIUS, Inlet
from cathsim_dmc.anatomy.scan.inlet import cut_open
from cathsim_dmc.anatomy.scan.topology import decimated

TRIANGLES = 3_000  # of the surface that carries prisms; others are decimated
THICKNESS = 4e-3  # m, of the wall where no other lumen is near
THINNEST = 0.3e-3  # m, of the wall between two lumens
MOVE = 0.3e-3  # m, largest outward movement of a vertex
CAP_OVERLAP = 2e-3  # m, of the inlet's cap under the wall around it
_BEHIND = 0.05e-3  # m, of the surface that is cut off ahead of the inlet's flat cap


def wall_pieces(anatomy: Anatomy) -> tuple[np.ndarray, ...]:
    """Vertices (n_i, 3) m of convex pieces around the lumen; takes seconds.

    The pieces lie outside the lumen but for some tenths of a millimetre. The inlet is
    closed but for a hole of `INLET_HOLE_RADIUS`.
    """
    inlet, lumen = anatomy.inlet, anatomy.lumen
    surface = anatomy.surface
    vertices, faces = decimated(surface.vertices, surface.faces, TRIANGLES)
    at = inlet.position + _BEHIND * inlet.direction
    points, shell, cap = cut_open(vertices, faces, replace(inlet, position=at))
    normals = _outward_normals(points, shell)
    reach = _free_thickness(lumen, points, normals)
    chords = lumen(points[shell].mean(axis=1)).clip(0.0, MOVE)
    move = np.zeros(len(points))
    np.maximum.at(move, shell, chords[:, None])
    # Between two lumens there is no room to move into.
    inner = points + np.minimum(move, 0.5 * reach)[:, None] * normals
    outer = inner + reach[:, None] * normals
    prisms = np.concatenate([inner[shell], outer[shell]], axis=1)
    return (*prisms, *_inlet_cap(points[cap[:, :2]], inlet))


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
    folds sharply; while it does, the worst triangle is added.
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
