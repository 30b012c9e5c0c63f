"""A patient's lumen, from a segmented scan to an anatomy ready for simulation."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.parts import Inlet, Surface
from cathsim_dmc.anatomy.scan import extract
from cathsim_dmc.anatomy.scan.aorta import mirrored, unproven
from cathsim_dmc.anatomy.scan.arches import SURE, Arch
from cathsim_dmc.anatomy.scan.check import check_tree, unreachable
from cathsim_dmc.anatomy.scan.curves import inside_part, read_curves
from cathsim_dmc.anatomy.scan.extract import DEVICE_RADIUS, listed
from cathsim_dmc.anatomy.scan.lumen import read_lumen
from cathsim_dmc.anatomy.scan.naming import VESSEL_NAME, Naming, neutral_names, renamed
from cathsim_dmc.anatomy.scan.places import (
    cut_open,
    flat_ends,
    place_goals,
    place_inlet,
)
from cathsim_dmc.anatomy.scan.tree import grow_tree, name_trunk
from cathsim_dmc.anatomy.scan.units import file_frame, shown, to_lps, upright
from cathsim_dmc.anatomy.scan.ways import Ways
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

NEAR_INLET = 15e-3  # m, distance from the lumen of an inlet that is pointed at
SHARES = (1.0, 0.6, 0.3)  # of a blind end that are tried to be cut off at the inlet


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
        units: of the mesh, of tables and of ``inlet``: "mm", "cm", "m" or "um";
            None guesses by the width of the lumen and the size, and says so.
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
    started = time.monotonic()
    notes = [] if notes is None else notes
    say = progress or (lambda text: None)

    def note(*texts: str) -> None:
        notes.extend(texts)
        for text in texts:
            say(f"note: {text}")

    given = {
        key: np.array(bounds.vector(key, place, 3))
        for key, place in {"inlet": inlet, "heart": heart}.items()
        if place is not None
    }
    changes = bounds.options("rename", rename)
    if not all(VESSEL_NAME.fullmatch(str(wanted)) for wanted in changes.values()):
        bounds.refuse("rename", rename, "names of small letters, digits and '_'")
    # Refused before the long steps; read again when the unit is known.
    read_curves(centreline_paths, units or "mm", mesh_frame, axes)
    lumen = read_lumen(mesh_path, units, mesh_frame, axes, labels, say)
    notes.extend(lumen.notes)
    measure = SurfaceDepth(lumen.surface)
    matrix = to_lps(lumen.units, mesh_frame, axes)
    curves = read_curves(centreline_paths, lumen.units, mesh_frame, axes)
    say(f"tree: looking for vessels in {len(lumen.surface.faces):,} triangles")
    with file_frame(matrix, lumen.units):
        middle = shown(lumen.surface.vertices.mean(axis=0))
        places = {k: _placed(k, matrix @ x, measure, middle) for k, x in given.items()}
        curves = {key: inside_part(key, c, measure) for key, c in curves.items()}
        grown = _tree(measure, curves, places, changes, note)
        turn = None if axes is None else upright(axes)
        note(*filter(None, [unproven(grown[0], turn)]))
        name = name or Path(mesh_path).name.split(".")[0]
        anatomy = _anatomy(name, *_opened(*grown, lumen.surface), say, note)
    seconds = time.monotonic() - started
    say(f"done in {seconds:.0f} s, goals {', '.join(anatomy.goals) or 'none'}")
    return anatomy


def _anatomy(name, tree, opening, surface, say, note) -> Anatomy:
    """The anatomy of a tree, proved against its surface; notes goals left out."""
    sizes = [
        f"{key} {vessel.centreline.length * 1e3:.0f} mm"
        + (f" from {vessel.parent}" if vessel.parent else "")
        for key, vessel in tree.vessels.items()
    ]
    say(f"tree: {', '.join(sizes)}")
    ends = flat_ends(tree, opening)
    anatomy = Anatomy(name, tree, opening, place_goals(tree), ends, surface)
    for where, missed in unreachable(anatomy).items():
        note(
            f"{where}, where a device starts: {', '.join(missed)} left out of the "
            "goals; choose another inlet (--inlet) to reach them"
        )
        goals = {k: goal for k, goal in anatomy.goals.items() if k not in missed}
        anatomy = replace(anatomy, goals=goals)
    for check, wrong in check_tree(anatomy).items():
        if wrong:
            raise ValueError(
                f"the tree does not agree with the surface ({check}): {wrong}. Mend "
                "the surface or the centrelines there, or give its frame (mesh_frame, "
                "axes), the inlet, other names, or other centrelines."
            )
    return anatomy


def _tree(field, curves, places, changes, note) -> tuple[VesselTree, bool]:
    """The tree of given curves, or of computed ones; whether it starts at an end."""
    ways = Ways(field)
    ends, right, drawn = extract.free_ends(ways), frozenset(), bool(curves)
    entry = extract.plan_inlet(ways, ends, list(curves.values()), places.get("inlet"))
    if not drawn:
        entry, curves, right = _computed(ways, ends, entry, places, changes, note)
    elif changes or "heart" in places:
        raise ValueError(
            "rename and heart are for computed centrelines; with drawn ones rename the "
            "files, and give the inlet."
        )
    else:
        curves, added = extract.continued(ways, ends, curves, entry)
        for key, length in added.items():
            note(
                f"centreline {key!r} stops {length * 1e3:.0f} mm before its vessel "
                "ends; continued to the end"
            )
    tree = grow_tree(field, ways, curves, entry.position, entry.far, drawn)
    return name_trunk(tree, right), entry.at_end


def _computed(ways, ends, entry, places, changes, note):
    """Entry, computed curves by name, and names of the right branches."""
    seen, end = Arch.of(ways, ends, places.get("heart")), ""
    arch = None if isinstance(seen, str) else seen
    if arch is None:
        note(f"no aortic arch recognised, so branches get no anatomical names: {seen}")
        end = ", the widest end, which may be that at the heart"
    else:
        if arch.entry.position is arch.ends[1].position:
            end = ", at the heart: the descending aorta is cut off beside a branch"
        entry = arch.entered(places.get("inlet"), entry)
        wrong = mirrored(arch.bend.azimuth(heart_last=True))
        if wrong and arch.heart >= SURE:
            raise ValueError(wrong)
    known = arch.found if arch is not None and entry is arch.entry else None
    found, thin = known or extract.centrelines(ways, ends, entry)
    if not found:
        raise ValueError(
            "no branch of the lumen lets a 5 Fr catheter "
            f"({DEVICE_RADIUS * 2e3:.2f} mm) in for 15 mm, so there is no goal; its "
            f"ends are {listed(ends)}."
        )
    if arch is None:
        names, notes, right = Naming(neutral_names(found))
    else:
        names, notes, right = arch.named(found, entry.far)
    note(*notes)
    computed, names = names, renamed(names, changes)
    curves = dict(zip(names, found, strict=True))
    for old, new in zip(computed, names, strict=True):
        if old != new:
            note(f"{old}, which ends at {shown(curves[new][-1])}, is renamed {new}")
    nameless = [
        f"{key} (ends at {shown(curve[-1])})"
        for key, curve in curves.items()
        if key.startswith("branch_")
    ]
    if nameless:
        note(
            f"geometry gives no anatomical name to {', '.join(nameless)}; rename "
            "(--rename) does"
        )
    if thin:
        note(f"{thin} branches too thin or short for a 5 Fr catheter left out")
    end = f"{end} (--inlet takes another)" if end and "inlet" not in places else ""
    note(f"inlet chosen at {shown(entry.position)}{end}")
    return entry, curves, frozenset(names[row] for row in right)


def _opened(
    tree: VesselTree, at_end: bool, surface: Surface
) -> tuple[VesselTree, Inlet, Surface]:
    """The tree from its inlet on, the inlet, and the surface cut off there."""
    # Less is cut off where the plane of the inlet would meet a branch.
    for share in SHARES if at_end else SHARES[:1]:
        opened, inlet = place_inlet(tree, at_end, share)
        last = not at_end or share == SHARES[-1]
        try:
            points, shell, cap = cut_open(surface.vertices, surface.faces, inlet)
        except ValueError:
            if last:
                raise
            continue
        used, numbers = np.unique(np.concatenate([shell, cap]), return_inverse=True)
        cut = Surface(points[used], numbers.reshape(-1, 3))
        tips = [vessel.centreline.points[-1] for vessel in opened.vessels.values()]
        if last or (SurfaceDepth(cut)(np.array(tips)) > 0.0).all():
            break
    return opened, inlet, cut


def _placed(
    key: str, place: np.ndarray, measure: SurfaceDepth, middle: str
) -> np.ndarray:
    """A given place (3,) m, LPS, which must be near the lumen."""
    away = -float(measure(place[None])[0])
    if away > NEAR_INLET:
        raise ValueError(
            f"{key} {shown(place)} is {away * 1e3:.1f} mm away from the lumen, whose "
            f"middle is {middle}; give a point in the lumen, or at most "
            f"{NEAR_INLET * 1e3:g} mm from the end "
            f"{'at the heart' if key == 'heart' else 'by which the device enters'}, in "
            "the unit and frame of the mesh (units, mesh_frame)."
        )
    return place
