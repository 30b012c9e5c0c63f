"""Repair of a lumen's surface; each repair is counted and noted."""

from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.parts import Inlet, Surface
from cathsim_dmc.anatomy.scan import bodies, topology
from cathsim_dmc.anatomy.scan.membranes import membranes
from cathsim_dmc.anatomy.scan.places import cut_open
from cathsim_dmc.anatomy.scan.units import enlargement, mm, shown
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

NON_MANIFOLD = 0.01  # largest share of triangles at non-manifold edges to cut out
HOLE = 8e-3  # m, widest hole in the side of a vessel that is filled
SPIKE = 4e-3  # m, widest patch around a self-intersection that is cut out
FOLD = 2.5e-3  # m, largest movement of a vertex of a self-intersection
LITTLE = 0.5e-3  # m, the same before a patch is cut out
WIDE_HOLE = 14e-3  # m, largest such limit in an enlarged lumen
CUT = 16e-3  # m, widest filled hole where triangles were cut out
END_AREA = 0.5e-6  # m^2, least area of an open end
END = 0.55  # largest |cosine| between an end's axis and the normals around it
# Test of an open end, in radii of its rim: rays across start BEHIND the rim, and fewer
# than OPEN of all DIRECTIONS may find no wall within NEARBY.
BEHIND, NEARBY, DIRECTIONS, OPEN = 0.75, 2.5, 32, 0.12
RAGGED = 0.1  # of an end's width: less flat rims are cut back to a plane
DENSE = 30_000  # triangles; more are decimated
FEW = 12_000  # triangles after decimation
ROUNDS = 6
_OF_WALL = (
    "The surface was taken for that of a thick wall, and cut at its rims: export the "
    "lumen alone, without wall, flanges and connectors. If it has none: "
)
_OF_CUT = ", where triangles that meet in one edge or pierce each other were cut out"
_AGAIN = "Smooth or remesh that place, or export the segmentation again."


class Mended(NamedTuple):
    """A closed surface (m), a note for each change, whether the file had a wall."""

    surface: Surface
    notes: list[str]
    walled: bool


def mend(name: str, vertices: np.ndarray, faces: np.ndarray) -> Mended:
    """Close a surface (V, 3) m, (F, 3), turn it outwards, and keep one part of it.

    ValueError if it cannot be mended; says what is wrong, and where, in the file called
    `name`.
    """
    work = _Work(name, vertices, faces)
    work.merge()
    work.keep_one_part()
    work.open_membranes()
    work.cut_non_manifold()  # while triangles are small, so that holes are
    work.decimate()  # makes no edge with more than two triangles
    work.orient()
    work.keep_inner_surface()
    work.close()
    work.keep_one_part(quiet=True)
    work.turn_outwards()
    work.untangle()
    surface = Surface(work.vertices, work.faces)
    return Mended(surface, work.notes, work.walled)


