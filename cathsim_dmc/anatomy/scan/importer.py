"""Import of a patient's lumen: from a segmented scan to an anatomy."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds, files
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.parts import FileFrame, Inlet, Surface
from cathsim_dmc.anatomy.reach import unreachable
from cathsim_dmc.anatomy.scan.aorta import unproven
from cathsim_dmc.anatomy.scan.check import check_tree
from cathsim_dmc.anatomy.scan.curves import inside_part, read_curves
from cathsim_dmc.anatomy.scan.growth import Calibre, Growth, Wishes
from cathsim_dmc.anatomy.scan.lumen import Lumen, read_lumen
from cathsim_dmc.anatomy.scan.mesh import stem
from cathsim_dmc.anatomy.scan.naming import VESSEL_NAME
from cathsim_dmc.anatomy.scan.places import (
    flat_ends,
    opened_at_inlet,
    place_goals,
    resized,
)
from cathsim_dmc.anatomy.scan.units import file_frame, mm, shown, to_lps, upright
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

NEAR_INLET = 15e-3  # m, distance from the lumen of an inlet that is pointed at


def import_scan(
    mesh_path: str | Path,
    centreline_paths: Sequence[str | Path] = (),
    *,
    units: str | None = None,
    mesh_frame: str | None = None,
    axes: str | ArrayLike | None = None,
    labels: Sequence[int] = (),
    name: str | None = None,
    inlet: Sequence[float] | None = None,
    heart: Sequence[float] | None = None,
    rename: Mapping[str, str] | None = None,
    device: Calibre | None = None,
    progress: Callable[[str], None] | None = None,
    notes: list[str] | None = None,
) -> Anatomy:
    """Turn the surface of a lumen into an anatomy.

    Args:
        mesh_path: lumen surface (OBJ, STL, PLY, VTP or VTK); vessel ends open or
            capped. Or a label map (NIfTI, NRRD, MHA), whose unit and frame are its own.
        centreline_paths: 3D Slicer markups or tables x,y,z[,radius], one per branch;
            the branch is called after the file (centreline-LCCA.mrk.json: "lcca").
            Without any they are computed, and named if the arch identifies them.
        units: of the mesh, of tables and of ``inlet``: "mm", "cm", "m", "um" or "inch";
            None takes that of a label map's header, or guesses by the width of the
            lumen and the size, with a note.
        mesh_frame: "LPS" or "RAS", of the mesh, of tables and of ``inlet``; None takes
            the frame that the mesh's file names (as 3D Slicer writes it), else LPS.
        axes: how that frame is turned in the patient, if the scan does not stand
            upright, such as "ILA", or nine numbers; see ``units.upright``.
        labels: values of a label map that are the lumen.
        name: of the anatomy, by default the mesh file's.
        inlet: (x, y, z) where the device enters: a free end if one is near, else the
            lumen is cut there. By default the end at which the centrelines start,
            else the wide end farthest from their starts or from the widest end.
        heart: (x, y, z) near the end of the aorta that is at the heart; None finds it
            by width and length of both legs, their sides and their branches.
        rename: new names of vessels by their computed names.
        device: device that must pass, such as one of `entities.devices.DEVICES`; it
            decides which vessels are in the tree. None for a 5 Fr catheter, or the
            thinnest device of the library where that does not pass most vessels.
        progress: called with a line for every step: its name or "note", then text.
        notes: list to which notes on guesses, repairs and omissions are added.

    Returns:
        The anatomy, in metres, LPS. Radii are those of the lumen's sections
        along centrelines that were moved to its middle; see `centring.section_radii`.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file or an option is not as stated, or the resulting tree does
            not agree with the surface; says how to mend it.
    """
    started = time.monotonic()
    mesh_path = files.as_path("mesh_path", mesh_path)
    told = _Told([] if notes is None else notes, progress or (lambda text: None))
    given, changes = _checked(inlet, heart, rename, device)
    name = bounds.text("name", name or stem(mesh_path))
    # Invalid curves are refused before the long steps, and read again with the unit.
    first = "LPS" if mesh_frame is None else mesh_frame
    read_curves(centreline_paths, units or "mm", first, axes)
    lumen = read_lumen(mesh_path, units, mesh_frame, axes, labels, told.say)
    told.notes.extend(lumen.notes)
    frame = FileFrame(lumen.units, to_lps(lumen.units, lumen.frame, axes))
    curves = read_curves(centreline_paths, lumen.units, lumen.frame, axes)
    wishes = Wishes(given, curves, changes, device, axes)
    parts, bore = _grown(lumen, frame, wishes, told)
    anatomy = _anatomy(name, parts, bore, told)
    goals = ", ".join(anatomy.goals) or "none"
    told.say(f"done in {time.monotonic() - started:.0f} s, goals {goals}")
    return anatomy


class _Told(NamedTuple):
    """Receiver of the progress and the notes of an import."""

    notes: list[str]
    say: Callable[[str], None]

    def note(self, text: str) -> None:
        """Reports a note on a guess, a repair or an omission, and keeps it."""
        self.notes.append(text)
        self.say(f"note: {text}")


class _Parts(NamedTuple):
    """A tree cut open at its inlet, and the frame of the file."""

    tree: VesselTree
    opening: Inlet
    surface: Surface
    frame: FileFrame
    scale: float  # by which it was enlarged to grow the tree


def _checked(
    inlet: Sequence[float] | None,
    heart: Sequence[float] | None,
    rename: Mapping[str, str] | None,
    device: Calibre | None,
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The given places (3,) and new names, checked; ValueError if one is invalid."""
    given = {
        key: np.array(bounds.vector(key, place, 3))
        for key, place in {"inlet": inlet, "heart": heart}.items()
        if place is not None
    }
    changes = bounds.options("rename", rename)
    if not all(VESSEL_NAME.fullmatch(str(wanted)) for wanted in changes.values()):
        bounds.refuse("rename", rename, "names of small letters, digits and '_'")
    if device is not None:
        if not (hasattr(device, "name") and hasattr(device, "outer_radius")):
            wanted = "a device, such as one of entities.devices.DEVICES, or None"
            bounds.refuse("device", device, wanted)
        bounds.number("device radius", device.outer_radius, positive=True)
    return given, changes


