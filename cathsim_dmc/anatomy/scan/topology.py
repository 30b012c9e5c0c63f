"""Topology of triangle meshes: parts, borders, orientation, walls."""

import contextlib
from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy.parts import Surface

MERGE = 1e-6  # of the mesh's size: vertices nearer than this are one
JOIN = 1e-5  # of it: vertices of borders nearer than this are one
ROUNDS = 6  # passes that remove triangles without area; neighbours need several
TOUCH = 1e-6  # of an edge or a triangle: a hit this near to its border does not count
# Detection of the thick wall of a vessel.
RAYS = 64
ENCLOSED = 0.75  # share of rays that hit, above which a point is inside a vessel
SPAN = 0.7  # least width of its inner surface, relative to that of its outer one
WALL = 0.25  # enclosed share of its area, above which a surface is a wall
EDGE = 0.6  # cosine between the normals of triangles at the rim of an open end
SOME = 500  # triangles of the first, fast test


def merged(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Surface without coincident vertices, degenerate and repeated triangles."""
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    cell = np.rint(vertices / max(size * MERGE, 1e-30)).astype(np.int64)
    _, first, inverse = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return used(vertices[first], faces[np.sort(once)])


def used(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Surface without the vertices of no triangle."""
    kept, numbers = np.unique(faces, return_inverse=True)
    return vertices[kept], numbers.reshape(-1, 3)


def joined(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same surface with nearly coincident vertices of its borders merged.

    Separate triangles have such vertices if their coordinates were rounded, or
    computed, differently.
    """
    edges, times = edge_counts(faces)
    border = np.unique(edges[times == 1])
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    pairs = cKDTree(vertices[border]).query_pairs(JOIN * size, output_type="ndarray")
    if not len(pairs):
        return vertices, faces
    one = np.arange(len(vertices))
    label = groups(len(border), pairs)
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    one[border] = border[first][inverse]
    return merged(vertices, one[faces])


def inside(
    vertices: np.ndarray, faces: np.ndarray, label: np.ndarray, part: int
) -> np.ndarray:
    """Share (n,) of each of n parts that lies inside the part `part`; 0 for itself.

    Faces (F, 3) are labelled (F,) by their parts.
    """
    import igl

    if label.max() == 0:
        return np.zeros(1)
    middles = vertices[faces].mean(axis=1)
    own = np.ascontiguousarray(faces[label == part])
    within = np.abs(igl.fast_winding_number(vertices, own, middles)) > 0.5
    share = np.bincount(label, within) / np.bincount(label)
    share[part] = 0.0
    return share


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
    """Edges (E, 2), lower vertex first, and the number (E,) of triangles at each."""
    return np.unique(sides(faces), axis=0, return_counts=True)


def sides(faces: np.ndarray) -> np.ndarray:
    """Edges (3 F, 2), lower vertex first, three for each triangle."""
    return np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)


def handles(faces: np.ndarray) -> int:
    """Genus of a closed connected surface, from its Euler characteristic."""
    import igl

    return 1 - igl.euler_characteristic(np.ascontiguousarray(faces)) // 2


def neighbour_means(faces: np.ndarray) -> csr_matrix:
    """Matrix (V, V) that takes values at vertices to the means of their neighbours."""
    import igl

    beside = igl.adjacency_matrix(faces)
    return beside.multiply(1.0 / beside.sum(axis=1)).tocsr()


def parts(faces: np.ndarray, by_edges: bool = False) -> np.ndarray:
    """Label (F,) of the connected part that each triangle belongs to, from 0.

    Triangles are connected where they share a vertex, or an edge with `by_edges`.
    """
    import igl

    if by_edges:
        return igl.facet_components(np.ascontiguousarray(faces))[1]
    label = igl.vertex_components(np.ascontiguousarray(faces))[faces[:, 0]]
    return np.unique(label, return_inverse=True)[1]


def adjacent(faces: np.ndarray) -> np.ndarray:
    """Pairs (n, 2) of triangles that share an edge."""
    import trimesh

    return np.asarray(trimesh.graph.face_adjacency(faces))


def groups(count: int, pairs: np.ndarray) -> np.ndarray:
    """Label (count,) of the connected group of each element; `pairs` are connected."""
    link = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return connected_components(link, directed=False)[1]


def oriented(faces: np.ndarray) -> tuple[np.ndarray, int]:
    """Faces (F, 3) turned so that all neighbours agree, and how many were turned."""
    import igl

    out, part = igl.bfs_orient(np.ascontiguousarray(faces))
    changed = (out != faces).any(axis=1)
    # Of the two orientations of a part, the one that keeps more triangles as given.
    other = (np.bincount(part, changed) > 0.5 * np.bincount(part))[part]
    out[other] = out[other, ::-1]
    return out, int((changed != other).sum())


def decimated(
    vertices: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The surface decimated to about `count` triangles; unchanged if it has no more."""
    if len(faces) <= count:
        return vertices, np.asarray(faces, dtype=np.int64)
    from fast_simplification import simplify

    scale = 1e3  # the tolerances suit coordinates of order one
    points, fewer = simplify(
        (vertices * scale).astype(np.float32),
        faces.astype(np.int32),
        target_count=count,
    )
    points, fewer = merged(points.astype(np.float64) / scale, fewer.astype(np.int64))
    if _is_manifold(faces) and not _is_manifold(fewer):
        import igl

        # Ten times slower; it collapses no edge that would glue the surface together,
        # or, if the surface does not intersect itself, make it do so.
        points, fewer, *_ = igl.qslim(
            np.asfortranarray(vertices * scale),
            np.asfortranarray(faces, dtype=np.int32),
            count,
            not len(crossings(vertices, faces)[0]),
        )
        points, fewer = merged(points / scale, np.asarray(fewer))
    return points, fewer


def _is_manifold(faces: np.ndarray) -> bool:
    """Whether no edge of the faces (F, 3) has more than two of them."""
    return bool(edge_counts(faces)[1].max(initial=0) <= 2)


def crossings(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces (n,) that an edge of another face pierces, and those edges (n, 2)."""
    import igl

    edges, faces = edge_counts(faces)[0], np.ascontiguousarray(faces)
    vertices = 1e3 * vertices  # its tolerances suit coordinates of order one
    boxes = igl.AABB()
    boxes.init(vertices, faces)
    start, end = vertices[edges[:, 0]], vertices[edges[:, 1]]
    hits = boxes.intersect_ray(vertices, faces, start, end - start)
    found = [
        (face, row)
        for row, along in enumerate(hits)
        for face, share, u, v in along
        if TOUCH < share < 1.0 - TOUCH and min(u, v, 1.0 - u - v) > TOUCH
    ]
    pierced, rows = np.array(found, dtype=np.int64).reshape(-1, 2).T
    own = (faces[pierced][:, :, None] == edges[rows][:, None]).any(axis=(1, 2))
    return pierced[~own], edges[rows[~own]]


def border_loops(faces: np.ndarray) -> Iterator[np.ndarray]:
    """Yields closed loops of border vertices, in the direction of their faces."""
    import networkx

    pairs = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    key, back = pairs @ (count := faces.max() + 1, 1), pairs @ (1, count)
    graph = networkx.DiGraph(pairs[~np.isin(key, back)].tolist())
    with contextlib.suppress(networkx.NetworkXNoCycle):
        while True:
            loop = networkx.find_cycle(graph)
            graph.remove_edges_from(loop)
            graph.remove_nodes_from([a for a, _ in loop if not graph.degree(a)])
            if len(loop) >= 3:
                yield np.array([a for a, _ in loop])


def without_slivers(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, int]:
    """Faces without those whose corners are collinear, and the number removed."""
    # The middle corner is inserted into the neighbour at the longest edge.
    removed = 0
    for _ in range(ROUNDS):
        corners = vertices[faces]
        sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        longest = np.maximum(sides.max(axis=1), 1e-30)
        flat = 2.0 * areas(vertices, faces) < 1e-4 * longest**2
        if not flat.any():
            break
        pairs = np.concatenate([adjacent(faces), adjacent(faces)[:, ::-1]])
        pairs = pairs[flat[pairs[:, 0]] & ~flat[pairs[:, 1]]]
        edges = set(map(tuple, edge_counts(faces)[0].tolist()))
        keep, fresh = np.ones(len(faces), dtype=bool), []
        for row, other in pairs[np.argsort(pairs[:, 0], kind="stable")]:
            a, b, m = np.roll(faces[row], -sides[row].argmax())
            beside = np.isin(faces[other], (a, b))
            if beside.sum() < 2 or not (keep[row] and keep[other]):
                continue
            top, p, q = np.roll(faces[other], -beside.argmin())
            edge = (min(m, top), max(m, top))
            if edge in edges:
                continue  # a third and a fourth triangle would share it
            edges.add(edge)
            fresh += [(p, m, top), (m, q, top)]
            keep[[row, other]] = False
        if not fresh:
            break
        removed += len(fresh) // 2
        faces = np.concatenate([faces[keep], np.array(fresh, dtype=faces.dtype)])
    return faces, removed


def inner_shell(
    vertices: np.ndarray, faces: np.ndarray, label: np.ndarray, shells: np.ndarray
) -> int | None:
    """The part, of two `shells` (2,), that is inside the other; None if neither is.

    A body in the lumen, such as a graft, is shorter than the inner surface of a wall:
    None, too. Faces (F, 3) are labelled (F,) by their parts.
    """
    one, other = shells.tolist()
    wide = widths(vertices, faces, label)[shells]
    if wide.min() < SPAN * wide.max():
        return None
    first = inside(vertices, faces, label, other)[one]
    second = inside(vertices, faces, label, one)[other]
    if max(first, second) < 0.9 or min(first, second) > 0.5:
        return None
    return other if second > first else one


def overlap(
    vertices: np.ndarray, faces: np.ndarray, label: np.ndarray, chosen: np.ndarray
) -> bool:
    """Whether some of the chosen parts lie partly, but not wholly, in others.

    Faces (F, 3) are labelled (F,) by their parts.
    """
    shares = (inside(vertices, faces, label, int(one))[chosen] for one in chosen)
    return any(bool(((share > 0.0) & (share < 1.0)).any()) for share in shares)


def lumen_of_wall(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray | None:
    """Mask (F,) of the faces of the inner surface of a wall; None if there is no wall.

    A wall with an open end is one closed surface. Almost every ray from its inner side
    meets the wall again. Faces (F, 3) must be consistently oriented.
    """
    import igl

    if (edge_counts(faces)[1] != 2).any():
        return None
    area = areas(vertices, faces)
    outward = igl.per_face_normals(vertices, faces, np.zeros(3))
    outward *= np.sign(Surface(vertices, faces).volume)
    middles = 1e3 * vertices[faces].mean(axis=1)  # the tolerances suit millimetres

    def enclosed(rows: np.ndarray) -> tuple[np.ndarray, bool]:
        """Share of rays from each face that hit; whether enough area is enclosed."""
        places, normals = middles[rows], outward[rows]
        hits = igl.ambient_occlusion(1e3 * vertices, faces, places, normals, RAYS)
        inside = area[rows][hits > ENCLOSED].sum()
        return hits, bool(inside > WALL * area[rows].sum())

    every = np.arange(len(faces))
    some = np.random.default_rng(0).permutation(every)[:SOME]
    if not enclosed(some)[1]:
        return None
    hits, wall = enclosed(every)
    return _inner_faces(faces, outward, area, hits) if wall else None


def _inner_faces(
    faces: np.ndarray, outward: np.ndarray, area: np.ndarray, hits: np.ndarray
) -> np.ndarray:
    """Mask (F,) of the faces of the side of a wall from which most rays hit it."""
    # A patch between sharp edges belongs to one side.
    pairs = adjacent(faces)
    smooth = np.vecdot(outward[pairs[:, 0]], outward[pairs[:, 1]]) > EDGE
    label = groups(len(faces), pairs[smooth])
    share = np.bincount(label, area * hits) / np.bincount(label, area)
    size = np.bincount(label, area) / area.sum()
    inner = share > 0.6
    if size[inner].sum() > 0.15 and size[~inner].sum() > 0.15:
        large = inner & (size > 0.02 * size[inner].max())
        chosen = large[label]
    else:
        # With rounded rims each triangle counts alone, and the largest patch is kept.
        chosen = hits > 0.5
        label = groups(len(faces), pairs[chosen[pairs].all(axis=1)])
        sizes = np.bincount(label, area * chosen)
        chosen = label == sizes.argmax()
    # The outer side is one patch: any other belongs to the inner side around it.
    label = groups(len(faces), pairs[~chosen[pairs].any(axis=1)])
    sizes = np.bincount(label, area * ~chosen)
    return chosen | (label != sizes.argmax())
