"""The inlet of a scan: the lumen is cut across it."""

from __future__ import annotations

import numpy as np

from cathsim_dmc.anatomy.parts import Inlet
from cathsim_dmc.anatomy.scan.topology import adjacent, groups


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
    front = np.asarray(side[faces] > 0.0)
    crossing: np.ndarray = np.asarray(front.any(axis=1) & ~front.all(axis=1))
    pairs = adjacent(faces)
    ring_pairs = pairs[crossing[pairs].all(1)]
    ring = _component(len(faces), ring_pairs, crossing, vertices, faces, inlet.position)
    others = pairs[~ring[pairs].any(1)]
    touching = pairs[ring[pairs].sum(1) == 1]
    outer = np.where(ring[touching[:, 0]], touching[:, 1], touching[:, 0])
    label = groups(len(faces), others)
    # A triangle beyond the ring lies wholly on one side of the plane there.
    gone = np.unique(label[outer[~front[outer].any(1)]])
    stay = np.unique(label[outer[front[outer].all(1)]])
    if np.intersect1d(gone, stay).size or not stay.size:
        raise ValueError(
            f"the lumen cannot be cut at {np.round(inlet.position * 1e3, 1)} mm: both "
            "sides stay connected. Choose an inlet on a single vessel."
        )
    behind = np.isin(label, gone) & ~ring
    added: dict[tuple[int, int], int] = {}
    fresh: list[np.ndarray] = []

    def on_edge(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in added:
            t = side[key[0]] / (side[key[0]] - side[key[1]])
            point = vertices[key[0]] + t * (vertices[key[1]] - vertices[key[0]])
            added[key] = len(vertices) + len(fresh)
            fresh.append(point)
        return added[key]

    pieces, border = [], []
    for face in faces[ring]:
        polygon, cut = [], []
        for a, b in zip(face, np.roll(face, -1), strict=True):
            if side[a] > 0.0:
                polygon.append(int(a))
            if (side[a] > 0.0) != (side[b] > 0.0):
                polygon.append(on_edge(int(a), int(b)))
                cut.append((polygon[-1], side[a] > 0.0))
        for k in range(1, len(polygon) - 1):
            pieces.append((polygon[0], polygon[k], polygon[k + 1]))
        leaves = next(v for v, leaving in cut if leaving)
        enters = next(v for v, leaving in cut if not leaving)
        border.append((leaves, enters))
    centre = len(vertices) + len(fresh)
    points = np.concatenate([vertices, fresh, [np.mean(fresh, axis=0)]])
    shell = np.concatenate([faces[~ring & ~behind], np.array(pieces)])
    cap = np.array([(enters, leaves, centre) for leaves, enters in border])
    return points, shell, cap


def _component(count, pairs, among, vertices, faces, position):
    """The connected group of faces in ``among`` whose middle is next to a point."""
    label = groups(count, pairs)
    keys = np.unique(label[among])
    if not len(keys):
        raise ValueError(
            f"no lumen at {np.round(position * 1e3, 1)} mm; choose another inlet."
        )
    middle = vertices[faces].mean(1)
    # Mean distance, not the smallest: a neighbour may pass close by.
    distance = [
        np.linalg.norm(middle[(label == key) & among] - position, axis=1).mean()
        for key in keys
    ]
    return (label == keys[int(np.argmin(distance))]) & among
