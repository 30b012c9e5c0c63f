"""The arch of a lumen without drawn centrelines: its heart, its entry and its names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cathsim_dmc.anatomy.scan.aorta import (
    Bend,
    depth_along,
    find_aorta,
    heart_evidence,
    mirrored,
)
from cathsim_dmc.anatomy.scan.ends import FreeEnd, LumenEntry, listed
from cathsim_dmc.anatomy.scan.extract import Found, centrelines
from cathsim_dmc.anatomy.scan.naming import SURE, Naming, name_branches, neutral_names
from cathsim_dmc.anatomy.scan.offshoots import Offshoot, offshoots
from cathsim_dmc.anatomy.scan.ways import Ways

NEAR_END = 2.5  # radii of an end: an inlet or a heart that is nearer means that end


@dataclass(frozen=True)
class Arch:
    """An aorta that turns back, seen from the end that is not at the heart.

    Attributes:
        ways: of the lumen.
        ends: of the aorta, that at the heart last.
        bend: of the aorta, from the first of them on.
        naming: of all branches, seen from there.
        found: the centrelines from there, as `centrelines` gives them.
    """

    ways: Ways
    ends: tuple[FreeEnd, FreeEnd]
    bend: Bend
    naming: Naming
    found: tuple[list[Found], int]

    @classmethod
    def of(
        cls, ways: Ways, ends: Sequence[FreeEnd], heart: np.ndarray | None
    ) -> Arch | None:
        """The arch of a lumen, or None if it has none.

        Args:
            ways: of the lumen.
            ends: its free ends.
            heart: (3,) m near the end at the heart, or None to find it.

        Raises:
            ValueError: if ``heart`` is near no end of an aorta.
        """
        pair = find_aorta(ways, ends)
        if pair is None:
            if heart is not None:
                raise ValueError(
                    "the lumen has no aortic arch, so no end of it is at the heart; "
                    f"give the inlet instead of the heart. Its ends are {listed(ends)}."
                )
            return None
        # The wider end is more often at the heart; then all is computed once.
        first, last = sorted((ends[k] for k in pair), key=lambda end: end.radius)
        odds: float | None = None
        if heart is not None:
            gaps = [np.linalg.norm(end.position - heart) for end in (first, last)]
            odds = np.inf if gaps[1] < gaps[0] else -np.inf
            if min(gaps) > 4.0 * (first, last)[int(np.argmin(gaps))].radius + 10e-3:
                raise ValueError(
                    f"heart is {min(gaps) * 1e3:.0f} mm away from both ends of the "
                    f"aorta; give a point near one of them: {listed([first, last])}."
                )
        seen = cls._named(ways, ends, first, last, odds)
        if not seen[1].heart_last:
            first, last = last, first
            seen = cls._named(ways, ends, first, last, odds and -odds)
        return cls(ways, (first, last), *seen)

    @classmethod
    def _named(
        cls, ways, ends, first, last, odds
    ) -> tuple[Bend, Naming, tuple[list[Found], int]]:
        entry = LumenEntry(first.position, True, last.position)
        lines = centrelines(ways, ends, entry)
        curves = [f.points for f in lines[0]]
        bend, width, found = cls._seen(ways, entry, curves)
        if odds is None:
            odds = _odds(bend, width, found)
        median = float(np.median(width))
        return bend, name_branches(ways, bend, median, found, curves, odds), lines

    def centrelines(
        self, ends: Sequence[FreeEnd], entry: LumenEntry
    ) -> tuple[list[Found], int]:
        """The centrelines from an entry, and how many branches are too thin."""
        own = (self.ends[0].position, self.ends[1].position)
        if entry.at_end and entry.position is own[0] and entry.far is own[1]:
            return self.found
        return centrelines(self.ways, ends, entry)

    @staticmethod
    def _seen(ways, entry, curves) -> tuple[Bend, np.ndarray, list[Offshoot]]:
        before = ways.deepest_from(ways.node(entry.position))
        way = ways.trace(before, ways.node(entry.far))
        bend = Bend.of(ways.points[way])
        width = depth_along(ways, way, bend.line)
        found = offshoots(ways, bend, width, curves) if curves else []
        # Where a limb is short its branches say better where the head is.
        rows = [max(one.rows, key=len) for one in found if one.rows]
        return Bend.of(ways.points[way], rows), width, found

    def entry(self, inlet: np.ndarray | None, planned: LumenEntry) -> LumenEntry:
        """Where the device enters, and where the aorta leads from there.

        Args:
            inlet: (3,) m as given by the user, or None: then the end that is not at
                the heart.
            planned: entry that the given inlet means.
        """
        first, last = self.ends
        if inlet is None:
            return LumenEntry(first.position, True, last.position)
        if planned.at_end:
            gap = [np.linalg.norm(end.position - planned.position) for end in self.ends]
            if min(gap) < 1e-6:
                other = self.ends[1 - int(np.argmin(gap))]
                return LumenEntry(planned.position, True, other.position)
            return planned
        off = np.linalg.norm(self.bend.line - planned.position, axis=1).min()
        if off < first.radius + last.radius:
            return LumenEntry(planned.position, False, last.position)
        return planned

    def wrong_side(self) -> str | None:
        """Why the arch lies in no patient in this frame, or None."""
        if self.naming.heart < SURE:
            return None
        return mirrored(self.bend.azimuth(heart_last=True))

    def named(self, curves: Sequence[np.ndarray]) -> Naming:
        """Names of the curves (m_i, 3) m from where the device enters."""
        known = self.naming
        start = curves[0][0]
        first, last = self.ends
        entry = LumenEntry(start, True, last.position)
        toward = True
        if np.linalg.norm(start - last.position) < np.linalg.norm(
            start - first.position
        ):
            entry, toward = LumenEntry(start, True, first.position), False
        bend, width, found = self._seen(self.ways, entry, curves)
        if not found:
            return Naming(
                [f"branch_{k + 1}" for k in range(len(curves))], toward, 1, []
            )
        # The heart is known; how surely, the whole aorta said.
        out = name_branches(
            self.ways,
            bend,
            float(np.median(width)),
            found,
            curves,
            np.inf if toward else -np.inf,
        )
        if known.heart < SURE:
            return Naming(
                neutral_names(curves),
                toward,
                known.heart,
                [note for note in known.notes if "heart" in note],
            )
        return out


def _odds(bend: Bend, width: np.ndarray, found: Sequence[Offshoot]) -> float:
    if not found:
        middle = 1e-3 * bend.apex
        return heart_evidence(bend, width, middle, middle)[0]
    places = [one.s for one in found]
    return heart_evidence(bend, width, min(places), max(places))[0]
