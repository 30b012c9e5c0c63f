"""Meshes of a vessel's wall: which part of their surface is that of the lumen."""

from __future__ import annotations

import numpy as np

from cathsim_dmc.anatomy.scan.topology import (
    adjacent,
    areas,
    edge_counts,
    groups,
    handles,
)

RAYS = 64
ENCLOSED = 0.75  # share of rays that hit: the place is inside a vessel
WALL = 0.25  # of the area: a surface of which so much is enclosed is a wall
EDGE = 0.6  # cosine between the normals of triangles at the rim of an open end


def inner_shell(vertices: np.ndarray, *shells: np.ndarray) -> int | None:
    """Which of two surfaces lies inside the other, or None if neither does.

    Args:
        vertices: (V, 3) m.
        *shells: faces (n, 3) of the two surfaces, closed or open at vessel ends.
    """
    import igl

    share = []
    for own, other in (shells, shells[::-1]):
        middles = vertices[own].mean(axis=1)
        winding = igl.fast_winding_number(vertices, other, middles)
        share.append(float((np.abs(winding) > 0.5).mean()))
    if max(share) < 0.9 or min(share) > 0.5:
        return None
    return int(share[1] > share[0])


def lumen_of_wall(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray | None:
    """Faces (F,) bool of the inner surface of a wall, or None if it is no wall.

    A wall with open ends is one closed surface with holes through it. Seen from its
    inner side almost every ray meets the wall again.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3), oriented alike, in one part.
    """
    import igl

    if (edge_counts(faces)[1] != 2).any() or handles(faces) < 1:
        return None  # open, or without a hole through it
    area = areas(vertices, faces)
    outward = igl.per_face_normals(vertices, faces, np.zeros(3))
    corners = vertices[faces] - vertices.mean(axis=0)
    if np.einsum("nd,nd,n->", corners[:, 0], outward, area) < 0.0:
        outward = -outward
    middles = 1e3 * vertices[faces].mean(axis=1)  # its tolerances suit millimetres
    hits = igl.ambient_occlusion(1e3 * vertices, faces, middles, outward, RAYS)
    if area[hits > ENCLOSED].sum() < WALL * area.sum():
        return None
    # Parts between sharp edges are of one side.
    pairs = adjacent(faces)
    smooth = np.vecdot(outward[pairs[:, 0]], outward[pairs[:, 1]]) > EDGE
    label = groups(len(faces), pairs[smooth])
    share = np.bincount(label, area * hits) / np.bincount(label, area)
    size = np.bincount(label, area) / area.sum()
    inner = share > 0.6
    if not (size[inner].sum() > 0.15 and size[~inner].sum() > 0.15):
        # Rounded rims: every triangle for itself, then the largest patch.
        chosen = hits > 0.5
        label = groups(len(faces), pairs[chosen[pairs].all(axis=1)])
        sizes = np.bincount(label, area * chosen)
        return label == sizes.argmax()
    large = inner & (size > 0.02 * size[inner].max())
    return large[label]
