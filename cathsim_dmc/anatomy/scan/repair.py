"""Mending a lumen's surface: what is wrong is put right, counted and said."""

from __future__ import annotations

import numpy as np

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan.thick import inner_shell, lumen_of_wall
from cathsim_dmc.anatomy.scan.topology import (
    areas,
    border_loops,
    decimated,
    edge_counts,
    loop_axis,
    merged,
    oriented,
    parts,
    widths,
    without_slivers,
)
from cathsim_dmc.anatomy.scan.units import in_mm
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

PART_AREA = 0.03  # of the surface's area: smaller separate parts are dropped
PART_WIDTH = 12e-3  # m, and if they are not wider
NON_MANIFOLD = 0.01  # of the triangles: more at non-manifold edges are not mended
HOLE = 8e-3  # m, widest hole in the side of a vessel that is filled
SPIKE = 4e-3  # m, widest patch around a self-intersection that is cut out
FOLD = 2.5e-3  # m, most that a vertex of a self-intersection is moved
CUT = 16e-3  # m, widest hole that is filled where it was cut out
END_AREA = 0.5e-6  # m^2, least area of an open end
END = 0.55  # largest |cosine| between an end's axis and the normals around it
DENSE = 30_000  # triangles; more are decimated
FEW = 12_000  # triangles that are left then
ROUNDS = 6


def mend(
    name: str, vertices: np.ndarray, faces: np.ndarray
) -> tuple[Surface, list[str]]:
    """Close a surface, turn it outwards, and leave one part of it.

    Args:
        name: of the file, for messages.
        vertices: (V, 3) m.
        faces: (F, 3).

    Returns:
        The closed surface of one part, and what was changed, a line for each.

    Raises:
        ValueError: if it cannot be mended; says what is wrong and where.
    """
    work = _Work(name, vertices, faces)
    work.merge()
    work.keep_one_part()
    work.decimate()
    work.cut_non_manifold()
    work.orient()
    work.keep_inner_surface()
    work.close()
    work.keep_one_part(quiet=True)
    work.turn_outwards()
    work.untangle()
    return Surface(work.vertices, work.faces), work.notes


