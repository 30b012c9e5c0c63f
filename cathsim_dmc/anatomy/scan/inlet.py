"""The inlet of a scan: the lumen is cut across it."""

import numpy as np

from cathsim_dmc.anatomy.parts import Inlet
from cathsim_dmc.anatomy.scan.topology import adjacent, groups
from cathsim_dmc.anatomy.scan.units import in_mm


def cut_open(
    vertices: np.ndarray, faces: np.ndarray, inlet: Inlet
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a closed surface across the inlet and drop what lies behind it.

    Only the ring of triangles around the inlet is cut: a bent vessel may meet the
    inlet's plane again elsewhere.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3) of a closed surface, normals outward.
        inlet: where to cut; its direction points to the part that stays.

    Returns:
        (vertices (W, 3) m, faces that stay (n, 3), faces of the flat cap (m, 3)).

    Raises:
        ValueError: if the plane does not part the lumen in two.
    """
    side = (vertices - inlet.position) @ inlet.direction
    side = np.where(np.abs(side) < 1e-9, 1e-9, side)
    front: np.ndarray = np.asarray(side[faces] > 0.0)
    crossing: np.ndarray = np.asarray(front.any(axis=1) & ~front.all(axis=1))
    pairs = adjacent(faces)
    label = groups(len(faces), pairs[crossing[pairs].all(axis=1)])
    # Of the rings that the plane cuts the one around the inlet. By mean distance, not
    # the smallest: a neighbour may pass close by.
    away = np.linalg.norm(vertices[faces].mean(axis=1) - inlet.position, axis=1)
    count = np.bincount(label, crossing)
    mean = np.bincount(label, crossing * away) / np.where(count > 0, count, np.nan)
    ring = crossing & (label == np.nanargmin(mean))
    # A triangle beside the ring lies wholly on one side of the plane.
    label = groups(len(faces), pairs[~ring[pairs].any(axis=1)])
    beside = pairs[ring[pairs].sum(axis=1) == 1]
    beside = beside[~ring[beside]]
    gone = np.unique(label[beside[~front[beside, 0]]])
    stay = np.unique(label[beside[front[beside, 0]]])
    if np.intersect1d(gone, stay).size or not stay.size:
        raise ValueError(
            f"the lumen cannot be cut at {in_mm(inlet.position)}: both sides stay "
            "connected. Choose an inlet on a single vessel."
        )
    # Of each triangle that is cut, p is the corner that is alone on its side, x and y
    # are the cuts of the edges to q and from r.
    ahead = front[ring]
    odd = np.where(ahead.sum(axis=1) == 1, ahead.argmax(axis=1), ahead.argmin(axis=1))
    p, q, r = np.take_along_axis(faces[ring], (odd[:, None] + [0, 1, 2]) % 3, axis=1).T
    edges = np.sort(np.stack([np.append(p, p), np.append(q, r)], axis=1), axis=1)
    edges, numbers = np.unique(edges, axis=0, return_inverse=True)
    start, end = edges.T
    share = (side[start] / (side[start] - side[end]))[:, None]
    fresh = vertices[start] + share * (vertices[end] - vertices[start])
    x, y = len(vertices) + numbers.reshape(2, -1)
    alone = side[p] > 0.0
    pieces = [
        np.stack([p, x, y], axis=1)[alone],
        np.stack([x, q, r], axis=1)[~alone],
        np.stack([x, r, y], axis=1)[~alone],
    ]
    points = np.concatenate([vertices, fresh, fresh.mean(axis=0)[None]])
    shell = np.concatenate([faces[~ring & ~np.isin(label, gone)], *pieces])
    centre = np.full(len(p), len(points) - 1)
    cap = np.stack([np.where(alone, y, x), np.where(alone, x, y), centre], axis=1)
    return points, shell, cap
