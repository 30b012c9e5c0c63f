"""A patient's lumen, from a segmented scan to an anatomy ready for simulation."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy, End, Goal, Inlet, Surface
from cathsim_dmc.anatomy.centreline import Vessel, VesselTree
from cathsim_dmc.anatomy.scan import coacd_wall
from cathsim_dmc.anatomy.scan.files import (
    Curve,
    check_inside,
    frame_sign,
    metres_per,
    read_curve,
    read_mesh,
)
from cathsim_dmc.anatomy.scan.inlet import cut_open, shut_behind
from cathsim_dmc.anatomy.scan.mesh_depth import MeshDepth, depth_field
from cathsim_dmc.anatomy.scan.tree import Ways, grow_tree, plan_inlet
from cathsim_dmc.anatomy.scan.trunk import name_trunk
from cathsim_dmc.anatomy.scan.wall import (
    DEVICE_RADIUS,
    TOLERANCE,
    build_wall,
    inlet_cap,
)
from cathsim_dmc.anatomy.wall import fidelity
from cathsim_dmc.anatomy.wall.depth import SPACING, DepthField

log = logging.getLogger(__name__)

ROOT = "aorta"
WALLS = ("prisms", "coacd")
GOAL_PAST_OSTIUM = 30e-3  # m along a branch, its first goal
GOAL_DISTAL = 0.8  # of the passable part of a branch, its second goal
INLET_WIDTH = 0.8  # of the lumen near the inlet; the rest of the blind end is cut off
INLET_SEARCH = 40e-3  # m of the root in which that width is looked for
NEAR_INLET = 15e-3  # m, distance from the lumen of an inlet that is pointed at
SAMPLING = 1e-3  # m, between the places at which the wall is measured
RAYS = 20_000  # shot at the wall to find leaks
RADII = (0.3e-3, 30e-3)  # m, allowed median radius of a vessel: arteriole, aneurysm


def import_scan(
    mesh_path: str | Path,
    centreline_paths: Sequence[str | Path],
    *,
    units: str = "mm",
    mesh_frame: str = "LPS",
    name: str | None = None,
    inlet: Sequence[float] | None = None,
    root: str = ROOT,
    spacing: float = SPACING,
    wall: str = "prisms",
    tolerance: float = TOLERANCE,
    threshold: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Anatomy:
    """Turn a lumen surface and centrelines drawn in it into an anatomy.

    Args:
        mesh_path: closed lumen surface (OBJ, STL, PLY, ...).
        centreline_paths: 3D Slicer markups or tables x,y,z[,radius], one per branch;
            the branch is called after the file (centreline-LCCA.mrk.json: "lcca").
        units: of the mesh, of tables and of ``inlet``: "mm", "cm" or "m".
        mesh_frame: "LPS" or "RAS", of the mesh, of tables and of ``inlet``.
        name: of the anatomy, by default the mesh file's.
        inlet: (x, y, z) where the device enters: a free end if one is near, else the
            lumen is cut there. By default the end at which the centrelines start,
            else the wide end farthest from their starts.
        root: name of the vessel that starts at the inlet.
        spacing: m, of the fine lattice of depths.
        wall: "prisms" (merged triangle prisms, near the surface) or "coacd" (convex
            decomposition, coarse; needs the package coacd).
        tolerance: m, of the prisms; see ``scan.wall.build_wall``.
        threshold: m, of CoACD; see ``coacd_wall.decompose_wall``.
        progress: called with a line of text for every step.

    Returns:
        The anatomy, in metres, LPS. Radii are those of the largest sphere in the
        mesh at each place of a centreline that was moved to the lumen's middle.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file or an option is not as stated; says how to mend it.
        ImportError: if ``wall`` is "coacd" and the package is missing.
    """
    threshold = _check_wall(wall, threshold)
    started = time.monotonic()

    def say(text: str) -> None:
        log.info(text)
        if progress is not None:
            progress(f"{time.monotonic() - started:6.1f} s  {text}")

    scale, sign = metres_per(units), frame_sign(mesh_frame)
    curves = _read_curves(centreline_paths, units, mesh_frame, root)
    if inlet is not None:
        inlet = np.asarray(inlet, dtype=np.float64)
        if inlet.shape != (3,) or not np.isfinite(inlet).all():
            raise ValueError(f"inlet is {inlet!r}; give (x, y, z) in {units}.")
        inlet = inlet * sign * scale
    vertices, faces = read_mesh(mesh_path, units, mesh_frame)
    say(f"mesh: {len(faces)} triangles, {len(curves)} centrelines")
    measure = MeshDepth(vertices, faces)
    if inlet is not None and measure(inlet[None])[0] < -NEAR_INLET:
        raise ValueError(
            f"inlet is {-measure(inlet[None])[0] * 1e3:.1f} mm away from the lumen; "
            f"give a point in the lumen, or at most {NEAR_INLET * 1e3:g} mm from the "
            "end by which the device enters."
        )
    lines = {curve.name: _inside_part(curve, measure, units) for curve in curves}
    say("depth: measuring the lumen, the longest step")
    field = depth_field(vertices, faces, spacing)
    say(f"depth: {len(field.bricks)} bricks of {spacing * 1e3:g} mm")
    ways = Ways(field)
    lines = {key: _proximal_first(line, field) for key, line in lines.items()}
    entry, far = plan_inlet(ways, list(lines.values()), inlet)
    tree = name_trunk(grow_tree(field, ways, lines, entry, far, root))
    at_end = inlet is None or not np.allclose(entry, inlet)
    tree, opening = _place_inlet(tree, at_end)
    say(f"tree: {', '.join(_summary(tree))}")
    cut_vertices, shell, cap = cut_open(vertices, faces, opening)
    if wall == "coacd":
        pieces, _ = coacd_wall.decompose_wall(
            cut_vertices, shell, field, tree, threshold=threshold, progress=say
        )
    else:
        lines = [vessel.centreline.points for vessel in tree.vessels.values()]
        pieces, _ = build_wall(
            cut_vertices,
            shell,
            field,
            np.concatenate(lines),
            tolerance=tolerance,
            progress=say,
        )
    pieces += tuple(inlet_cap(cut_vertices[cap[:, :2]], opening))
    closed = np.concatenate([shell, cap])
    anatomy = Anatomy(
        name=name or Path(mesh_path).stem,
        tree=tree,
        surface=_compact(cut_vertices, closed),
        wall=pieces,
        inlet=opening,
        goals=_goals(tree, root),
        ends=_ends(tree, opening),
        field=shut_behind(field, cut_vertices, closed, opening),
    )
    say(f"done: {len(pieces)} wall pieces, goals {', '.join(anatomy.goals)}")
    return anatomy


def describe(anatomy: Anatomy) -> dict[str, Any]:
    """What an import gave, as JSON values in millimetres.

    The wall is measured, not quoted: how far it stands in the lumen, rays that slip
    through it, and vessels it closes to a 5 Fr catheter.
    """
    vessels = {}
    for key, vessel in anatomy.tree.vessels.items():
        line = vessel.centreline
        own = line.arc_length >= vessel.ostium
        vessels[key] = {
            "parent": vessel.parent,
            "length_mm": round(line.length * 1e3, 1),
            "ostium_mm": round(vessel.ostium * 1e3, 1),
            "median_radius_mm": round(float(np.median(line.radii[own])) * 1e3, 2),
            "passable_mm": round(passable_length(vessel) * 1e3, 1),
        }
    goals = {}
    for key in anatomy.goals:
        route = anatomy.route(key)
        goals[key] = {
            "vessel": anatomy.goals[key].vessel,
            "route_mm": round(route.length * 1e3, 1),
            "narrowest_radius_mm": round(float(route.radii.min()) * 1e3, 2),
        }
    return {
        "name": anatomy.name,
        "wall_pieces": len(anatomy.wall),
        "wall": measure_wall(anatomy),
        "surface_triangles": len(anatomy.surface.faces),
        "volume_ml": round(anatomy.surface.volume * 1e6, 1),
        "inlet": {
            "vessel": anatomy.inlet.vessel,
            "position_mm": np.round(anatomy.inlet.position * 1e3, 1).tolist(),
            "radius_mm": round(float(anatomy.inlet.radius) * 1e3, 2),
        },
        "vessels": vessels,
        "goals": goals,
    }


def measure_wall(anatomy: Anatomy) -> dict[str, Any]:
    """Figures of the wall, JSON values in millimetres; see ``fidelity``."""

    def summary(values: fidelity.Distribution) -> dict[str, float]:
        return {
            key: round(getattr(values, key) * 1e3, 3) for key in ("mean", "p95", "max")
        }

    found = fidelity.intrusion(anatomy, SAMPLING)
    rays = fidelity.coverage(anatomy, RAYS)
    passage = fidelity.patency(anatomy, DEVICE_RADIUS, spacing=SAMPLING)
    return {
        "intrusion_mm": summary(found.inside),
        "recession_mm": summary(found.recession),
        "rays": rays.rays,
        "leaks": rays.leaks,
        "closed_to_5fr": list(passage.blocked),
    }


def passable_length(vessel: Vessel, radius: float = DEVICE_RADIUS) -> float:
    """Arc length (m) up to which a sphere of ``radius`` (m) fits a vessel."""
    line = vessel.centreline
    narrow = (line.radii < radius) & (line.arc_length > vessel.ostium)
    return float(line.arc_length[narrow.argmax()] if narrow.any() else line.length)


def _compact(vertices, faces) -> Surface:
    used, numbers = np.unique(faces, return_inverse=True)
    return Surface(vertices[used], numbers.reshape(-1, 3).astype(np.int32))


def _check_wall(wall: str, threshold: float | None) -> float:
    """CoACD's threshold (m), before an import takes its time to no avail."""
    if wall not in WALLS:
        raise ValueError(f"wall is {wall!r}; give one of {', '.join(WALLS)}.")
    if wall == "coacd":
        coacd_wall.load_coacd()
    elif threshold is not None:
        raise ValueError("a threshold is for wall='coacd' only; leave it out.")
    return coacd_wall.check_threshold(
        coacd_wall.THRESHOLD if threshold is None else threshold
    )


