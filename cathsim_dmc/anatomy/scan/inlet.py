"""The inlet of a scan: the lumen is cut across it and closed behind it."""

from __future__ import annotations

import numpy as np

from cathsim_dmc.anatomy.parts import Inlet
from cathsim_dmc.anatomy.scan.mesh_depth import MeshDepth
from cathsim_dmc.anatomy.scan.wall import adjacent_faces
from cathsim_dmc.anatomy.wall.depth import BRICK, OUTER, QUANTUM, DepthField


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
    pairs = adjacent_faces(faces)
    ring_pairs = pairs[crossing[pairs].all(1)]
    ring = _component(len(faces), ring_pairs, crossing, vertices, faces, inlet.position)
    others = pairs[~ring[pairs].any(1)]
    behind = ring.copy()
    touching = pairs[ring[pairs].sum(1) == 1]
    outer = np.where(ring[touching[:, 0]], touching[:, 1], touching[:, 0])
    label = _labels(len(faces), others)
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


def shut_behind(
    field: DepthField, vertices: np.ndarray, faces: np.ndarray, inlet: Inlet
) -> DepthField:
    """The field of a lumen with the part behind the inlet taken out.

    Behind the inlet's plane, points get their depth in what is left of the lumen,
    which is minus their distance from it; in front of it nothing changes: the end
    is open and does not limit the depth.

    Args:
        field: of the whole lumen.
        vertices: (V, 3) m.
        faces: (F, 3) of what is left, closed by a flat cap in the inlet's plane.
        inlet: its direction points to what is left.
    """
    measure = MeshDepth(vertices, faces)
    wide, shape = field.spacing * BRICK, np.asarray(field.index.shape)
    axes = [np.arange(n + 1) for n in shape]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    behind = (field.origin + wide * corners - inlet.position) @ inlet.direction < 0.0
    # Far outside the lumen the sign is all that counts, and it does not change.
    todo = behind & (field.coarse > -2.0 * wide)
    coarse = field.coarse.copy()
    coarse[todo] = measure(field.origin + wide * corners[todo])
    cells = np.lib.stride_tricks.sliding_window_view(todo, (2, 2, 2)).any((3, 4, 5))
    whole = np.lib.stride_tricks.sliding_window_view(behind, (2, 2, 2)).all((3, 4, 5))
    deepest = np.lib.stride_tricks.sliding_window_view(coarse, (2, 2, 2)).max((3, 4, 5))
    # The plane itself needs the fine lattice, also where the lumen is wide.
    across = cells & ~whole & (deepest > -wide)
    near = cells & whole & (deepest + wide > -OUTER) & (field.index >= 0)
    rows = np.argwhere(across | near)
    steps = field.spacing * np.arange(BRICK + 1)
    local = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1)
    points = field.origin + wide * rows[:, None] + local.reshape(-1, 3)
    depth = field(points)
    hidden = (points - inlet.position) @ inlet.direction < 0.0
    depth[hidden] = measure(points[hidden])
    fresh = np.clip(np.rint(depth / QUANTUM), -32767, 32767).astype(np.int16)
    kept = (field.index >= 0) & ~cells
    index = np.full_like(field.index, -1)
    index[kept] = np.arange(kept.sum())
    index[tuple(rows.T)] = kept.sum() + np.arange(len(rows))
    bricks = np.concatenate(
        [field.bricks[field.index[kept]], fresh.reshape(-1, *field.bricks.shape[1:])]
    )
    return DepthField(field.origin, field.spacing, coarse, index, bricks)


def _labels(count, pairs):
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    link = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return connected_components(link, directed=False)[1]


def _component(count, pairs, among, vertices, faces, position):
    """The connected group of faces in ``among`` whose middle is next to a point."""
    label = _labels(count, pairs)
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
