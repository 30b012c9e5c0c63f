"""A patient's lumen, from a segmented scan to an anatomy ready for simulation."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.parts import Inlet, Surface
from cathsim_dmc.anatomy.scan import coacd_wall
from cathsim_dmc.anatomy.scan.check import check_tree
from cathsim_dmc.anatomy.scan.compiled_field import compiled, plain
from cathsim_dmc.anatomy.scan.curves import ScanCentreline, check_inside, read_curve
from cathsim_dmc.anatomy.scan.ends import (
    FreeEnd,
    LumenEntry,
    free_ends,
    listed,
    plan_inlet,
)
from cathsim_dmc.anatomy.scan.extract import centrelines, continued
from cathsim_dmc.anatomy.scan.inlet import cut_open, shut_behind
from cathsim_dmc.anatomy.scan.lumen import Lumen, read_lumen
from cathsim_dmc.anatomy.scan.mesh_depth import MeshDepth, depth_field
from cathsim_dmc.anatomy.scan.naming import name_branches, renamed
from cathsim_dmc.anatomy.scan.places import flat_ends, place_goals, place_inlet
from cathsim_dmc.anatomy.scan.tree import grow_tree
from cathsim_dmc.anatomy.scan.trunk import name_trunk
from cathsim_dmc.anatomy.scan.units import frame_sign, metres_per, upright
from cathsim_dmc.anatomy.scan.wall import (
    DEVICE_RADIUS,
    TOLERANCE,
    build_wall,
    inlet_cap,
)
from cathsim_dmc.anatomy.scan.ways import Ways
from cathsim_dmc.anatomy.wall.depth import SPACING, DepthField

log = logging.getLogger(__name__)

ROOT = "aorta"
WALLS = ("prisms", "coacd")
FRAMES = ("LPS", "RAS")
# Of the lattice of depths and of the prisms, m: finer ones take all memory, coarser
# ones no longer see the vessels.
SPACINGS, TOLERANCES = (1e-4, 2e-3), (1e-5, 2e-3)
NEAR_INLET = 15e-3  # m, distance from the lumen of an inlet that is pointed at
RADII = (0.3e-3, 30e-3)  # m, allowed median radius of a vessel: arteriole, aneurysm

# What to do about a tree that does not agree with the surface.
_MEND_DRAWN = (
    "Mend the surface or the centrelines there, leave that branch out, or let the "
    "centrelines be computed."
)
_MEND_COMPUTED = (
    "Mend the surface there, or give its frame (mesh_frame, axes), the inlet, or "
    "centrelines that were drawn."
)


def import_scan(
    mesh_path: str | Path,
    centreline_paths: Sequence[str | Path] = (),
    *,
    units: str | None = None,
    mesh_frame: str = "LPS",
    axes: str | None = None,
    name: str | None = None,
    inlet: Sequence[float] | None = None,
    root: str = ROOT,
    rename: Mapping[str, str] | None = None,
    spacing: float = SPACING,
    wall: str = "prisms",
    tolerance: float = TOLERANCE,
    threshold: float | None = None,
    progress: Callable[[str], None] | None = None,
    notes: list[str] | None = None,
) -> Anatomy:
    """Turn the surface of a lumen into an anatomy.

    Args:
        mesh_path: lumen surface (OBJ, STL, PLY or VTP); vessel ends open or capped.
        centreline_paths: 3D Slicer markups or tables x,y,z[,radius], one per branch;
            the branch is called after the file (centreline-LCCA.mrk.json: "lcca").
            Without any they are computed, and named where the arch tells how.
        units: of the mesh, of tables and of ``inlet``: "mm", "cm" or "m"; None
            guesses by the width of the lumen, and says so.
        mesh_frame: "LPS" or "RAS", of the mesh, of tables and of ``inlet``.
        axes: where +x, +y and +z of that frame point in the patient, if the scan does
            not stand upright, such as "ILA"; see ``units.upright``.
        name: of the anatomy, by default the mesh file's.
        inlet: (x, y, z) where the device enters: a free end if one is near, else the
            lumen is cut there. By default the end at which the centrelines start,
            else the wide end farthest from their starts or from the widest end.
        root: name of the vessel that starts at the inlet.
        rename: new names of computed vessels by their computed names.
        spacing: m, of the fine lattice of depths.
        wall: "prisms" (merged triangle prisms, near the surface) or "coacd" (convex
            decomposition, coarse).
        tolerance: m, of the prisms; see ``scan.wall.build_wall``.
        threshold: m, of CoACD; see ``coacd_wall.decompose_wall``.
        progress: called with a line of text for every step, which begins with the
            step's name or with "note".
        notes: list to which what was guessed, mended and left out is added.

    Returns:
        The anatomy, in metres, LPS. Radii are those of the largest sphere in the
        mesh at each place of a centreline that was moved to the lumen's middle.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file or an option is not as stated, or the tree that results
            does not agree with the surface; says how to mend it.
    """
    threshold = _check_wall(wall, threshold)
    bounds.choice("mesh_frame", mesh_frame, FRAMES)
    bounds.number("spacing", spacing, *SPACINGS, "m")
    bounds.number("tolerance", tolerance, *TOLERANCES, "m")
    _check_rename(rename)
    started = time.monotonic()

    def say(text: str) -> None:
        log.info(text)
        if progress is not None:
            progress(text)

    def note(text: str) -> None:
        if notes is not None:
            notes.append(text)
        say(f"note: {text}")

    frame_sign(mesh_frame)
    upright(axes)
    if units is not None:
        metres_per(units)
    place = _as_point(inlet)
    _check_paths(centreline_paths)
    for path in centreline_paths:
        read_curve(path, units or "mm", mesh_frame)  # before the long steps
    lumen = read_lumen(mesh_path, units, mesh_frame, axes, say)
    for text in lumen.notes:
        note(text)
    if place is not None:
        turn = upright(axes)
        place = turn @ (place * frame_sign(mesh_frame) * metres_per(lumen.units))
    vertices, faces = lumen.vertices, lumen.faces
    measure = MeshDepth(vertices, faces)
    _check_near(place, measure)
    curves = _read_curves(centreline_paths, lumen, mesh_frame, axes, root)
    lines = {curve.name: _inside_part(curve, measure, lumen.units) for curve in curves}
    say(f"depth: measuring the lumen of {len(faces):,} triangles")
    field = compiled(depth_field(vertices, faces, spacing))
    say(f"tree: {len(field.bricks):,} bricks of depth, looking for vessels")
    ways = Ways(field)
    for pinch in ways.pinches:
        note(f"the lumen is pinched to a slit at {_mm(pinch)}; vessels go on beyond")
    tree, opening = _tree(field, ways, lines, place, root, rename or {}, note)
    say(f"tree: {', '.join(_summary(tree))}")
    anatomy = Anatomy(
        name=name or Path(mesh_path).stem,
        tree=tree,
        surface=Surface(vertices, faces),
        wall=(),
        inlet=opening,
        goals=place_goals(tree, root),
        ends=flat_ends(tree, opening),
        field=field,
    )
    anatomy = _walled(anatomy, wall, tolerance, threshold, bool(lines), say, note)
    say(
        f"done: {len(anatomy.wall)} wall pieces in {time.monotonic() - started:.0f} s, "
        f"goals {', '.join(anatomy.goals) or 'none'}"
    )
    return anatomy


def _tree(field, ways, lines, place, root, rename, note) -> tuple[VesselTree, Inlet]:
    """The tree of given lines, or of computed ones, and its inlet."""
    ends = free_ends(ways)
    lines = {key: _proximal_first(line, field) for key, line in lines.items()}
    entry = plan_inlet(ways, ends, list(lines.values()), place)
    drawn = bool(lines)
    if drawn:
        if rename:
            raise ValueError("rename is for computed centrelines; rename the files.")
        lines, added = continued(ways, ends, lines, entry)
        for key, length in added.items():
            note(
                f"centreline {key!r} stops {length * 1e3:.0f} mm before its vessel "
                "ends; continued to the end"
            )
    else:
        lines = _computed(ways, ends, entry, root, rename, note)
    tree = grow_tree(field, ways, lines, entry.position, entry.far, root, drawn)
    return place_inlet(name_trunk(tree), entry.at_end)


def _computed(
    ways: Ways,
    ends: Sequence[FreeEnd],
    entry: LumenEntry,
    root: str,
    rename: Mapping[str, str],
    note: Callable[[str], None],
) -> dict[str, np.ndarray]:
    found, thin = centrelines(ways, ends, entry)
    if not found:
        raise ValueError(
            "no branch of the lumen lets a 5 Fr catheter "
            f"({DEVICE_RADIUS * 2e3:.2f} mm) in for 15 mm, so there is no goal; its "
            f"ends are {listed(ends)}."
        )
    start = ways.node(entry.position)
    if entry.far is None:
        line = found[0].points
    else:
        line = ways.points[ways.trace(ways.deepest_from(start), ways.node(entry.far))]
    names = name_branches(line, [f.points for f in found], entry.far is not None)
    names = renamed(names, rename, root)
    open_names = [key for key in names if key.startswith("branch_")]
    if open_names:
        places = ", ".join(
            f"{key} (ends at {_mm(f.tip)})"
            for key, f in zip(names, found, strict=True)
            if key in open_names
        )
        note(f"geometry gives no anatomical name to {places}; rename (--rename) does")
    if thin:
        note(f"{thin} branches too thin or short for a 5 Fr catheter left out")
    note(f"inlet chosen at {_mm(entry.position)}")
    return {key: f.points for key, f in zip(names, found, strict=True)}


def _walled(anatomy, wall, tolerance, threshold, drawn, say, note) -> Anatomy:
    """The anatomy cut open at its inlet and surrounded by its wall, and proved."""
    vertices, faces = anatomy.surface.vertices, np.asarray(anatomy.surface.faces)
    field, tree, opening = anatomy.field, anatomy.tree, anatomy.inlet
    cut_vertices, shell, cap = cut_open(vertices, faces.astype(np.int64), opening)
    closed = np.concatenate([shell, cap])
    shut = compiled(shut_behind(field, cut_vertices, closed, opening))
    anatomy = Anatomy(
        name=anatomy.name,
        tree=tree,
        surface=_compact(cut_vertices, closed),
        wall=(),
        inlet=opening,
        goals=anatomy.goals,
        ends=anatomy.ends,
        field=shut,
    )
    for check in check_tree(anatomy):
        if check.passed:
            continue
        if check.name == "start of the device" or not anatomy.goals:
            note(f"{check.name}: {check.detail}")
            continue
        raise ValueError(
            f"the tree does not agree with the surface ({check.name}): {check.detail}. "
            + (_MEND_DRAWN if drawn else _MEND_COMPUTED)
        )
    if wall == "coacd":
        pieces, _ = coacd_wall.decompose_wall(
            cut_vertices, shell, field, tree, threshold=threshold, progress=say
        )
    else:
        pieces, _ = build_wall(
            cut_vertices,
            shell,
            field,
            np.concatenate([v.centreline.points for v in tree.vessels.values()]),
            tolerance=tolerance,
            progress=say,
        )
    pieces += tuple(inlet_cap(cut_vertices[cap[:, :2]], opening))
    return replace(anatomy, wall=pieces, field=plain(shut))


def _compact(vertices, faces) -> Surface:
    used, numbers = np.unique(faces, return_inverse=True)
    return Surface(vertices[used], numbers.reshape(-1, 3).astype(np.int32))


def _check_wall(wall: str, threshold: float | None) -> float:
    """CoACD's threshold (m), checked before the import."""
    if wall not in WALLS:
        raise ValueError(f"wall is {wall!r}; give one of {', '.join(WALLS)}.")
    if wall != "coacd" and threshold is not None:
        raise ValueError("a threshold is for wall='coacd' only; leave it out.")
    return coacd_wall.check_threshold(
        coacd_wall.THRESHOLD if threshold is None else threshold
    )


