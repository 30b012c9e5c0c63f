"""The aorta of a lumen: its two ends, its bend, and which end is at the heart."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import VesselTree, arc_lengths, tangents
from cathsim_dmc.anatomy.scan.centring import resample
from cathsim_dmc.anatomy.scan.ends import FreeEnd
from cathsim_dmc.anatomy.scan.units import mm, shown
from cathsim_dmc.anatomy.scan.ways import Ways

RADIUS = 3e-3  # m, least median radius of an aorta, a newborn's
THIN = 0.25  # least width of an end of the aorta, relative to the widest end
WIDEST = 4  # ends from which the aorta may start
SMOOTH = 6e-3  # m, standard deviation of the smoothing along a path of nodes
ARM = 60e-3  # m to both sides of a point, over which its bend is measured
TURN = np.radians(75.0)  # least bend of an arch
ADULT = 6.0  # mm, least median radius of an aorta that may be cut off at its branches
LOOP = np.radians(140.0)  # least bend of an arch with a single visible branch
# A branch at the bend that is wider than THIRD of the aorta's width is a limb of it;
# THIRD_OF_TAPERED holds if an end of the aorta is narrower than TAPERED of its width.
THIRD, THIRD_OF_TAPERED, TAPERED = 0.85, 0.65, 0.7
TURN_OF_STUMP = np.radians(60.0)  # least bend of an arch cut off past its branches
# A limb that narrows to less than ARTERY of the width of the aorta before NEAR, and for
# longer than LASTS (in radii of the aorta), is an artery of the arch: the aorta is cut
# off beside it. An iliac artery begins farther from the arch.
ARTERY, NEAR, LASTS = 0.5, 15.0, 3.0
LEG = 80e-3  # m, compared length of each leg, from 10 mm past the branches
# Limbs of the bend, m: the part next to the apex that is left out of the direction (at
# most half), the length from which the direction counts, and the further length that
# gives it the full weight.
LIMB, COUNTS, FULL = 50e-3, 40e-3, 60e-3
CHORD = 60e-3  # m of a branch over which its direction is taken
UPRIGHT = 0.9  # least cosine between the arch and +z of an upright scan
DOWN = -0.5  # largest cosine to +z of a bend that points to the feet
# Longest usual ascending aorta, m, and the excess that divides its odds by e.
ASCENDING, LONGER = 70e-3, 18e-3
# Arc length from the middle of the arch's branches to the top, m: mean and standard
# deviation (`arch.sampler`: 0, 13 and 21 mm for types I to III, each +- 8).
BEFORE, BEFORE_SPREAD = 10e-3, 11e-3
# Azimuth from the ascending to the descending leg, from back to left, in an upright
# body: 50 degrees, standard deviation 14 (`arch.sampler`), here 25 to allow for cut
# scans. TURNED is the share of misoriented scans, AZIMUTH the accepted range.
FACING, FACING_SPREAD, TURNED = np.radians(50.0), np.radians(25.0), 0.02
AZIMUTH = (np.radians(-5.0), np.radians(97.0))
# Message about a scan whose sides are not the patient's.
MISPLACED = "the scan is mirrored, turned, or in another frame (--frame, --axes)"


def find_aorta(
    ways: Ways, ends: Sequence[FreeEnd], turn: float = TURN
) -> tuple[tuple[int, int] | None, str]:
    """Indices of the two ends of the aorta; or None, and the reason.

    The aorta is the path between two free ends with the largest sum of fourth powers of
    the depth: a wide stump counts more than a long branch. It must bend by more than
    ``turn`` (rad).
    """
    width = np.array([end.radius for end in ends])
    order = [int(k) for k in np.argsort(-width) if width[k] > THIN * width.max()]
    nodes = [ways.node(end.position) for end in ends]
    best = (0.0, None, np.empty(0, dtype=int))
    for row, one in enumerate(order[:WIDEST]):
        before = ways.deepest_from(nodes[one])
        for other in order[row + 1 :]:
            way = ways.trace(before, nodes[other])
            if len(way) > 3:
                bulk = float((ways.depth[way] ** 4).sum())
                best = max(best, (bulk, (one, other), way), key=lambda b: b[0])
    pair, way = best[1:]
    if pair is None:
        return None, "the lumen has no two wide ends"
    ends_of_it = " and ".join(shown(ends[k].position) for k in pair)
    wide, bend = np.median(ways.depth[way]), Bend.of(ways.points[way])
    if mm(wide) < 1e3 * RADIUS:
        return None, (
            f"the widest way, from {ends_of_it}, is {mm(2.0 * wide):.1f} mm wide; an "
            f"aorta has {2e3 * RADIUS:g} mm or more"
        )
    if bend.turn <= turn:
        return None, (
            f"the widest way, from {ends_of_it}, bends by {np.degrees(bend.turn):.0f} "
            f"degrees; an arch bends by {np.degrees(turn):.0f} or more: one of its "
            "limbs may be cut off"
        )
    if thin := _artery(ways, way, bend):
        return None, (
            f"the widest way, from {ends_of_it}, narrows to {mm(2.0 * thin):.1f} mm "
            "near its bend, as an artery of the arch does: the aorta may be cut off "
            "beside that"
        )
    return pair, ""


def _artery(ways: Ways, way: np.ndarray, bend: "Bend") -> float:
    """Radius, m, of a limb of the path (n,) of nodes that is no aorta; 0 for none."""
    points, depth = ways.points[way], ways.depth[way]
    s = arc_lengths(points)
    apex = s[np.linalg.norm(points - bend.line[bend.apex], axis=1).argmin()]
    wide = float(np.percentile(depth, 75.0))
    broad = np.flatnonzero(depth > ARTERY * wide)
    for limb, edge in (
        (slice(0, broad[0]), s[broad[0]]),
        (slice(broad[-1] + 1, None), s[broad[-1]]),
    ):
        lasts = ways.length(way[limb]) > LASTS * wide
        if lasts and abs(edge - apex) < NEAR * wide:
            return float(np.median(depth[limb]))
    return 0.0


@dataclass(frozen=True, eq=False)
class Bend:
    """The bend of an aorta; directions are unit vectors (3,)."""

    line: np.ndarray  # (n, 3) m, smoothed, 1 mm apart
    apex: int  # row of the line that is farthest from the chord of its two arms
    turn: float  # rad, largest bend between 60 mm before and after a point
    up: np.ndarray  # mean direction of the limbs towards the bend and of the branches
    along: np.ndarray  # from the leg before the apex to the one after it

    @classmethod
    def of(cls, way: np.ndarray, branches: Sequence[np.ndarray] = ()) -> Self:
        """The bend of a path (n, 3), m, with branches (m_i, 3), m, that leave it."""
        line = resample(way)
        width = min(SMOOTH / 1e-3, len(line) / 6)
        line = gaussian_filter1d(line, width, axis=0, mode="nearest")
        reach = max(2, min(round(ARM / 1e-3), len(line) // 3))
        tangent = tangents(line)
        rows = np.arange(len(line))
        first = np.maximum(rows - reach, 0)
        last = np.minimum(rows + reach, len(line) - 1)
        cosine = np.vecdot(tangent[first], tangent[last])
        # The apex is the point with both arms that is farthest from their chord.
        rise = line - 0.5 * (line[first] + line[last])
        height = np.linalg.norm(rise, axis=1) - 1e-3 * cosine
        height[: reach // 2] = height[len(line) - reach // 2 :] = -np.inf
        apex = int(height.argmax())
        up = _unit(sum(map(chord, branches), np.zeros(3)))
        for limb in (line[apex::-1], line[apex:]):
            start = limb[min(round(LIMB / 1e-3), (len(limb) - 1) // 2)]
            sure = np.clip((1e-3 * len(limb) - COUNTS) / FULL, 0.05, 1.0)
            up = up + sure * _unit(start - limb[-1])
        up = _unit(up)
        along = line[last[apex]] - line[first[apex]]
        along = _unit(along - (along @ up) * up)
        turn = float(np.arccos(np.clip(cosine.min(), -1.0, 1.0)))
        return cls(line, apex, turn, up, along)

    @property
    def upright(self) -> bool:
        """Whether the arch stands upright in the frame of the scan."""
        return bool(self.up[2] > UPRIGHT)

    @property
    def head(self) -> np.ndarray:
        """Direction (3,) to the head: +z of an upright scan, else the bend's own."""
        return np.array([0.0, 0.0, 1.0]) if self.upright else self.up

    @property
    def top(self) -> int:
        """Row of the line that is nearest to the head."""
        return int((self.line @ self.head).argmax())

    def azimuth(self, heart_last: bool) -> float | None:
        """Azimuth (rad), from back to left, from the ascending to the descending leg.

        Both legs are taken at the height of the higher end, or 60 mm below the top.
        None if the scan is not upright or the legs are less than 10 mm apart.
        """
        height, top = self.line @ self.head, self.top
        off = np.abs(height - max(height[0], height[-1], height[top] - ARM))
        first, last = off[: top + 1].argmin(), top + off[top:].argmin()
        x, y, _ = self.line[last] - self.line[first]
        if not self.upright or np.hypot(x, y) < 10e-3:
            return None
        return float(np.arctan2(-x, -y) if heart_last else np.arctan2(x, y))


