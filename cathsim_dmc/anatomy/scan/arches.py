"""Recognition of an aortic arch in a lumen: its heart, its entry and its names."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial.distance import cdist

from cathsim_dmc.anatomy.scan import aorta, extract, naming
from cathsim_dmc.anatomy.scan.aorta import Bend
from cathsim_dmc.anatomy.scan.ends import FreeEnd, stump
from cathsim_dmc.anatomy.scan.extract import LumenEntry, listed
from cathsim_dmc.anatomy.scan.naming import SURE, Naming
from cathsim_dmc.anatomy.scan.offshoots import (
    Offshoot,
    departures,
    offshoots,
    third_limb,
)
from cathsim_dmc.anatomy.scan.units import mm, shown
from cathsim_dmc.anatomy.scan.ways import Ways

LIKE_NONE = 0.85  # probability of no known pattern, above which a bend is no arch


@dataclass(frozen=True, eq=False)
class Arch:
    """An aortic arch, with its paths from the end that is not at the heart."""

    ways: Ways
    ends: tuple[FreeEnd, FreeEnd]  # the end at the heart last
    entry: LumenEntry  # at the first end; at the last if the first is a stump
    found: list[np.ndarray]  # `centrelines` from the entry
    bend: Bend  # of the aorta, from the first end
    width: np.ndarray  # (n,) m, depth along the bend's line
    branches: list[Offshoot]  # of the arch
    heart: float  # probability that the heart is at the last end
    right: bool = False  # whether the arch is known to be right-sided
    given: bool = False  # whether the user gave the heart

    @classmethod
    def of(
        cls, ways: Ways, ends: Sequence[FreeEnd], heart: np.ndarray | None
    ) -> Self | str:
        """The arch of a lumen with free ends, or why it has none.

        `heart` (3,), m, is a point near the end at the heart, or None to find that end.
        ValueError if it is near no end of an aorta.
        """
        (pair, why), cut = aorta.find_aorta(ways, ends), None
        if pair is None and (cut := stump(ways, ends)) is not None:
            ends = [*ends, cut]
            pair, why = aorta.find_aorta(ways, ends, aorta.TURN_OF_STUMP)
        if pair is None:
            if heart is not None:
                raise ValueError(
                    "the lumen has no aortic arch, so no end of it is at the heart; "
                    f"give the inlet instead of the heart. Its ends are {listed(ends)}."
                )
            return why
        # The wider end is tried first as the heart: it usually is.
        first, last = sorted((ends[k] for k in pair), key=lambda end: end.radius)
        if heart is not None:
            gaps = [np.linalg.norm(end.position - heart) for end in (first, last)]
            if gaps[0] <= gaps[1]:
                first, last = last, first
            if min(gaps) > 4.0 * last.radius + 10e-3:
                off = mm(float(min(gaps)))
                raise ValueError(
                    f"heart is {off:.0f} mm away from both ends of the aorta; give a "
                    f"point near one of them: {listed([first, last])}."
                )
            arch = replace(cls._seen(ways, ends, first, last, 1.0), given=True)
        else:
            arch = cls._seen(ways, ends, first, last)
            if arch.heart < 0.5:
                arch = cls._seen(ways, ends, last, first)
            arch = replace(arch, heart=max(arch.heart, 1.0 - arch.heart))
            if unlike := arch._unlike():
                return unlike
        first, last = arch.ends
        if first is not cut:
            return arch
        # The stump is too short for a device, which enters at the heart instead.
        entry = LumenEntry(last.position, True, first.position)
        return replace(arch, entry=entry, found=extract.centrelines(ways, ends, entry))

    @classmethod
    def _seen(
        cls,
        ways: Ways,
        ends: Sequence[FreeEnd],
        first: FreeEnd,
        last: FreeEnd,
        heart: float | None = None,
    ) -> Self:
        entry = LumenEntry(first.position, True, last.position)
        found = extract.centrelines(ways, ends, entry)
        bend, width, branches = _branches(ways, first.position, last.position, found)
        if heart is None:
            share = _shares(bend, width, branches)
            heart = sum(value for key, value in share.items() if key.heart_last)
        return cls(ways, (first, last), entry, found, bend, width, branches, heart)

    def _unlike(self) -> str:
        """Reason why the bend is no aortic arch; empty if it is one."""
        bend, width = self.bend, self.width
        limb = third_limb(self.ways, bend, width, self.found)
        if limb is not None:
            return (
                f"a branch {mm(2.0 * limb[1]):.1f} mm wide leaves the widest way at "
                f"{shown(limb[0])}, where that bends; the branches of an arch are much "
                "narrower than the aorta"
            )
        if unlisted := self._unlisted():
            return unlisted
        count = len(self.branches)
        cut = bend.turn < aorta.TURN and mm(float(np.median(width))) > aorta.ADULT
        if count and cut:
            # The aorta is cut off past its branches, where it would turn.
            count = len(list(departures(bend, width, self.found)))
        if not count or (count == 1 and bend.turn < aorta.LOOP):
            count = "one branch leaves" if count else "no branch leaves"
            return (
                f"{count} the widest way where it bends, by "
                f"{np.degrees(bend.turn):.0f} degrees"
            )
        return ""

    def _unlisted(self) -> str:
        """Reason why the branches are those of no arch; empty if they are."""
        if not self.branches:
            return ""
        share = _shares(self.bend, self.width, self.branches)
        none = sum(value for key, value in share.items() if not key.pattern)
        ask = "if it is an arch, give a point near its end at the heart (--heart)"
        if none > LIKE_NONE:
            return f"its branches at the bend are those of no arch ({none:.2f}); {ask}"
        if self.heart < SURE and self.bend.up[2] < aorta.DOWN:
            return f"the widest way bends towards the feet; {ask}, or its axes (--axes)"
        return ""

    def on_its_side(self, certain: bool) -> Self:
        """The arch, marked as right-sided if it leads to the right.

        `certain` is whether the user gave both heart and axes. Without them an arch
        that leads to an unusual side raises ValueError.
        """
        azimuth = self.bend.azimuth(heart_last=True)
        wrong = aorta.mirrored(azimuth)
        if azimuth is None or not wrong or self.heart < SURE:
            return self
        if not (certain and aorta.right_sided(azimuth)):
            raise ValueError(wrong)
        return replace(self, right=True)

    def entered(self, inlet: np.ndarray | None, planned: LumenEntry) -> LumenEntry:
        """Entry of the device: by default the end that is not at the heart.

        With a given inlet (3,), m, it is the `planned` entry, with the root along the
        aorta.
        """
        if inlet is None:
            return self.entry
        first, last = self.ends
        off = np.linalg.norm(self.bend.line - planned.position, axis=1).min()
        if not planned.at_end and off < first.radius + last.radius:
            return planned._replace(far=last.position)
        for here, far in ((first, last), (last, first)):
            if planned.at_end and np.allclose(here.position, planned.position, 0, 1e-6):
                return planned._replace(far=far.position)
        return planned

    def named(self, curves: Sequence[np.ndarray], root: np.ndarray | None) -> Naming:
        """Names of curves (m_i, 3), m, that leave a root with the far end (3,), m.

        If that is no end of the aorta, the root is taken to lead to the farther end.
        """
        names, notes, right = self._named(curves, root)
        return Naming(names, [*notes, *self._young()], right)

    def _young(self) -> list[str]:
        """Question about an arch that is as narrow as a child's; else empty."""
        wide = mm(2.0 * float(np.median(self.width)))
        if self.given or wide >= 2.0 * aorta.ADULT:
            return []
        return [
            f"question: is it an aortic arch? It is {wide:.1f} mm wide, as a child's. "
            "If it is another artery that bends, name it and its branches (--rename); "
            "if it is an adult's, give its unit (--units)"
        ]

    def _named(self, curves: Sequence[np.ndarray], root: np.ndarray | None) -> Naming:
        start, ends = curves[0][0], [end.position for end in self.ends]
        gaps = [np.linalg.norm(end - start) for end in ends]
        if root is not None and min(np.linalg.norm(ends - root, axis=1)) < 1e-6:
            gaps = -np.linalg.norm(ends - root, axis=1)
        toward = bool(gaps[1] >= gaps[0])
        bend, width, found = self.bend, self.width, self.branches
        if curves is not self.found or not toward:
            bend, width, found = _branches(self.ways, start, ends[toward], curves)
        if not found:
            return Naming(naming.neutral_names(curves))
        if self.right:
            return naming.right_sided(found[::-1] if toward else found, curves)
        if self.heart < SURE:
            names = naming.neutral_names(curves)
            share = {
                key: value
                for key, value in _shares(bend, width, found).items()
                if key.heart_last == toward
            }
            seen = found[::-1] if toward else found
            which = naming.question(share, seen, dict(enumerate(names)))
            heart = (
                f"question: which end of the aorta is at the heart? ({self.heart:.2f} "
                "for the one taken); give a point near it (--heart)"
            )
            return Naming(names, [which, heart])
        scale = _scale(width)
        return naming.name_branches(self.ways, bend, scale, found, curves, toward)


