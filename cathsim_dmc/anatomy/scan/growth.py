"""Growth of the vessel tree of an imported lumen, along drawn or computed curves."""

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.scan import extract, naming
from cathsim_dmc.anatomy.scan.aorta import bend_of
from cathsim_dmc.anatomy.scan.arches import Arch
from cathsim_dmc.anatomy.scan.ends import free_ends
from cathsim_dmc.anatomy.scan.extract import listed
from cathsim_dmc.anatomy.scan.left_out import left_out, said
from cathsim_dmc.anatomy.scan.naming import ROOT, TRUNK, Naming
from cathsim_dmc.anatomy.scan.tree import grow_tree, name_trunk, with_root
from cathsim_dmc.anatomy.scan.units import mm, shown
from cathsim_dmc.anatomy.scan.ways import DEVICE_RADIUS, Ways
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth


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


class Wishes(NamedTuple):
    """Input of the user: places in the file's frame, curves, names, device, axes."""

    places: dict[str, np.ndarray]
    curves: dict[str, np.ndarray]
    changes: Mapping[str, str]
    device: Calibre | None
    axes: str | ArrayLike | None


class Growth:
    """Growth of the tree of an enlarged lumen, and choice of the device that passes."""

    def __init__(
        self,
        field: SurfaceDepth,
        scale: float,
        wishes: Wishes,
        places: Mapping[str, np.ndarray],
        note: Callable[[str], None],
    ):
        """Finds the free ends of the lumen.

        Args:
            field: Depth in the enlarged lumen, m.
            scale: Factor by which the lumen is enlarged.
            wishes: Input of the user.
            places: Its places (3,) in the enlarged lumen, m, LPS.
            note: Receives notes on guesses.
        """
        self._field, self._scale, self._note = field, scale, note
        self._places, self._changes = places, wishes.changes
        self._certain = wishes.axes is not None and "heart" in places
        self.device, self._given = wishes.device or USUAL, wishes.device is not None
        self._ways = Ways(field, scale * self.device.outer_radius)
        self._ends = free_ends(self._ways)

    def tree(self, curves: Mapping[str, np.ndarray]) -> tuple[VesselTree, bool, bool]:
        """The tree of drawn curves (n, 3), m, or of computed ones if there are none.

        Returns:
            The tree, whether it starts at an end of the lumen, and whether it is an
            arch.

        Raises:
            ValueError: if no branch lets the device in, or a place or a curve does not
                suit the lumen.
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