def bend_of(tree: VesselTree) -> Bend | None:
    """The bend of the aorta at the root of a tree; None if the root is no aorta."""
    line = tree.root.centreline
    bend = Bend.of(line.points)
    if np.median(line.radii) < RADIUS or bend.turn < TURN_OF_STUMP:
        return None
    near = [
        vessel.centreline.points
        for name, vessel in tree.vessels.items()
        if vessel.parent == tree.root.name
        and abs(tree.origin(name) - 1e-3 * bend.apex) < ARM
    ]
    return Bend.of(line.points, near)


def unproven(tree: VesselTree, turn: np.ndarray | None) -> str | None:
    """Warning that left and right of a scan were not checked, or None.

    ``turn`` (3, 3) is the rotation that the import applied; None for none.
    """
    bend = bend_of(tree)
    if bend is not None and bend.upright:
        return None
    what, ask = "no arch shows whether the scan stands upright", ""
    if bend is not None:
        up = bend.up if turn is None else bend.up @ turn  # as in the file
        way = int(np.abs(up).argmax())
        points = f"{'-+'[int(up[way] > 0.0)]}{'xyz'[way]}"
        off = np.degrees(np.arccos(bend.up[2]))
        what = (
            f"the scan does not stand upright: its arch points towards {points}, "
            f"{off:.0f} degrees off the head"
        )
        ask = f"; {'give its' if turn is None else 'check the'} axes (--axes)"
    return f"{what}, so whether it is mirrored, right for left, was not checked{ask}"