def _shares(
    bend: Bend, width: np.ndarray, found: Sequence[Offshoot]
) -> dict[naming.Hypothesis, float]:
    """Probabilities of the hypotheses about an arch whose heart is not known."""
    places = [one.s for one in found] or [1e-3 * bend.apex]
    odds = {False: 0.0, True: aorta.heart_odds(bend, width, places)}
    return naming.hypotheses(bend, found, _scale(width), odds)


def _scale(width: np.ndarray) -> float:
    """Median radius of an aorta relative to the usual one, within 0.5 to 1.5."""
    return float(np.clip(np.median(width) / naming.AORTA, 0.5, 1.5))


def _branches(
    ways: Ways, start: np.ndarray, far: np.ndarray, curves: Sequence[np.ndarray]
) -> tuple[Bend, np.ndarray, list[Offshoot]]:
    """Bend of the aorta between two points, depth along it, and its branches."""
    way = ways.trace(ways.deepest_from(ways.node(start)), ways.node(far))
    points = ways.points[way]
    bend = Bend.of(points)
    width = ways.depth[way][cdist(bend.line, points).argmin(axis=1)]
    found = offshoots(ways, bend, width, curves) if curves else []
    # The branches give the direction to the head where a limb is short.
    rows = [max(one.rows, key=len) for one in found if one.rows]
    return Bend.of(points, rows), width, found