def _read_curves(paths, units, frame, root) -> list[Curve]:
    if isinstance(paths, str | Path) or len(paths) == 0:
        raise ValueError(
            f"centreline_paths is {paths!r}; give a list of at least one file, one per "
            "branch (3D Slicer .mrk.json or .csv)."
        )
    curves = [read_curve(path, units, frame) for path in paths]
    names = [curve.name for curve in curves]
    for curve in curves:
        if names.count(curve.name) > 1 or curve.name == root:
            raise ValueError(
                f"{curve.path} gives the vessel name {curve.name!r}, which is taken "
                f"(names: {root}, {', '.join(names)}); rename the file."
            )
    return curves


def _inside_part(curve: Curve, measure: MeshDepth, units: str) -> np.ndarray:
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


def _place_inlet(tree: VesselTree, at_end: bool) -> tuple[VesselTree, Inlet]:
    """Start the root where the lumen has its width, and look along it there."""
    root = tree.root
    line = root.centreline
    start = 0.0
    if at_end:
        near = line.arc_length <= min(INLET_SEARCH, 0.3 * line.length)
        wide = INLET_WIDTH * np.median(line.radii[near])
        first = int((line.radii >= wide).argmax())
        # One radius more, because a vessel's end may be cut off at a slant.
        start = float(line.arc_length[first] + line.radii[first])
    if start > 0.0:
        line = line.slice(start, line.length)
    place = line.at(0.0)
    ahead = line.at(min(3.0 * float(place.radius), 0.5 * line.length)).position
    opening = Inlet(root.name, place.position, ahead - place.position, place.radius)
    vessels = dict(tree.vessels)
    vessels[root.name] = Vessel(root.name, line)
    return VesselTree(vessels), opening