def mirrored(azimuth: float | None) -> str | None:
    """Message about an unusual side to which an arch leads from the heart, or None."""
    if azimuth is None or AZIMUTH[0] <= azimuth <= AZIMUTH[1]:
        return None
    side = "left" if azimuth > 0 else "right"
    face = "back" if abs(azimuth) < np.pi / 2 else "front"
    certain = "; if it is a right-sided arch, give its heart and its axes both (--heart"
    certain = f"{certain} and --axes, LPS where it stands upright)"
    return (
        f"the arch leads from the heart to the {side} and {face} "
        f"({np.degrees(azimuth):.0f} degrees from back to left; 50 are usual): "
        f"{MISPLACED}, or its heart is at the other end (--heart)"
        f"{certain if right_sided(azimuth) else ''}"
    )


def right_sided(azimuth: float) -> bool:
    """Whether an arch leads from the heart to the right and back."""
    return bool(AZIMUTH[0] <= -azimuth <= AZIMUTH[1])


def heart_odds(bend: Bend, depth: np.ndarray, places: Sequence[float]) -> float:
    """Log odds that the heart is at the last point of an aorta.

    ``depth`` (n,), m, is that of the bend's line, ``places`` the arc lengths, m, of the
    branches.
    """
    first, last = min(places), max(places)
    s = 1e-3 * np.arange(len(bend.line))
    legs = [
        (s > max(first - 10e-3 - LEG, 5e-3)) & (s < first - 10e-3),
        (s > last + 10e-3) & (s < min(last + 10e-3 + LEG, s[-1] - 5e-3)),
    ]
    total = 0.0
    if all(leg.sum() >= 10 for leg in legs):
        before, after = (float(np.median(depth[leg])) for leg in legs)
        # Diameters 29.5 and 23.9 mm; their ratio has a standard deviation of 15 %.
        total += np.clip(18.0 * np.log(after / before), -4.0, 4.0)
    # The ascending aorta is 63 ± 11 mm long up to its branches, or cut off.
    longer = [max(leg - ASCENDING, 0.0) / LONGER for leg in (first, s[-1] - last)]
    total += min(longer[0], 5.0) - min(longer[1], 5.0)
    # The branches leave before the top.
    before = 1e-3 * bend.top - 0.5 * (first + last)
    total += np.clip(-2.0 * BEFORE * before / BEFORE_SPREAD**2, -2.5, 2.5)
    # The descending leg is behind and left.
    azimuth = bend.azimuth(heart_last=True)
    if azimuth is not None:
        total += np.log(_facing(azimuth) / _facing(azimuth + np.pi))
    return float(total)


def _facing(azimuth: float) -> float:
    """Probability density (1/rad) of an azimuth from heart to descending aorta."""
    off = (azimuth - FACING + np.pi) % (2.0 * np.pi) - np.pi
    peak = np.exp(-0.5 * (off / FACING_SPREAD) ** 2)
    peak /= FACING_SPREAD * np.sqrt(2.0 * np.pi)
    return float((1.0 - TURNED) * peak + TURNED / (2.0 * np.pi))


def is_upright(anatomy: Anatomy) -> bool:
    """Whether +x is known to be the patient's left and +z the head.

    This holds for phantoms, and for scans whose arch stands upright.
    """
    if anatomy.scan is None:
        return True
    bend = bend_of(anatomy.tree)
    return bend is not None and bend.upright


def chord(row: np.ndarray) -> np.ndarray:
    """Unit direction (3,) of the first 60 mm of a polyline (n, 3), m."""
    return _unit(row[arc_lengths(row) <= CHORD][-1] - row[0])


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