def _as_point(inlet: Sequence[float] | None) -> np.ndarray | None:
    if inlet is None:
        return None
    try:
        point = np.asarray(inlet, dtype=np.float64)
    except (TypeError, ValueError):
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"inlet is {inlet!r}; give (x, y, z) in the mesh's unit.")
    return point


def _check_near(place: np.ndarray | None, measure: MeshDepth) -> None:
    if place is not None and measure(place[None])[0] < -NEAR_INLET:
        raise ValueError(
            f"inlet is {-measure(place[None])[0] * 1e3:.1f} mm away from the lumen; "
            f"give a point in the lumen, or at most {NEAR_INLET * 1e3:g} mm from the "
            "end by which the device enters."
        )


def _check_rename(rename: Mapping[str, str] | None) -> None:
    if rename is None:
        return
    if not isinstance(rename, Mapping) or not all(
        isinstance(word, str) for pair in rename.items() for word in pair
    ):
        bounds.refuse("rename", rename, "a mapping of computed names to wanted ones")


def _check_paths(paths: Sequence[str | Path]) -> None:
    listed = isinstance(paths, Sequence) and not isinstance(paths, str | bytes)
    if not listed or not all(isinstance(path, str | Path) for path in paths):
        raise ValueError(
            f"centreline_paths is {paths!r}; give a list of files, one per branch (3D "
            "Slicer .mrk.json or .csv), or none to have them computed."
        )


