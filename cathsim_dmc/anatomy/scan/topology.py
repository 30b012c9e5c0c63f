"""Triangles and how they hang together: merging, parts, borders, orientation."""

from __future__ import annotations

import contextlib

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

MERGE = 1e-6  # of the mesh's size: vertices nearer than this are one
ROUNDS = 6  # in which triangles without area are taken out, neighbours of others later


def merged(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One vertex per place, and no triangle with a vertex twice or given twice."""
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    cell = np.rint(vertices / max(size * MERGE, 1e-30)).astype(np.int64)
    _, first, inverse = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    if not len(faces):
        return vertices[:0], faces
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(once)]
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[first][used], renumbered.reshape(-1, 3)


def areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area (F,) of each triangle, m^2."""
    import trimesh

    return trimesh.triangles.area(vertices[faces])


def widths(vertices: np.ndarray, faces: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Diagonal (n,) of the box around each of n parts, m."""
    low = np.full((label.max() + 1, 3), np.inf)
    high = -low
    np.minimum.at(low, label, vertices[faces].min(axis=1))
    np.maximum.at(high, label, vertices[faces].max(axis=1))
    return np.linalg.norm(high - low, axis=1)


def edge_counts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (E, 2), lower vertex first, and the triangles at each (E,)."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


def handles(faces: np.ndarray) -> int:
    """Handles of a closed surface in one part, by its Euler characteristic."""
    edges = len(edge_counts(faces)[0])
    return 1 - (len(np.unique(faces)) - edges + len(faces)) // 2


def parts(faces: np.ndarray) -> np.ndarray:
    """Number (F,) of the connected part that each triangle belongs to, from 0."""
    import igl

    label = igl.vertex_components(np.ascontiguousarray(faces))[faces[:, 0]]
    return np.unique(label, return_inverse=True)[1]


def adjacent(faces: np.ndarray) -> np.ndarray:
    """Pairs (n, 2) of triangles that share an edge."""
    import trimesh

    return np.asarray(trimesh.graph.face_adjacency(faces))


def groups(count: int, pairs: np.ndarray) -> np.ndarray:
    """Number (count,) of the group that each of some things joined in pairs is in."""
    link = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return connected_components(link, directed=False)[1]


def oriented(faces: np.ndarray) -> tuple[np.ndarray, int] | None:
    """Faces (F, 3) turned so that all neighbours agree, and how many were turned.

    None where no turning does, as on a Moebius strip.
    """
    import igl

    out, part = igl.bfs_orient(np.ascontiguousarray(faces))
    sides = out[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    if len(np.unique(sides, axis=0)) < len(sides):
        return None
    changed = (out != faces).any(axis=1)
    # Of both ways to orient a part, the one in which more triangles stay as given.
    other = (np.bincount(part, changed) > 0.5 * np.bincount(part))[part]
    out[other] = out[other, ::-1]
    return out, int((changed != other).sum())


def decimated(
    vertices: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The same surface of about so many triangles, or as it is if it has no more."""
    if len(faces) <= count:
        return vertices, np.asarray(faces, dtype=np.int64)
    from fast_simplification import simplify

    scale = 1e3  # its tolerances suit coordinates of order one
    points, fewer = simplify(
        (vertices * scale).astype(np.float32),
        faces.astype(np.int32),
        target_count=count,
    )
    return merged(points.astype(np.float64) / scale, fewer.astype(np.int64))


def border_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Closed rows of vertices along the borders, in the direction of their faces.

    Where two holes meet in a vertex, they become one loop each as far as that can
    be told.
    """
    import networkx

    pairs = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    graph = networkx.DiGraph(map(tuple, pairs.tolist()))
    graph.remove_edges_from([(a, b) for a, b in graph.edges if graph.has_edge(b, a)])
    graph.remove_nodes_from(list(networkx.isolates(graph)))
    loops = []
    with contextlib.suppress(networkx.NetworkXNoCycle):
        while True:
            loop = networkx.find_cycle(graph)
            graph.remove_edges_from(loop)
            graph.remove_nodes_from([a for a, _ in loop if not graph.degree(a)])
            loops.append(np.array([a for a, _ in loop]))
    return [loop for loop in loops if len(loop) >= 3]


def loop_axis(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit normal (3,) of a closed loop, and its area (m^2)."""
    spokes = points - points.mean(axis=0)
    total = 0.5 * np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)
    area = float(np.linalg.norm(total))
    return total / max(area, 1e-30), area


def without_slivers(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, int]:
    """Triangles of which three corners lie in line are taken out.

    The corner between the other two is put into the neighbour at the long edge, so
    that no hole is left.
    """
    removed = 0
    for _ in range(ROUNDS):
        corners = vertices[faces]
        sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        height = 2.0 * areas(vertices, faces) / np.maximum(sides.max(axis=1), 1e-30)
        flat = np.flatnonzero(height < 1e-4 * np.maximum(sides.max(axis=1), 1e-30))
        if not len(flat):
            break
        owner: dict[tuple[int, int], list[int]] = {}
        for row, face in enumerate(faces):
            for k in range(3):
                a, b = int(face[k]), int(face[(k + 1) % 3])
                owner.setdefault((min(a, b), max(a, b)), []).append(row)
        gone, fresh, touched = [], [], set()
        for row in flat:
            k = int(sides[row].argmax())
            a, b, m = (int(faces[row, (k + j) % 3]) for j in range(3))
            others = [r for r in owner[(min(a, b), max(a, b))] if r != row]
            if len(others) != 1 or touched & {row, others[0]} or others[0] in flat:
                continue
            other = others[0]
            face = list(map(int, faces[other]))
            top = next(corner for corner in face if corner not in (a, b))
            edge = (min(m, top), max(m, top))
            if edge in owner:
                continue  # a third and a fourth triangle would share it
            owner[edge] = [int(row), other]
            j = face.index(top)
            p, q = face[(j + 1) % 3], face[(j + 2) % 3]
            fresh += [(p, m, top), (m, q, top)]
            gone += [row, other]
            touched |= {row, other}
        if not gone:
            break
        removed += len(gone) // 2
        keep = np.ones(len(faces), dtype=bool)
        keep[gone] = False
        faces = np.concatenate([faces[keep], np.array(fresh, dtype=faces.dtype)])
    return faces, removed
