"""Import of a patient's lumen: from a segmented scan to an anatomy."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.parts import FileFrame, Inlet, Surface
from cathsim_dmc.anatomy.reach import unreachable
from cathsim_dmc.anatomy.scan import extract, naming
from cathsim_dmc.anatomy.scan.aorta import bend_of, unproven
from cathsim_dmc.anatomy.scan.arches import Arch
from cathsim_dmc.anatomy.scan.check import check_tree
from cathsim_dmc.anatomy.scan.curves import inside_part, read_curves
from cathsim_dmc.anatomy.scan.ends import free_ends
from cathsim_dmc.anatomy.scan.extract import listed
from cathsim_dmc.anatomy.scan.left_out import left_out, said
from cathsim_dmc.anatomy.scan.lumen import Lumen, read_lumen
from cathsim_dmc.anatomy.scan.mesh import stem
from cathsim_dmc.anatomy.scan.naming import ROOT, TRUNK, VESSEL_NAME, Naming
from cathsim_dmc.anatomy.scan.places import (
    flat_ends,
    opened_at_inlet,
    place_goals,
    resized,
)
from cathsim_dmc.anatomy.scan.tree import grow_tree, name_trunk, with_root
from cathsim_dmc.anatomy.scan.units import file_frame, mm, shown, to_lps, upright
from cathsim_dmc.anatomy.scan.ways import DEVICE_RADIUS, Ways
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

NEAR_INLET = 15e-3  # m, distance from the lumen of an inlet that is pointed at


class Calibre(Protocol):
    """What an import needs of a device, such as an `entities.device.Device`."""

    @property
    def name(self) -> str:
        """Name of the device, for messages."""
        ...

    @property
    def outer_radius(self) -> float:
        """Outer radius, m."""
        ...


class _Bore(NamedTuple):
    name: str
    outer_radius: float


USUAL = _Bore("5 Fr catheter", DEVICE_RADIUS)
# Thinnest device of the library (`entities.devices`), where USUAL does not pass.
THINNEST = _Bore("0.014 inch wire (wire_014_micro)", 0.1778e-3)


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
        mesh_path: lumen surface (OBJ, STL, PLY or VTP); vessel ends open or capped.
            Or a label map (NIfTI, NRRD), whose unit and frame are its own.
        centreline_paths: 3D Slicer markups or tables x,y,z[,radius], one per branch;
            the branch is called after the file (centreline-LCCA.mrk.json: "lcca").
            Without any they are computed, and named where the arch tells how.
        units: of the mesh, of tables and of ``inlet``: "mm", "cm", "m", "um" or
            "inch"; None takes that of a label map's header, or guesses by the width
            of the lumen and the size, and says so.
        mesh_frame: "LPS" or "RAS", of the mesh, of tables and of ``inlet``; None is
            what the mesh's file says (3D Slicer's do), else LPS.
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
    told = _Told([] if notes is None else notes, progress or (lambda text: None))
    given, changes = _checked(inlet, heart, rename, device)
    # Invalid curves are refused before the long steps, and read again with the unit.
    first = "LPS" if mesh_frame is None else mesh_frame
    read_curves(centreline_paths, units or "mm", first, axes)
    lumen = read_lumen(mesh_path, units, mesh_frame, axes, labels, told.say)
    told.notes.extend(lumen.notes)
    frame = FileFrame(lumen.units, to_lps(lumen.units, lumen.frame, axes))
    curves = read_curves(centreline_paths, lumen.units, lumen.frame, axes)
    wishes = _Wishes(given, curves, changes, device, axes)
    parts, bore = _grown(lumen, frame, wishes, told)
    anatomy = _anatomy(name or stem(mesh_path), parts, bore, told)
    told.say(
        f"done in {time.monotonic() - started:.0f} s, "
        f"goals {', '.join(anatomy.goals) or 'none'}"
    )
    return anatomy


class _Told(NamedTuple):
    """Receiver of the progress and the notes of an import."""

    notes: list[str]
    say: Callable[[str], None]

    def note(self, text: str) -> None:
        """Reports a note on a guess, a repair or an omission, and keeps it."""
        self.notes.append(text)
        self.say(f"note: {text}")


class _Wishes(NamedTuple):
    """Input of the user: places in the file's frame, curves, names, device, axes."""

    places: dict[str, np.ndarray]
    curves: dict[str, np.ndarray]
    changes: Mapping[str, str]
    device: Calibre | None
    axes: str | ArrayLike | None


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
        bounds.number("device radius", device.outer_radius, positive=True)
    return given, changes