class _Work:
    def __init__(self, name: str, vertices: np.ndarray, faces: np.ndarray):
        self.name, self.vertices, self.faces = name, vertices, faces
        self.notes: list[str] = []
        self._ends, self._ragged = 0, 0.0
        self.walled = self._rims = False
        self._cut: set[tuple[float, ...]] = set()  # corners of cut triangles

    def merge(self) -> None:
        """Merges coincident vertices; drops repeated triangles and empty ones."""
        before = len(self.faces)
        self.vertices, self.faces = topology.merged(self.vertices, self.faces)
        self.vertices, self.faces = topology.joined(self.vertices, self.faces)
        dropped = before - len(self.faces)
        self.faces, flipped = topology.without_slivers(self.vertices, self.faces)
        if dropped + flipped:
            self.notes.append(
                f"{dropped + flipped} triangles without area or given twice taken out"
            )

    def keep_one_part(self, quiet: bool = False) -> None:
        """Drops small parts; keeps the inner of the two surfaces of a wall."""
        found = bodies.found(self.vertices, self.faces)
        label, share, large = found
        inner = None
        if len(large) == 2 and not quiet:
            inner = topology.inner_shell(self.vertices, self.faces, label, large)
        if inner is not None:
            self.notes.append("thick wall: the inner of two surfaces taken")
            self.walled = True
            large = [inner]
        elif len(large) > 1:
            raise bodies.refusal(self.name, self.vertices, self.faces, found)
        elif len(share) > 1 and not quiet:
            self.notes.append(
                f"{len(share) - 1} small parts beside the lumen dropped "
                f"({100 * (1 - share[large[0]]):.2g} % of the area)"
            )
        self._keep(label == large[0])

    def decimate(self) -> None:
        """Decimates a surface with more than `DENSE` triangles."""
        if len(self.faces) <= DENSE:
            return
        points, faces = topology.decimated(self.vertices, self.faces, FEW)
        rng = np.random.default_rng(0)
        some = self.vertices[rng.integers(len(self.vertices), size=4000)]
        off = np.abs(SurfaceDepth(Surface(points, faces))(some))
        self.notes.append(
            f"decimated from {len(self.faces):,} to {len(faces):,} triangles; the "
            f"surface moved by {mm(off.mean()):.2f} mm in the mean, "
            f"{mm(off.max()):.2f} mm at most"
        )
        self.vertices, self.faces = points, faces

    def open_membranes(self) -> None:
        """Takes out sheets across the lumen, such as caps that a join has left."""
        found = membranes(self.vertices, self.faces)
        if found:
            where = shown(self.vertices[self.faces[found[-1]]].mean(axis=(0, 1)))
            self.notes.append(
                f"{len(found)} sheets across the lumen taken out, the largest at "
                f"{where}: if a vessel is closed there, close it at its end"
            )
            self._keep(~np.any(found, axis=0))

    def cut_non_manifold(self) -> None:
        """Cuts out the triangles at edges that more than two triangles share."""
        first = None
        for _ in range(ROUNDS):
            edges, times = topology.edge_counts(self.faces)
            shared = edges[times > 2]
            if not len(shared):
                break
            bad = np.asarray(np.isin(self.faces, shared).any(axis=1))
            first = first or (
                f"{len(shared)} edges shared by more than two triangles, one at "
                f"{shown(self.vertices[shared[0, 0]])}"
            )
            if bad.sum() > max(NON_MANIFOLD * len(self.faces), 40):
                raise ValueError(
                    f"{self.name} has {first}, too many to mend: parts of the surface "
                    f"are glued together. {_AGAIN}"
                )
            self._cut_out(bad)
        if first:
            self.notes.append(f"{first}: the triangles around them cut out")
            # A vessel that is cut through here is no small part.
            found = bodies.found(self.vertices, self.faces)
            self._keep(np.isin(found.label, found.large))

    def _drop_small_parts(self) -> None:
        label = topology.parts(self.faces)
        share = np.bincount(label, topology.areas(self.vertices, self.faces))
        self._keep(
            np.isin(label, np.flatnonzero(share > bodies.PART_AREA * share.sum()))
        )

    def orient(self) -> None:
        """Gives neighbouring triangles the same orientation."""
        self.faces, turned = topology.oriented(self.faces)
        if turned:
            self.notes.append(f"{turned} flipped triangles turned")

    def keep_inner_surface(self) -> None:
        """Keeps the inner surface of a wall that is open at its ends."""
        inner = topology.lumen_of_wall(self.vertices, self.faces)
        if inner is not None:
            self.notes.append("thick wall: its inner surface taken as the lumen")
            self.walled = self._rims = True
            self._keep(inner)
            self.faces = self.faces[:, ::-1]
            self._drop_small_parts()

    def close(self) -> None:
        """Cap the ends of vessels; fill holes, wider ones where a part was cut out."""
        filled = []
        for loop in topology.border_loops(self.faces):
            points = self.vertices[loop]
            middle = points.mean(axis=0)
            spokes = points - middle
            wide = 2.0 * float(np.linalg.norm(spokes, axis=1).max())
            total = 0.5 * np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)
            area = float(np.linalg.norm(total))
            axis = total / max(area, 1e-30)
            cut = bool(self._cut & set(map(tuple, points)))
            widest = CUT if cut else min(HOLE * enlargement(), WIDE_HOLE)
            end = len(loop) > 3 and area > END_AREA
            if end and self._is_end(loop, axis, wide > widest and not cut):
                self._ends += 1
                if self._cut_back(loop, middle, axis):
                    continue
            elif wide > widest:
                raise ValueError(
                    f"{self.name} is not closed: a hole {mm(wide):.1f} mm wide in "
                    f"the side of a vessel at {shown(middle)}"
                    f"{_OF_CUT if cut else ''} (at most {mm(widest):.2g} mm are "
                    "filled). "
                    f"{_OF_WALL if self._rims else ''}Fill holes (3D Slicer: Surface "
                    "Toolbox, Fill holes), then export again."
                )
            else:
                filled.append((wide, shown(middle)))
            self._fan(loop, middle)
        if filled:
            wide, where = max(filled)
            self.notes.append(
                f"holes filled: {len(filled)}, the widest {mm(wide):.1f} mm at {where}"
            )
        if self._ends:
            note = f"{self._ends} open vessel ends capped"
            if self._ragged:
                note += f", ragged rims cut back by up to {mm(self._ragged):.1f} mm"
            self.notes.append(note)
        self._require_closed()

    def _fan(self, loop: np.ndarray, middle: np.ndarray) -> None:
        """Closes a border (n,) by triangles around its middle (3,), m."""
        fan = loop[None, ::-1]
        if len(loop) > 3:
            centre = np.full(len(loop), len(self.vertices))
            self.vertices = np.concatenate([self.vertices, middle[None]])
            fan = np.stack([np.roll(loop, -1), loop, centre], axis=1)
        self.faces = np.concatenate([self.faces, fan])

    def _require_closed(self) -> None:
        edges, times = topology.edge_counts(self.faces)
        if (times != 2).any():
            where = shown(self.vertices[edges[times != 2][0, 0]])
            raise ValueError(
                f"{self.name} is not closed: after mending {int((times != 2).sum())} "
                f"edges do not have two triangles, one at {where}. {_AGAIN}"
            )

    def _cut_back(self, loop: np.ndarray, middle: np.ndarray, axis: np.ndarray) -> bool:
        """Cut a ragged rim back to a plane and cap it; False if nothing was cut.

        A fan over ragged triangles would fold into the lumen.
        """
        spokes = self.vertices[loop] - middle
        reach, ragged = np.linalg.norm(spokes, axis=1).max(), np.ptp(spokes @ axis)
        if ragged < 2.0 * RAGGED * reach:
            return False
        beside = np.setdiff1d(self.faces[np.isin(self.faces, loop).any(axis=1)], loop)
        axis = axis * np.sign((self.vertices[beside] - middle).mean(axis=0) @ axis)
        place = middle + ((spokes @ axis).max() + 0.02 * reach) * axis
        try:
            points, *kept = cut_open(
                self.vertices, self.faces, Inlet("rim", place, axis, float(reach))
            )
        except ValueError:
            return False
        faces = np.concatenate(kept)
        gone = self.vertices[np.setdiff1d(self.faces, faces)]
        if np.linalg.norm(gone - middle, axis=1).max(initial=0.0) > 1.2 * reach:
            return False  # a branch would be cut off, too
        self.vertices, self.faces = points, faces
        self._ragged = max(self._ragged, float(ragged))
        return True

    def _is_end(self, loop: np.ndarray, axis: np.ndarray, wide: bool) -> bool:
        """Whether a vessel ends at the loop: the wall behind it surrounds its axis.

        At an end the triangles of the rim cross its plane, unless the rim of a wide end
        is turned in or out. Behind a hole in the side the vessel continues both ways.
        """
        beside = np.isin(self.faces, loop).any(axis=1)
        corners = self.vertices[self.faces[beside]]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.linalg.norm(cross, axis=1)
        across = np.abs(cross @ axis).sum() < END * max(float(size.sum()), 1e-30)
        if not wide:
            return bool(across)
        far = self._far_behind(loop, axis)
        both_ways = far & np.roll(far, DIRECTIONS // 2)
        return bool(far.mean() < OPEN or (across and not both_ways.any()))

    def _far_behind(self, loop: np.ndarray, axis: np.ndarray) -> np.ndarray:
        """Mask (n,) of directions across the axis behind a loop without a near wall."""
        import igl

        rim = self.vertices[loop]
        middle = rim.mean(axis=0)
        reach = float(np.linalg.norm(rim - middle, axis=1).mean())
        off = self.vertices - middle
        near = off[np.linalg.norm(off, axis=1) < NEARBY * reach]
        back = np.sign(near.mean(axis=0) @ axis) * axis
        # libigl's tolerances suit coordinates of order one.
        vertices, faces = 1e3 * self.vertices, np.ascontiguousarray(self.faces)
        boxes = igl.AABB()
        boxes.init(vertices, faces)
        angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        rays = rays @ np.linalg.svd(axis[None])[2][1:]
        start = np.tile(1e3 * (middle + BEHIND * reach * back), (DIRECTIONS, 1))
        hits = boxes.intersect_ray(vertices, faces, start, rays)
        gaps = [min((hit[1] for hit in row), default=np.inf) for row in hits]
        return np.array(gaps) > 1e3 * NEARBY * reach

    def turn_outwards(self) -> None:
        """Turn the whole surface if its normals point inwards."""
        if Surface(self.vertices, self.faces).volume < 0.0:
            self.faces = self.faces[:, ::-1]
            self.notes.append("surface turned inside out: normals pointed inwards")

    def untangle(self) -> None:
        """Smooth folds that pierce the surface, or cut out small patches.

        A patch that is cut out leaves a hole as wide as the triangles around it, so
        smoothing comes first where it moves the vertices little.
        """
        first = None
        for turn in range(ROUNDS + 1):
            pierced, where, tangled = self._crossings(self.vertices)
            if not pierced:
                break
            first = first or (pierced, where)
            few = tangled.mean() <= NON_MANIFOLD and turn < ROUNDS
            if few and turn == 0 and self._smooth_folds(LITTLE):
                return
            patches = self.faces[tangled]
            label = topology.parts(patches)
            wide = topology.widths(self.vertices, patches, label).max() > SPIKE
            if not few or wide:
                if few and self._smooth_folds(FOLD):
                    return
                raise ValueError(
                    f"{self.name} intersects itself: {first[0]} triangles, one at "
                    f"{where}, are pierced by others. {_AGAIN}"
                )
            self._cut_out(np.asarray(np.isin(self.faces, patches).any(axis=1)))
            self._drop_small_parts()
            self.cut_non_manifold()
            self.close()
        if first:
            self.notes.append(
                f"{first[0]} self-intersecting triangles near {first[1]} cut out"
            )

    def _crossings(self, vertices: np.ndarray) -> tuple[int, str, np.ndarray]:
        """Number of pierced triangles, place of one, and mask (F,) of all involved."""
        faces, edges = topology.crossings(vertices, self.faces)
        tangled = np.isin(self.faces, np.unique(edges)).sum(axis=1) >= 2
        tangled[faces] = True
        where = shown(vertices[edges[0, 0]]) if len(edges) else ""
        return len(np.unique(faces)), where, tangled

    def _smooth_folds(self, limit: float) -> bool:
        """Smooth the vertices of folds; False if that fails or moves one too far.

        `limit` is the largest movement, m.
        """
        vertices, count = self.vertices, 0
        beside = topology.neighbour_means(self.faces)
        for _ in range(2 * ROUNDS):
            pierced, _, tangled = self._crossings(vertices)
            if not pierced:
                break
            count = max(count, pierced)
            moved = np.unique(self.faces[tangled])
            vertices = vertices.copy()
            vertices[moved] += 0.25 * (beside @ vertices - vertices)[moved]
        else:
            return False
        far = float(np.linalg.norm(vertices - self.vertices, axis=1).max())
        if far <= limit:
            self.vertices = vertices
            self.notes.append(
                f"{count} self-intersecting triangles smoothed, by {mm(far):.1f} mm "
                "at most"
            )
        return far <= limit

    def _cut_out(self, chosen: np.ndarray) -> None:
        self._cut.update(map(tuple, self.vertices[np.unique(self.faces[chosen])]))
        self._keep(~chosen)

    def _keep(self, chosen: np.ndarray) -> None:
        self.vertices, self.faces = topology.used(self.vertices, self.faces[chosen])
