"""Mending a lumen's surface: what is wrong is put right, counted and said."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cathsim_dmc.anatomy.scan.mesh_depth import MeshDepth
from cathsim_dmc.anatomy.scan.thick import inner_shell, lumen_of_wall

MERGE = 1e-6  # of the mesh's size: vertices nearer than this are one
CRUMB = 0.03  # of the surface's area: smaller separate parts are dropped
CRUMB_WIDTH = 12e-3  # m, and if they are not wider
CROWDED = 0.01  # of the triangles: more around crowded edges are not mended
HOLE = 8e-3  # m, widest hole in the side of a vessel that is filled
SPIKE = 4e-3  # m, widest patch around a self-intersection that is cut out
END = 0.55  # largest |cosine| between an end's axis and the normals around it
DENSE = 30_000  # triangles; more are decimated
FEW = 12_000  # triangles that are left then
ROUNDS = 6


@dataclass(frozen=True)
class Opening:
    """An end of a vessel that was open and has been closed by a flat cap.

    Attributes:
        position: (3,) m, its middle.
        radius: m, of a circle of the same area.
    """

    position: np.ndarray
    radius: float


@dataclass(frozen=True)
class Mended:
    """A closed surface of one part, normals outwards.

    Attributes:
        vertices: (V, 3) m.
        faces: (F, 3) int64.
        openings: ends that were open.
        notes: what was changed, a line for each.
    """

    vertices: np.ndarray
    faces: np.ndarray
    openings: tuple[Opening, ...]
    notes: tuple[str, ...]


def mend(name: str, vertices: np.ndarray, faces: np.ndarray) -> Mended:
    """Close a surface, turn it outwards, and leave one part of it.

    Args:
        name: of the file, for messages.
        vertices: (V, 3) m.
        faces: (F, 3).

    Raises:
        ValueError: if it cannot be mended; says what is wrong and where.
    """
    work = _Work(name, vertices, faces)
    work.merge()
    work.keep_one_part()
    work.decimate()
    work.uncrowd()
    work.turn_alike()
    work.take_lumen()
    work.close()
    work.keep_one_part(quiet=True)
    work.turn_outwards()
    work.untangle()
    return Mended(
        work.vertices, np.ascontiguousarray(work.faces), work.openings, work.said
    )


class _Work:
    def __init__(self, name: str, vertices: np.ndarray, faces: np.ndarray):
        self.name, self.vertices, self.faces = name, vertices, faces
        self._openings: list[Opening] = []
        self._notes: list[str] = []

    @property
    def openings(self) -> tuple[Opening, ...]:
        return tuple(self._openings)

    @property
    def said(self) -> tuple[str, ...]:
        return tuple(self._notes)

    def merge(self) -> None:
        """One vertex per place, and no triangle without area or twice."""
        before = len(self.faces)
        self.vertices, self.faces = merged(self.vertices, self.faces)
        dropped = before - len(self.faces)
        self.faces, flipped = _without_slivers(self.vertices, self.faces)
        if dropped + flipped:
            self._notes.append(
                f"{dropped + flipped} triangles without area or given twice taken out"
            )
        if len(self.faces) < 4:
            raise ValueError(
                f"{self.name} has {len(self.faces)} triangles with an area; give the "
                "surface of a lumen."
            )

    def keep_one_part(self, quiet: bool = False) -> None:
        """Drop crumbs; of a wall's two surfaces keep the inner one."""
        label = parts(self.faces, len(self.vertices))
        area = areas(self.vertices, self.faces)
        share = np.bincount(label, area) / area.sum()
        large = np.flatnonzero(
            (share > CRUMB) | (widths(self.vertices, self.faces, label) > CRUMB_WIDTH)
        )
        if len(large) == 2 and not quiet:
            inner = inner_shell(self.vertices, *(self.faces[label == k] for k in large))
            if inner is not None:
                self._notes.append(
                    "thick wall: the inner of two surfaces taken as the lumen"
                )
                self._keep(label == large[inner])
                return
        if len(large) > 1:
            sizes = np.sort(np.bincount(label)[large])[::-1]
            raise ValueError(
                f"{self.name} has {len(large)} separate parts (of "
                f"{', '.join(map(str, sizes[:6]))} triangles); one connected lumen is "
                "needed. Keep the largest island (3D Slicer: Segment Editor, Islands) "
                "and export again."
            )
        if len(share) > 1:
            if not quiet:
                self._notes.append(
                    f"{len(share) - 1} crumbs beside the lumen dropped "
                    f"({100 * (1 - share[large[0]]):.2g} % of the area)"
                )
            self._keep(label == large[0])

    def decimate(self) -> None:
        """Fewer triangles where there are very many."""
        if len(self.faces) <= DENSE:
            return
        from fast_simplification import simplify

        scale = 1e3  # its tolerances suit coordinates of order one
        points, faces = simplify(
            (self.vertices * scale).astype(np.float32),
            self.faces.astype(np.int32),
            target_count=FEW,
        )
        points = points.astype(np.float64) / scale
        points, faces = merged(points, faces.astype(np.int64))
        rng = np.random.default_rng(0)
        some = self.vertices[rng.integers(len(self.vertices), size=4000)]
        off = np.abs(MeshDepth(points, faces)(some))
        self._notes.append(
            f"decimated from {len(self.faces):,} to {len(faces):,} triangles; the "
            f"surface moved by {off.mean() * 1e3:.2f} mm in the mean, "
            f"{off.max() * 1e3:.2f} mm at most"
        )
        self.vertices, self.faces = points, faces

    def uncrowd(self) -> None:
        """Cut out the triangles around edges that more than two triangles share."""
        first = None
        for _ in range(ROUNDS):
            edges, times = edge_counts(self.faces)
            crowded = edges[times > 2]
            if not len(crowded):
                break
            bad = np.asarray(np.isin(self.faces, crowded).any(axis=1))
            first = first or (len(crowded), self.vertices[crowded[0, 0]])
            if bad.sum() > max(CROWDED * len(self.faces), 40):
                raise ValueError(
                    f"{self.name} has {first[0]} edges shared by more than two "
                    f"triangles, one at {_mm(first[1])} mm, too many to mend: parts "
                    "of the surface are glued together. Export it from the "
                    "segmentation again, or remesh it."
                )
            self._keep(~bad)
        if first:
            self._notes.append(
                f"{first[0]} edges shared by more than two triangles, near "
                f"{_mm(first[1])} mm: the triangles around them cut out"
            )
            self._drop_flakes()

    def _drop_flakes(self) -> None:
        label = parts(self.faces, len(self.vertices))
        share = np.bincount(label, areas(self.vertices, self.faces))
        self._keep(np.isin(label, np.flatnonzero(share > CRUMB * share.sum())))

    def turn_alike(self) -> None:
        """Give neighbouring triangles the same orientation."""
        turned = turned_faces(self.faces)
        if turned is None:
            raise ValueError(
                f"{self.name} is a surface with one side only (a Moebius strip): its "
                "triangles cannot all face outwards. Export it again."
            )
        turned = min(turned, ~turned, key=np.sum)
        if turned.any():
            self._notes.append(f"{int(turned.sum())} flipped triangles turned")
            self.faces = np.where(turned[:, None], self.faces[:, ::-1], self.faces)

    def take_lumen(self) -> None:
        """The inner surface of a wall whose surfaces hang together at open ends."""
        inner = lumen_of_wall(self.vertices, self.faces)
        if inner is not None:
            self._notes.append("thick wall: its inner surface taken as the lumen")
            self._keep(inner)
            self.faces = self.faces[:, ::-1]
            self._drop_flakes()

    def close(self) -> None:
        """Cap the ends of vessels and fill small holes."""
        filled = []
        for loop in border_loops(self.faces):
            points = self.vertices[loop]
            middle = points.mean(axis=0)
            wide = 2.0 * float(np.linalg.norm(points - middle, axis=1).max())
            axis, area = _loop_axis(points)
            radius = float(np.sqrt(area / np.pi))
            if len(loop) > 3 and self._is_end(loop, axis) and radius > 0.4e-3:
                self._openings.append(Opening(middle, radius))
            elif wide > HOLE:
                raise ValueError(
                    f"{self.name} is not closed: a hole {wide * 1e3:.1f} mm wide in "
                    f"the side of a vessel at {_mm(middle)} mm (at most {HOLE * 1e3:g} "
                    "mm are filled). Fill holes (3D Slicer: Surface Toolbox, Fill "
                    "holes), then export again."
                )
            else:
                filled.append((wide, middle))
            self._fan(loop, middle)
        if filled:
            wide, middle = max(filled, key=lambda hole: hole[0])
            self._notes.append(
                f"{len(filled)} holes filled, the widest {wide * 1e3:.1f} mm at "
                f"{_mm(middle)} mm"
            )
        if self._openings:
            self._notes.append(f"{len(self._openings)} open vessel ends capped")
        edges, times = edge_counts(self.faces)
        if (times != 2).any():
            where = self.vertices[edges[times != 2][0, 0]]
            raise ValueError(
                f"{self.name} is not closed: {int((times == 1).sum())} boundary edges "
                f"and {int((times > 2).sum())} edges shared by more than two triangles "
                f"are left after mending, one at {_mm(where)} mm. Export it from the "
                "segmentation again, or remesh it."
            )

    def _is_end(self, loop: np.ndarray, axis: np.ndarray) -> bool:
        """Whether the surface runs across the loop's plane, as a tube's does."""
        beside = np.isin(self.faces, loop).sum(axis=1) >= 1
        corners = self.vertices[self.faces[beside]]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.linalg.norm(cross, axis=1)
        lean = np.abs(cross @ axis).sum() / max(size.sum(), 1e-30)
        return bool(lean < END)

    def _fan(self, loop: np.ndarray, middle: np.ndarray) -> None:
        if len(loop) == 3:
            self.faces = np.concatenate([self.faces, loop[None, ::-1]])
            return
        centre = np.full(len(loop), len(self.vertices))
        self.vertices = np.concatenate([self.vertices, middle[None]])
        fan = np.stack([np.roll(loop, -1), loop, centre], axis=1)
        self.faces = np.concatenate([self.faces, fan])

    def turn_outwards(self) -> None:
        """Turn the whole surface if its normals point inwards."""
        if volume(self.vertices, self.faces) < 0.0:
            self.faces = self.faces[:, ::-1]
            self._notes.append("surface turned inside out: normals pointed inwards")

    def untangle(self) -> None:
        """Cut out small patches that pierce the surface, refuse large ones."""
        first = None
        for _ in range(ROUNDS):
            faces, edges = MeshDepth(self.vertices, self.faces).crossings()
            if not len(faces):
                break
            tangled = np.isin(self.faces, np.unique(edges)).sum(axis=1) >= 2
            tangled[faces] = True
            where = self.vertices[edges[0, 0]]
            first = first or (len(np.unique(faces)), where)
            patch = self._widest_patch(tangled)
            if patch > SPIKE or tangled.mean() > CROWDED:
                raise ValueError(
                    f"{self.name} intersects itself: {first[0]} triangles, one at "
                    f"{_mm(where)} mm, are pierced by others. Smooth or remesh that "
                    "place, or export the segmentation again."
                )
            touched = np.isin(self.faces, self.faces[tangled]).any(axis=1)
            self._keep(np.asarray(~touched))
            self._drop_flakes()
            self.uncrowd()
            self.close()
        else:
            assert first is not None  # every round has found some
            raise ValueError(
                f"{self.name} intersects itself near {_mm(first[1])} mm, and cutting "
                "the place out did not help. Smooth or remesh it."
            )
        if first:
            self._notes.append(
                f"{first[0]} self-intersecting triangles near {_mm(first[1])} mm cut "
                "out"
            )

    def _widest_patch(self, chosen: np.ndarray) -> float:
        label = parts(self.faces[chosen], len(self.vertices))
        return float(widths(self.vertices, self.faces[chosen], label).max())

    def _keep(self, chosen: np.ndarray) -> None:
        used, numbers = np.unique(self.faces[chosen], return_inverse=True)
        self.vertices, self.faces = self.vertices[used], numbers.reshape(-1, 3)


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
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def widths(vertices: np.ndarray, faces: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Diagonal (n,) of the box around each of n parts, m."""
    low = np.full((label.max() + 1, 3), np.inf)
    high = -low
    np.minimum.at(low, label, vertices[faces].min(axis=1))
    np.maximum.at(high, label, vertices[faces].max(axis=1))
    return np.linalg.norm(high - low, axis=1)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Enclosed volume (m^3) of a closed surface, > 0 if its normals point outwards."""
    a, b, c = (vertices[faces[:, k]] - vertices[0] for k in range(3))
    return float(np.einsum("nd,nd->", a, np.cross(b, c)) / 6.0)


def edge_counts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (E, 2), lower vertex first, and the triangles at each (E,)."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


def parts(faces: np.ndarray, count: int) -> np.ndarray:
    """Number (F,) of the connected part that each triangle belongs to, from 0."""
    rows = faces[:, [0, 1, 2]].reshape(-1)
    cols = faces[:, [1, 2, 0]].reshape(-1)
    link = coo_matrix((np.ones(len(rows)), (rows, cols)), shape=(count, count))
    label = connected_components(link, directed=False)[1][faces[:, 0]]
    return np.unique(label, return_inverse=True)[1]


def _neighbours(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (n, 2) of triangles at an edge, and whether they are oriented alike."""
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges = np.sort(directed, axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner, directed = edges[order], owner[order], directed[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    alike = directed[:-1, 0][same] != directed[1:, 0][same]
    return np.stack([owner[:-1][same], owner[1:][same]], axis=1), alike


def turned_faces(faces: np.ndarray) -> np.ndarray | None:
    """Triangles (F,) to turn so that all neighbours agree, or None if none would do.

    Every triangle stands in a graph twice, as it is and turned; neighbours that agree
    are joined side to side, others crosswise.
    """
    pairs, alike = _neighbours(faces)
    n = len(faces)
    if alike.all():
        return np.zeros(n, dtype=bool)
    a, b = pairs.T
    cross = np.where(alike, 0, n)
    rows = np.concatenate([a, a + n])
    cols = np.concatenate([b + cross, (b + n - cross)])
    link = coo_matrix((np.ones(len(rows)), (rows, cols)), shape=(2 * n, 2 * n))
    label = connected_components(link, directed=False)[1]
    if (label[:n] == label[n:]).any():
        return None
    # Of the two sheets of each part, the one of which more triangles stay as given.
    own, sizes = label[:n], np.bincount(label[:n], minlength=label.max() + 1)
    return sizes[own] < sizes[label[n:]]


def border_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Closed rows of vertices along the borders, in the direction of their faces.

    Where two holes meet in a vertex, they become one loop each as far as that can
    be told.
    """
    pairs = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there = {(int(a), int(b)) for a, b in pairs}
    following: dict[int, list[int]] = {}
    for a, b in sorted(there):
        if (b, a) not in there:
            following.setdefault(a, []).append(b)
    loops = []
    while following:
        start = next(iter(following))
        way, seen = [start], {start: 0}
        while True:
            after = following[way[-1]]
            step = after.pop()
            if not after:
                del following[way[-1]]
            if step in seen:
                loops.append(np.array(way[seen[step] :]))
                rest = way[: seen[step] + 1]
                if len(rest) == 1 and step not in following:
                    break
                way, seen = rest, {v: k for k, v in enumerate(rest)}
                if way[-1] not in following:
                    break
                continue
            if step not in following:
                break
            seen[step] = len(way)
            way.append(step)
    return [loop for loop in loops if len(loop) >= 3]


def _loop_axis(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit normal (3,) of a closed loop, and its area (m^2)."""
    spokes = points - points.mean(axis=0)
    total = 0.5 * np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)
    area = float(np.linalg.norm(total))
    return total / max(area, 1e-30), area


def _without_slivers(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, int]:
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
            for j in range(3):
                if {face[j], face[(j + 1) % 3]} == {a, b}:
                    p, q, top = face[j], face[(j + 1) % 3], face[(j + 2) % 3]
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


def _mm(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x * 1e3:.1f}" for x in point) + ")"
