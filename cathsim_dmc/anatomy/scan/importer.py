"""A patient's lumen, from a segmented scan to an anatomy ready for simulation."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.parts import Inlet, Surface
from cathsim_dmc.anatomy.scan.arches import Arch
from cathsim_dmc.anatomy.scan.check import check_tree
from cathsim_dmc.anatomy.scan.curves import ScanCentreline, check_inside, read_curve
from cathsim_dmc.anatomy.scan.ends import (
    FreeEnd,
    LumenEntry,
    free_ends,
    listed,
    plan_inlet,
)
from cathsim_dmc.anatomy.scan.extract import DEVICE_RADIUS, centrelines, continued
from cathsim_dmc.anatomy.scan.inlet import cut_open
from cathsim_dmc.anatomy.scan.lumen import read_lumen
from cathsim_dmc.anatomy.scan.naming import neutral_names, renamed
from cathsim_dmc.anatomy.scan.places import flat_ends, place_goals, place_inlet
from cathsim_dmc.anatomy.scan.tree import grow_tree
from cathsim_dmc.anatomy.scan.trunk import name_trunk
from cathsim_dmc.anatomy.scan.units import frame_sign, in_mm, metres_per, upright
from cathsim_dmc.anatomy.scan.ways import Ways
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

_log = logging.getLogger(__name__)

ROOT = "aorta"
FRAMES = ("LPS", "RAS")
NEAR_INLET = 15e-3  # m, distance from the lumen of an inlet that is pointed at
SHARES = (1.0, 0.6, 0.3)  # of a blind end that are tried to be cut off at the inlet
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
    axes: str | ArrayLike | None = None,
    labels: Sequence[int] = (),
    name: str | None = None,
    inlet: Sequence[float] | None = None,
    heart: Sequence[float] | None = None,
    root: str = ROOT,
    rename: Mapping[str, str] | None = None,
    progress: Callable[[str], None] | None = None,
    notes: list[str] | None = None,
) -> Anatomy:
    """Turn the surface of a lumen into an anatomy.

    Args:
        mesh_path: lumen surface (OBJ, STL, PLY or VTP); vessel ends open or capped.
            Or a label map (NIfTI, NRRD), whose unit and frame are its own.
        centreline_paths: 3D Slicer markups or tables x,y,z[,radius], one per branch;
            the branch is called after the file (centreline-LCCA.mrk.json: "lcca").
            Without any they are computed, and named where the arch tells how.
        units: of the mesh, of tables and of ``inlet``: "mm", "cm" or "m"; None
            guesses by the width of the lumen, and says so.
        mesh_frame: "LPS" or "RAS", of the mesh, of tables and of ``inlet``.
        axes: how that frame is turned in the patient, if the scan does not stand
            upright, such as "ILA", or nine numbers; see ``units.upright``.
        labels: of a label map, the values that are the lumen.
        name: of the anatomy, by default the mesh file's.
        inlet: (x, y, z) where the device enters: a free end if one is near, else the
            lumen is cut there. By default the end at which the centrelines start,
            else the wide end farthest from their starts or from the widest end.
        heart: (x, y, z) near the end of the aorta that is at the heart; None finds it
            by width and length of both legs, their sides and their branches.
        root: name of the vessel that starts at the inlet.
        rename: new names of computed vessels by their computed names.
        progress: called with a line for every step: its name or "note", then text.
        notes: list to which what was guessed, mended and left out is added.

    Returns:
        The anatomy, in metres, LPS. Radii are those of the lumen's sections
        along centrelines that were moved to its middle; see `centring.section_radii`.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file or an option is not as stated, or the tree that results
            does not agree with the surface; says how to mend it.
    """
    log = _Log(progress, notes)
    frame = _Frame(units, mesh_frame, axes)
    points = {"inlet": _point("inlet", inlet), "heart": _point("heart", heart)}
    _check_rename(rename)
    _check_paths(centreline_paths, frame)
    lumen = read_lumen(mesh_path, units, mesh_frame, axes, labels, log.say)
    log.note(*lumen.notes)
    frame = replace(frame, units=lumen.units)
    measure = SurfaceDepth(lumen.surface)
    places = {k: _placed(k, point, frame, measure) for k, point in points.items()}
    lines = _read_curves(centreline_paths, frame, root, measure)
    log.say(f"tree: looking for vessels in {len(lumen.surface.faces):,} triangles")
    grown, at_end = _tree(measure, lines, places, root, rename or {}, log.note)
    tree, opening, surface = _opened(grown, at_end, lumen.surface)
    log.say(f"tree: {', '.join(_summary(tree))}")
    name, goals = name or Path(mesh_path).name.split(".")[0], place_goals(tree, root)
    ends = flat_ends(tree, opening)
    anatomy = Anatomy(name, tree, surface, opening, goals, ends, scanned=True)
    _prove(anatomy, _MEND_DRAWN if lines else _MEND_COMPUTED, log.note)
    log.say(f"done in {log.seconds:.0f} s, goals {', '.join(goals) or 'none'}")
    return anatomy


class _Log:
    """Lines of text about the steps, and what was guessed, mended and left out."""

    def __init__(self, progress: Callable[[str], None] | None, notes: list[str] | None):
        self._progress, self._notes = progress, notes
        self._started = time.monotonic()

    def say(self, text: str) -> None:
        _log.info(text)
        if self._progress is not None:
            self._progress(text)

    def note(self, *texts: str) -> None:
        for text in texts:
            if self._notes is not None:
                self._notes.append(text)
            self.say(f"note: {text}")

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._started


@dataclass(frozen=True)
class _Frame:
    """Unit, frame and axes of a scan, checked."""

    units: str | None
    frame: str
    axes: str | ArrayLike | None

    def __post_init__(self):
        bounds.choice("mesh_frame", self.frame, FRAMES)
        upright(self.axes)
        if self.units is not None:
            metres_per(self.units)

    def to_lps(self, point: np.ndarray) -> np.ndarray:
        """A point (3,) of the scan in m, LPS."""
        assert self.units is not None
        factor = frame_sign(self.frame) * metres_per(self.units)
        return upright(self.axes) @ (point * factor)


def _point(key: str, given: Sequence[float] | None) -> np.ndarray | None:
    if given is None:
        return None
    return np.array(bounds.vector(key, given, 3, unit="the mesh's unit"))


def _tree(field, lines, places, root, rename, note) -> tuple[VesselTree, bool]:
    """The tree of given lines, or of computed ones; whether it starts at an end."""
    ways = Ways(field)
    for pinch in ways.pinches:
        note(f"the lumen is pinched to a slit at {in_mm(pinch)}; vessels go on beyond")
    ends = free_ends(ways)
    lines = {key: _proximal_first(line, field) for key, line in lines.items()}
    entry = plan_inlet(ways, ends, list(lines.values()), places["inlet"])
    drawn, right = bool(lines), frozenset()
    if drawn:
        if rename or places["heart"] is not None:
            raise ValueError(
                "rename and heart are for computed centrelines; with drawn ones rename "
                "the files, and give the inlet."
            )
        lines, added = continued(ways, ends, lines, entry)
        for key, length in added.items():
            note(
                f"centreline {key!r} stops {length * 1e3:.0f} mm before its vessel "
                "ends; continued to the end"
            )
    else:
        arch = Arch.of(ways, ends, places["heart"])
        if arch is not None:
            entry = arch.entry(places["inlet"], entry)
            if (wrong := arch.wrong_side()) is not None:
                raise ValueError(wrong)
        lines, right = _computed(ways, ends, entry, arch, root, rename, note)
    tree = grow_tree(field, ways, lines, entry.position, entry.far, root, drawn)
    return name_trunk(tree, right), entry.at_end


def _computed(
    ways: Ways,
    ends: Sequence[FreeEnd],
    entry: LumenEntry,
    arch: Arch | None,
    root: str,
    rename: Mapping[str, str],
    note: Callable[[str], None],
) -> tuple[dict[str, np.ndarray], frozenset[str]]:
    """Computed curves by name, and those of the brachiocephalic artery."""
    if arch is None:
        found, thin = centrelines(ways, ends, entry)
    else:
        found, thin = arch.centrelines(ends, entry)
    if not found:
        raise ValueError(
            "no branch of the lumen lets a 5 Fr catheter "
            f"({DEVICE_RADIUS * 2e3:.2f} mm) in for 15 mm, so there is no goal; its "
            f"ends are {listed(ends)}."
        )
    curves = [f.points for f in found]
    names, right = neutral_names(curves), ()
    if arch is not None:
        named = arch.named(curves)
        names, right = named.names, named.right
        for text in named.notes:
            note(text)
    names = renamed(names, rename, root)
    open_names = [key for key in names if key.startswith("branch_")]
    if open_names:
        places = ", ".join(
            f"{key} (ends at {in_mm(f.tip)})"
            for key, f in zip(names, found, strict=True)
            if key in open_names
        )
        note(f"geometry gives no anatomical name to {places}; rename (--rename) does")
    if thin:
        note(f"{thin} branches too thin or short for a 5 Fr catheter left out")
    note(f"inlet chosen at {in_mm(entry.position)}")
    lines = {key: f.points for key, f in zip(names, found, strict=True)}
    return lines, frozenset(names[row] for row in right)


def _prove(anatomy: Anatomy, mend: str, note: Callable[[str], None]) -> None:
    """Checks the tree against the surface; notes what a user may accept."""
    for check in check_tree(anatomy):
        if check.passed:
            continue
        if check.name == "start of the device" or not anatomy.goals:
            note(f"{check.name}: {check.detail}")
            continue
        raise ValueError(
            f"the tree does not agree with the surface ({check.name}): {check.detail}. "
            + mend
        )


def _opened(
    tree: VesselTree, at_end: bool, surface: Surface
) -> tuple[VesselTree, Inlet, Surface]:
    """The tree from its inlet on, the inlet, and the surface cut off there.

    Less is cut off where the plane of the inlet would meet a branch.
    """
    for share in SHARES:
        opened, inlet = place_inlet(tree, at_end, share)
        try:
            cut = _cut(surface, inlet)
        except ValueError:
            if share == SHARES[-1] or not at_end:
                raise
            continue
        tips = [vessel.centreline.points[-1] for vessel in opened.vessels.values()]
        if not at_end or (SurfaceDepth(cut)(np.array(tips)) > 0.0).all():
            break
    return opened, inlet, cut


def _cut(surface: Surface, opening: Inlet) -> Surface:
    """What of a closed surface lies ahead of the inlet, with a flat cap there."""
    vertices, shell, cap = cut_open(surface.vertices, surface.faces, opening)
    used, numbers = np.unique(np.concatenate([shell, cap]), return_inverse=True)
    return Surface(vertices[used], numbers.reshape(-1, 3))


def _placed(
    key: str, point: np.ndarray | None, frame: _Frame, measure: SurfaceDepth
) -> np.ndarray | None:
    """A given point (3,) in m, LPS, which must be near the lumen."""
    if point is None:
        return None
    place = frame.to_lps(point)
    away = -float(measure(place[None])[0])
    if away > NEAR_INLET:
        raise ValueError(
            f"{key} is {away * 1e3:.1f} mm away from the lumen; give a point in the "
            f"lumen, or at most {NEAR_INLET * 1e3:g} mm from the end "
            f"{'at the heart' if key == 'heart' else 'by which the device enters'}."
        )
    return place


def _check_rename(rename: Mapping[str, str] | None) -> None:
    if rename is None:
        return
    if not isinstance(rename, Mapping) or not all(
        isinstance(word, str) for pair in rename.items() for word in pair
    ):
        bounds.refuse("rename", rename, "a mapping of computed names to wanted ones")


def _check_paths(paths: Sequence[str | Path], frame: _Frame) -> None:
    listed = isinstance(paths, Sequence) and not isinstance(paths, str | bytes)
    if not listed or not all(isinstance(path, str | Path) for path in paths):
        raise ValueError(
            f"centreline_paths is {paths!r}; give a list of files, one per branch (3D "
            "Slicer .mrk.json or .csv), or none to have them computed."
        )
    for path in paths:
        read_curve(path, frame.units or "mm", frame.frame)  # before the long steps


def _read_curves(paths, frame: _Frame, root: str, measure) -> dict[str, np.ndarray]:
    """The part (n, 3) m, LPS, of each drawn curve that lies in the lumen, by name."""
    curves = [read_curve(path, frame.units or "mm", frame.frame) for path in paths]
    turn = upright(frame.axes)
    curves = [replace(curve, points=curve.points @ turn.T) for curve in curves]
    names = [curve.name for curve in curves]
    for curve in curves:
        if names.count(curve.name) > 1 or curve.name == root:
            raise ValueError(
                f"{curve.path} gives the vessel name {curve.name!r}, which is taken "
                f"(names: {root}, {', '.join(names)}); rename the file."
            )
    units = str(frame.units)
    return {curve.name: _inside_part(curve, measure, units) for curve in curves}


def _inside_part(
    curve: ScanCentreline, measure: SurfaceDepth, units: str
) -> np.ndarray:
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
    return curve.points[keep]


def _proximal_first(line: np.ndarray, field: SurfaceDepth) -> np.ndarray:
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