def _grown(
    lumen: Lumen, frame: FileFrame, wishes: _Wishes, told: _Told
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
        grown = _Growth(measure, scale, wishes, places, told.note)
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


class _Growth:
    """Growth of the tree of an enlarged lumen, and choice of the device that passes."""

    def __init__(self, field, scale, wishes, places, note):
        self._field, self._scale, self._note = field, scale, note
        self._places, self._changes = places, wishes.changes
        self._certain = wishes.axes is not None and "heart" in places
        self.device, self._given = wishes.device or USUAL, wishes.device is not None
        self._ways = Ways(field, scale * self.device.outer_radius)
        self._ends = free_ends(self._ways)

    def tree(self, curves) -> tuple[VesselTree, bool, bool]:
        """The tree of drawn curves, or of computed ones if there are none.

        Also whether it starts at an end of the lumen, and whether it is an arch.
        """
        ways, ends, drawn = self._ways, self._ends, bool(curves)
        inlet = self._places.get("inlet")
        entry = extract.plan_inlet(ways, ends, list(curves.values()), inlet)
        self._choose_device(entry)
        root, right, arch = ROOT, frozenset(), True
        if not drawn:
            entry, curves, right, root, arch = self._computed(entry)
        elif "heart" in self._places:
            raise ValueError(
                "heart is for computed centrelines; with drawn ones give the inlet."
            )
        else:
            curves = self._relabelled(curves)
            curves, added = extract.continued(ways, ends, curves, entry)
            for key, length in added.items():
                self._note(
                    f"centreline {key!r} stops {mm(length):.0f} mm before its vessel "
                    "ends; continued to the end"
                )
        tree = grow_tree(self._field, ways, curves, entry.position, entry.far, drawn)
        tree = name_trunk(tree, right)
        if drawn:
            arch = bend_of(tree) is not None or bool({*naming.BRANCHES} & set(curves))
            root = ROOT if arch else TRUNK
            tree = with_root(tree, self._changes.get(root, root))
        elif root != ROOT:
            tree = with_root(tree, root)
        missed = left_out(ways, tree)
        text = said(missed, self.device.name, ways.device, drawn=drawn)
        if text is not None:
            self._note(text)
        return tree, entry.at_end, arch

    def _relabelled(self, curves) -> dict[str, np.ndarray]:
        """Drawn curves by the user's names; the root is renamed later."""
        names = naming.renamed([ROOT, TRUNK, *curves], self._changes)[2:]
        for old, new in zip(curves, names, strict=True):
            if old != new:
                self._note(f"{old} is renamed {new}")
        return dict(zip(names, curves.values(), strict=True))

    def _choose_device(self, entry) -> None:
        """Chooses the thinnest device if the usual one passes less than half of it."""
        ways, ends = self._ways, self._ends
        if self._given or extract.fits(ways, ends, entry):
            return
        ways.device = self._scale * THINNEST.outer_radius
        usual, self.device = self.device, THINNEST
        self._note(
            f"a {usual.name} ({2e3 * usual.outer_radius:.2f} mm) passes less than half "
            f"of the vessels: the tree is that of a {self.device.name} (--device "
            "chooses another)"
        )

    def _computed(self, entry):
        """Entry, curves by name, names of right branches and root, whether an arch."""
        ways, ends, places, note = self._ways, self._ends, self._places, self._note
        seen, end = Arch.of(ways, ends, places.get("heart")), ""
        arch = None if isinstance(seen, str) else seen
        if arch is None:
            note(
                f"no aortic arch recognised, so vessels get no anatomical names: {seen}"
            )
            end = ", the widest end"
            if entry.sacs:
                sacs = ", ".join(
                    f"{shown(sac.position)}, {mm(2.0 * sac.bottleneck):.1f} mm wide"
                    for sac in entry.sacs
                )
                end += f" that is no aneurysm's, as is that at {sacs}"
        else:
            if arch.entry.position is arch.ends[1].position:
                end = ", at the heart: the descending aorta is cut off beside a branch"
            arch = arch.on_its_side(self._certain)
            entry = arch.entered(places.get("inlet"), entry)
        known = arch.found if arch is not None and entry is arch.entry else None
        if known is None:
            known = extract.centrelines(ways, ends, entry, rooted=arch is not None)
        if not known and (arch is None or entry.far is None):
            raise ValueError(
                f"no branch of the lumen lets a {self.device.name} "
                f"({2e3 * self.device.outer_radius:.2f} mm) in for "
                f"{mm(extract.BRANCH):.2g} mm, so there is no goal; its ends are "
                f"{listed(ends)}. Choose a thinner device (--device)."
            )
        if arch is None:
            far, known = extract.trunk(ways, known)
            entry = entry._replace(far=far)
            names, notes, right = Naming(naming.neutral_names(known))
        else:
            names, notes, right = arch.named(known, entry.far)
        for text in notes:
            note(text)
        root, *names = self._renamed([TRUNK if arch is None else ROOT, *names], known)
        end = f"{end} (--inlet takes another)" if end and "inlet" not in places else ""
        note(f"inlet chosen at {shown(entry.position)}{end}")
        curves = dict(zip(names, known, strict=True))
        return entry, curves, frozenset(names[row] for row in right), root, bool(arch)

    def _renamed(self, computed, found) -> list[str]:
        """Names of root and curves after the user's changes; notes unnamed curves."""
        names = naming.renamed(computed, self._changes)
        curves = dict(zip(names[1:], found, strict=True))
        for old, new in zip(computed, names, strict=True):
            if old != new:
                which = (
                    f", which ends at {shown(curves[new][-1])},"
                    if new in curves
                    else ""
                )
                self._note(f"{old}{which} is renamed {new}")
        nameless = [
            f"{key} (ends at {shown(curve[-1])})"
            for key, curve in curves.items()
            if key.startswith("branch_")
        ]
        if nameless:
            self._note(
                f"geometry gives no anatomical name to {', '.join(nameless)}; rename "
                "(--rename) does"
            )
        return names


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
            "the unit and frame of the mesh (units, mesh_frame)."
        )
    return place