def _goals(tree: VesselTree, root: str) -> dict[str, Goal]:
    goals = {}
    for key, vessel in tree.vessels.items():
        if key == root:
            continue
        reach = passable_length(vessel) - vessel.ostium
        first = vessel.ostium + min(GOAL_PAST_OSTIUM, 0.5 * reach)
        places = {key: first}
        if GOAL_DISTAL * reach > 1.3 * (first - vessel.ostium):
            places[f"{key}_distal"] = vessel.ostium + GOAL_DISTAL * reach
        for name, s in places.items():
            goals[name] = Goal(name, key, vessel.centreline.at(s).position, float(s))
    return goals


def _ends(tree: VesselTree, opening: Inlet) -> tuple[End, ...]:
    ends = [
        End(opening.vessel, opening.position, -opening.direction, opening.radius, True)
    ]
    for key, vessel in tree.vessels.items():
        length = vessel.centreline.length
        branches = [k for k, v in tree.vessels.items() if v.parent == key]
        if any(tree.origin(k) > length - 1e-6 for k in branches):
            continue  # goes on in its branches
        place = vessel.centreline.at(length)
        ends.append(End(key, place.position, place.tangent, float(place.radius), False))
    return tuple(ends)


def _summary(tree: VesselTree) -> list[str]:
    return [
        f"{key} {vessel.centreline.length * 1e3:.0f} mm"
        + (f" from {vessel.parent}" if vessel.parent else "")
        for key, vessel in tree.vessels.items()
    ]