class _Work:
    def __init__(self, name: str, vertices: np.ndarray, faces: np.ndarray):
        self.name, self.vertices, self.faces = name, vertices, faces
        self.notes: list[str] = []
        self._ends = 0
        self._cut: set[tuple[float, ...]] = set()  # corners of what was cut out

    def merge(self) -> None:
        """One vertex per place, and no triangle without area or twice."""
        before = len(self.faces)
        self.vertices, self.faces = merged(self.vertices, self.faces)
        dropped = before - len(self.faces)
        self.faces, flipped = without_slivers(self.vertices, self.faces)
        if dropped + flipped:
            self.notes.append(
                f"{dropped + flipped} triangles without area or given twice taken out"
            )
        if len(self.faces) < 4:
            raise ValueError(
                f"{self.name} has {len(self.faces)} triangles with an area; give the "
                "surface of a lumen."
            )

    def keep_one_part(self, quiet: bool = False) -> None:
        """Drops small parts; keeps the inner of the two surfaces of a wall."""
        label = parts(self.faces)
        area = areas(self.vertices, self.faces)
        share = np.bincount(label, area) / area.sum()
        large = np.flatnonzero(
            (share > PART_AREA)
            | (widths(self.vertices, self.faces, label) > PART_WIDTH)
        )
        if len(large) == 2 and not quiet:
            inner = inner_shell(self.vertices, *(self.faces[label == k] for k in large))
            if inner is not None:
                self.notes.append(
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
                self.notes.append(
                    f"{len(share) - 1} small parts beside the lumen dropped "
                    f"({100 * (1 - share[large[0]]):.2g} % of the area)"
                )
            self._keep(label == large[0])

    def decimate(self) -> None:
        """Fewer triangles where there are very many."""
        if len(self.faces) <= DENSE:
            return
        points, faces = decimated(self.vertices, self.faces, FEW)
        rng = np.random.default_rng(0)
        some = self.vertices[rng.integers(len(self.vertices), size=4000)]
        off = np.abs(SurfaceDepth(Surface(points, faces))(some))
        self.notes.append(
            f"decimated from {len(self.faces):,} to {len(faces):,} triangles; the "
            f"surface moved by {off.mean() * 1e3:.2f} mm in the mean, "
            f"{off.max() * 1e3:.2f} mm at most"
        )
        self.vertices, self.faces = points, faces

    def cut_non_manifold(self) -> None:
        """Cuts out the triangles at edges that more than two triangles share."""
        first = None
        for _ in range(ROUNDS):
            edges, times = edge_counts(self.faces)
            shared = edges[times > 2]
            if not len(shared):
                break
            bad = np.asarray(np.isin(self.faces, shared).any(axis=1))
            first = first or (len(shared), self.vertices[shared[0, 0]])
            if bad.sum() > max(NON_MANIFOLD * len(self.faces), 40):
                raise ValueError(
                    f"{self.name} has {first[0]} edges shared by more than two "
                    f"triangles, one at {in_mm(first[1])}, too many to mend: parts "
                    "of the surface are glued together. Export it from the "
                    "segmentation again, or remesh it."
                )
            self._cut_out(bad)
        if first:
            self.notes.append(
                f"{first[0]} edges shared by more than two triangles, near "
                f"{in_mm(first[1])}: the triangles around them cut out"
            )
            self._drop_small_parts()

    def _drop_small_parts(self) -> None:
        label = parts(self.faces)
        share = np.bincount(label, areas(self.vertices, self.faces))
        self._keep(np.isin(label, np.flatnonzero(share > PART_AREA * share.sum())))

    def orient(self) -> None:
        """Gives neighbouring triangles the same orientation."""
        found = oriented(self.faces)
        if found is None:
            raise ValueError(
                f"{self.name} is a surface with one side only (a Moebius strip): its "
                "triangles cannot all face outwards. Export it again."
            )
        self.faces, turned = found
        if turned:
            self.notes.append(f"{turned} flipped triangles turned")

    def keep_inner_surface(self) -> None:
        """Keeps the inner surface of a wall that is open at its ends."""
        inner = lumen_of_wall(self.vertices, self.faces)
        if inner is not None:
            self.notes.append("thick wall: its inner surface taken as the lumen")
            self._keep(inner)
            self.faces = self.faces[:, ::-1]
            self._drop_small_parts()

    def close(self) -> None:
        """Cap the ends of vessels; fill holes, wider ones where a part was cut out."""
        filled = []
        for loop in border_loops(self.faces):
            points = self.vertices[loop]
            middle = points.mean(axis=0)
            wide = 2.0 * float(np.linalg.norm(points - middle, axis=1).max())
            axis, area = loop_axis(points)
            large = len(loop) > 3 and area > END_AREA
            if large and self._is_end(loop, axis):
                self._ends += 1
            elif wide > (
                widest := CUT if self._cut & set(map(tuple, points)) else HOLE
            ):
                raise ValueError(
                    f"{self.name} is not closed: a hole {wide * 1e3:.1f} mm wide in "
                    f"the side of a vessel at {in_mm(middle)} (at most "
                    f"{widest * 1e3:g} mm are filled). Fill holes (3D Slicer: Surface "
                    "Toolbox, Fill holes), then export again."
                )
            else:
                filled.append((wide, middle))
            self._fan(loop, middle)
        if filled:
            wide, middle = max(filled, key=lambda hole: hole[0])
            self.notes.append(
                f"{len(filled)} holes filled, the widest {wide * 1e3:.1f} mm at "
                f"{in_mm(middle)}"
            )
        if self._ends:
            self.notes.append(f"{self._ends} open vessel ends capped")
        edges, times = edge_counts(self.faces)
        if (times != 2).any():
            where = self.vertices[edges[times != 2][0, 0]]
            raise ValueError(
                f"{self.name} is not closed: {int((times == 1).sum())} boundary edges "
                f"and {int((times > 2).sum())} edges shared by more than two triangles "
                f"are left after mending, one at {in_mm(where)}. Export it from the "
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
        if Surface(self.vertices, self.faces).volume < 0.0:
            self.faces = self.faces[:, ::-1]
            self.notes.append("surface turned inside out: normals pointed inwards")

    def untangle(self) -> None:
        """Cut out small patches that pierce the surface, smooth or refuse others."""
        first = None
        for _ in range(ROUNDS):
            faces, edges = SurfaceDepth(Surface(self.vertices, self.faces)).crossings()
            if not len(faces):
                break
            tangled = self._tangled(faces, edges)
            where = self.vertices[edges[0, 0]]
            first = first or (len(np.unique(faces)), where)
            few = tangled.mean() <= NON_MANIFOLD
            if not few or self._widest_patch(tangled) > SPIKE:
                if few and self._smooth_folds():
                    return
                raise ValueError(
                    f"{self.name} intersects itself: {first[0]} triangles, one at "
                    f"{in_mm(where)}, are pierced by others. Smooth or remesh that "
                    "place, or export the segmentation again."
                )
            touched = np.isin(self.faces, self.faces[tangled]).any(axis=1)
            self._cut_out(np.asarray(touched))
            self._drop_small_parts()
            self.cut_non_manifold()
            self.close()
        else:
            assert first is not None  # every round has found some
            raise ValueError(
                f"{self.name} intersects itself near {in_mm(first[1])}, and cutting "
                "the place out did not help. Smooth or remesh it."
            )
        if first:
            self.notes.append(
                f"{first[0]} self-intersecting triangles near {in_mm(first[1])} cut out"
            )

    def _tangled(self, faces: np.ndarray, edges: np.ndarray) -> np.ndarray:
        """Triangles (F,) that are pierced, or have an edge that pierces one."""
        tangled = np.isin(self.faces, np.unique(edges)).sum(axis=1) >= 2
        tangled[faces] = True
        return tangled

    def _smooth_folds(self) -> bool:
        """Move vertices of folds to their neighbours; False if that does not help."""
        vertices, count = self.vertices, 0
        for _ in range(2 * ROUNDS):
            faces, edges = SurfaceDepth(Surface(vertices, self.faces)).crossings()
            if not len(faces):
                break
            count = max(count, len(np.unique(faces)))
            moved = np.unique(self.faces[self._tangled(faces, edges)])
            one, other = self.faces.ravel(), np.roll(self.faces, 1, axis=1).ravel()
            total = np.zeros_like(vertices)
            np.add.at(total, one, vertices[other])
            middle = (
                total
                / np.maximum(np.bincount(one, minlength=len(vertices)), 1)[:, None]
            )
            vertices = vertices.copy()
            vertices[moved] += 0.25 * (middle - vertices)[moved]
        else:
            return False
        far = float(np.linalg.norm(vertices - self.vertices, axis=1).max())
        if far > FOLD:
            return False
        self.vertices = vertices
        self.notes.append(
            f"{count} self-intersecting triangles smoothed, by {far * 1e3:.1f} mm "
            "at most"
        )
        return True

    def _widest_patch(self, chosen: np.ndarray) -> float:
        label = parts(self.faces[chosen])
        return float(widths(self.vertices, self.faces[chosen], label).max())

    def _cut_out(self, chosen: np.ndarray) -> None:
        self._cut.update(map(tuple, self.vertices[np.unique(self.faces[chosen])]))
        self._keep(~chosen)

    def _keep(self, chosen: np.ndarray) -> None:
        used, numbers = np.unique(self.faces[chosen], return_inverse=True)
        self.vertices, self.faces = self.vertices[used], numbers.reshape(-1, 3)
