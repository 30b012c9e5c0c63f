"""Meshes of a vessel's wall: which part of their surface is that of the lumen."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cathsim_dmc.anatomy.scan.mesh_depth import MeshDepth

RAYS = 64
ENCLOSED = 0.75  # share of rays that hit: the place is inside a vessel
WALL = 0.25  # of the area: a surface of which so much is enclosed is a wall
EDGE = 0.6  # cosine between the normals of triangles at the rim of an open end
_OFF = 1e-6  # m, off the surface


def inner_shell(vertices: np.ndarray, *shells: np.ndarray) -> int | None:
    """Which of two surfaces lies inside the other, or None if neither does.

    Args:
        vertices: (V, 3) m.
        *shells: faces (n, 3) of the two surfaces, closed or open at vessel ends.
    """
    rays = _sphere(RAYS)
    share = []
    for own, other in (shells, shells[::-1]):
        points = vertices[own].mean(axis=1)
        some = np.random.default_rng(0).permutation(len(points))[:1500]
        measure = MeshDepth(vertices, other)
        hits = measure.blocked_share(points[some], rays, np.zeros((len(some), 3)))
        share.append(float((hits > ENCLOSED).mean()))
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
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, times = np.unique(edges, axis=0, return_counts=True)
    handles = 1 - (len(np.unique(faces)) - len(edges) + len(faces)) // 2
    if (times != 2).any() or handles < 1:
        return None  # open, or without a hole through it
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.maximum(np.linalg.norm(cross, axis=1), 1e-30)
    outward = cross / area[:, None]
    total = np.einsum("nd,nd->", corners[:, 0] - vertices.mean(0), cross)
    if total < 0.0:
        outward = -outward
    points = corners.mean(axis=1) + _OFF * outward
    hits = MeshDepth(vertices, faces).blocked_share(points, _sphere(RAYS), outward)
    enclosed = hits > ENCLOSED
    if area[enclosed].sum() < WALL * area.sum():
        return None
    # Parts between sharp edges are of one side.
    pairs = _adjacent(faces)
    smooth = np.einsum("nd,nd->n", outward[pairs[:, 0]], outward[pairs[:, 1]]) > EDGE
    label = _groups(len(faces), pairs[smooth])
    share = np.bincount(label, area * hits) / np.bincount(label, area)
    size = np.bincount(label, area) / area.sum()
    inner = share > 0.6
    if not (size[inner].sum() > 0.15 and size[~inner].sum() > 0.15):
        # Rounded rims: every triangle for itself, then the largest patch.
        chosen = hits > 0.5
        label = _groups(len(faces), pairs[chosen[pairs].all(axis=1)])
        sizes = np.bincount(label, area * chosen)
        return label == sizes.argmax()
    large = inner & (size > 0.02 * size[inner].max())
    return large[label]


def _sphere(count: int) -> np.ndarray:
    """Directions (count, 3), evenly spread."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def _adjacent(faces: np.ndarray) -> np.ndarray:
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    return np.stack([owner[:-1][same], owner[1:][same]], axis=1)


def _groups(count: int, pairs: np.ndarray) -> np.ndarray:
    link = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return connected_components(link, directed=False)[1]
