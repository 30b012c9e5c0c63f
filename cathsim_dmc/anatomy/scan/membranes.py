"""Flat sheets across a lumen, such as the caps that a join of closed parts leaves."""

import numpy as np

from cathsim_dmc.anatomy.scan.topology import adjacent, areas, groups, oriented, sides

FLAT = 0.7  # least area of a sheet across its mean normal, relative to its area


def membranes(vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """Masks (F,) of sheets without which their rims are edges of two triangles.

    A sheet is flat and has its whole rim in the wall. Of two sheets, or of a sheet and
    the short end of a vessel behind it, the smaller one is taken.
    """
    _, which, left = np.unique(
        sides(faces), axis=0, return_inverse=True, return_counts=True
    )
    which = which.reshape(-1, 3)
    times = left[which]
    if not (times > 2).any():
        return []
    label = groups(len(faces), adjacent(faces))
    rims = np.setdiff1d(label[(times > 2).any(axis=1)], label[(times == 1).any(axis=1)])
    size = np.bincount(label, areas(vertices, faces))
    found = []
    for key in rims[np.argsort(size[rims])]:
        own = label == key
        rim, count = np.unique(which[own][times[own] > 2], return_counts=True)
        if (left[rim] - count >= 2).all() and _is_flat(vertices, faces[own]):
            left[rim] -= count
            found.append(own)
    return found


def _is_flat(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether most triangles (n, 3) of a sheet face one way, unlike those of a body."""
    a, b, c = vertices[oriented(faces)[0]].swapaxes(0, 1)
    cross = np.cross(b - a, c - a)
    facing = np.linalg.norm(cross.sum(axis=0))
    return bool(facing > FLAT * np.linalg.norm(cross, axis=1).sum())