def _grown(
    lumen: Lumen, frame: FileFrame, wishes: Wishes, told: _Told
) -> tuple[_Parts, Calibre]:
    """The tree of a lumen, cut open, and the device that passes it."""
    # A small lumen is enlarged, so that the lengths of the import suit it.
    scale, surface, matrix = lumen.scale, lumen.surface, frame.to_lps
    if scale != 1.0:
        surface = Surface(scale * surface.vertices, surface.faces)
    measure = SurfaceDepth(surface)
    told.say(f"tree: looking for vessels in {len(surface.faces):,} triangles")
    with file_frame(matrix, lumen.units, scale):
        middle = shown(surface.vertices.mean(axis=0))
        places = {
            k: _placed(k, scale * (matrix @ x), measure, middle)
            for k, x in wishes.places.items()
        }
        curves = wishes.curves
        curves = {k: inside_part(k, scale * c, measure) for k, c in curves.items()}
        grown = Growth(measure, scale, wishes, places, told.note)
        tree, at_end, arch = grown.tree(curves)
        turn = None if wishes.axes is None else upright(wishes.axes)
        if arch and (doubt := unproven(tree, turn)):
            told.note(doubt)
        tree, opening, surface = opened_at_inlet(tree, at_end, surface)
        tree, opening, surface = resized(tree, opening, surface, 1.0 / scale)
    return _Parts(tree, opening, surface, frame, scale), grown.device


def _anatomy(name: str, parts: _Parts, bore: Calibre, told: _Told) -> Anatomy:
    """Anatomy of a tree, checked against its surface; notes goals left out."""
    with file_frame(parts.frame.to_lps, parts.frame.unit):
        tree = parts.tree
        sizes = [
            f"{key} {vessel.centreline.length * 1e3:.0f} mm"
            + (f" from {vessel.parent}" if vessel.parent else "")
            for key, vessel in tree.vessels.items()
        ]
        told.say(f"tree: {', '.join(sizes)}")
        ends = flat_ends(tree, parts.opening)
        goals = place_goals(tree, bore.outer_radius, parts.scale)
        anatomy = Anatomy(
            name, tree, parts.opening, goals, ends, parts.surface, parts.frame
        )
        for where, missed in unreachable(anatomy).items():
            told.note(
                f"{where}, where a device starts: {', '.join(missed)} left out of the "
                "goals; choose another inlet (--inlet) to reach them"
            )
            goals = {k: goal for k, goal in anatomy.goals.items() if k not in missed}
            anatomy = replace(anatomy, goals=goals)
        if not anatomy.goals:
            listing = ", ".join(shown(end.position) for end in ends[1:][:8])
            raise ValueError(
                f"no goal can be reached from the inlet {shown(ends[0].position)}: all "
                "branches leave beside it. Enter by another end of the lumen (inlet; "
                f"--inlet X Y Z), such as {listing}."
            )
        for check, wrong in check_tree(anatomy).items():
            if wrong:
                raise ValueError(
                    f"the tree does not agree with the surface ({check}): {wrong}. "
                    "Mend the surface or the centrelines there, or give its frame "
                    "(--frame, --axes), another inlet (--inlet X Y Z), other names or "
                    "other centrelines."
                )
    return anatomy


def _placed(
    key: str, place: np.ndarray, measure: SurfaceDepth, middle: str
) -> np.ndarray:
    """A given place (3,) m, LPS; ValueError if it is not near the lumen."""
    away = -float(measure(place[None])[0])
    if away > NEAR_INLET:
        raise ValueError(
            f"{key} {shown(place)} is {mm(away):.1f} mm away from the lumen, whose "
            f"middle is {middle}; give a point in the lumen, or at most "
            f"{mm(NEAR_INLET):.2g} mm from the end "
            f"{'at the heart' if key == 'heart' else 'by which the device enters'}, in "
            "the unit and frame of the mesh (units and mesh_frame, on the command line "
            "--units and --frame)."
        )
    return place