def _read_curves(paths, lumen: Lumen, frame, axes, root) -> list[ScanCentreline]:
    curves = [read_curve(path, lumen.units, frame) for path in paths]
    turn = upright(axes)
    curves = [replace(curve, points=curve.points @ turn.T) for curve in curves]
    names = [curve.name for curve in curves]
    for curve in curves:
        if names.count(curve.name) > 1 or curve.name == root:
            raise ValueError(
                f"{curve.path} gives the vessel name {curve.name!r}, which is taken "
                f"(names: {root}, {', '.join(names)}); rename the file."
            )
    return curves


def _inside_part(curve: ScanCentreline, measure: MeshDepth, units: str) -> np.ndarray:
    depth = measure(curve.points)
    mirrored = measure(curve.points * (-1.0, -1.0, 1.0))
    keep = check_inside(curve, depth, mirrored)
    radius = float(np.median(depth[keep]))
    if not RADII[0] <= 1.5 * radius <= 1.5 * RADII[1]:
        raise ValueError(
            f"{curve.path}: the lumen's radius along it is {radius * 1e3:.3g} mm when "
            f"the unit is {units!r} (allowed {RADII[0] * 1e3:g} to {RADII[1] * 1e3:g} "
            "mm); pass the right units."
        )
    if curve.radii is not None:
        ratio = float(np.median(curve.radii[keep] / np.maximum(depth[keep], 1e-5)))
        if not 1.0 / 3.0 < ratio < 3.0:
            log.warning(
                "%s: its radii are %.2g times those of the mesh, which are used",
                curve.path,
                ratio,
            )
    return curve.points[keep]


def _proximal_first(line: np.ndarray, field: DepthField) -> np.ndarray:
    """Turn a centreline so that its wider end comes first."""
    part = max(1, len(line) // 8)
    first, last = field(line[:part]).max(), field(line[-part:]).max()
    return line[::-1] if last > 1.1 * first else line


def _summary(tree: VesselTree) -> list[str]:
    return [
        f"{key} {vessel.centreline.length * 1e3:.0f} mm"
        + (f" from {vessel.parent}" if vessel.parent else "")
        for key, vessel in tree.vessels.items()
    ]


def _mm(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x * 1e3:.0f}" for x in point) + ") mm"
