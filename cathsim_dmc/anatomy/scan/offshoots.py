"""Branches as they leave an aorta: ostia, calibres and forks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.anatomy.scan.aorta import (
    ARM,
    TAPERED,
    THIRD,
    THIRD_OF_TAPERED,
    Bend,
)
from cathsim_dmc.anatomy.scan.centring import resample
from cathsim_dmc.anatomy.scan.topology import groups
from cathsim_dmc.anatomy.scan.ways import CELL, Ways, common

OUT = 1.15  # radii of the aorta beyond which a branch has left it
SHARED = 3e-3  # m beyond that, least common length of curves of one branch
NEAR = 95e-3  # m of aorta to both sides of the apex, where branches are the arch's
CALIBRE = (4e-3, 16e-3)  # m past the ostium between which a calibre is taken
STUB = 4e-3  # m, least height of a branch that was cut short
STUB_OUT = (1.2, 1.5e-3)  # radii and m beyond which lumen is that of a stub
STUB_RADIUS = 1.2e-3  # m, least radius of one
STUB_END = 2.5  # radii from an end of the aorta without stubs
STUB_APART = 45e-3  # m of aorta, at most, to the nearest branch
STUB_WIDE = 30e-3  # m along the aorta: wider ones are no stub
# A branch leads to an arm if it is longer than ARM_SEEN, m, and the cosine between the
# direction of its last TAIL, m, and the head is below ASIDE. A branch longer than
# NO_ARM, m, past its fork that does not, leads to none.
TAIL, ARM_SEEN, ASIDE, NO_ARM = 25e-3, 60e-3, 0.5, 65e-3


@dataclass(frozen=True, eq=False)
class Offshoot:
    """A branch of the arch with the curves that it leads to; lengths in m."""

    place: np.ndarray  # (3,), where it leaves the lumen of the aorta
    s: float  # arc length of the aorta there
    radius: float  # of its lumen beyond that
    curves: tuple[int, ...]  # rows of the centrelines in it; none if it was cut short
    fork: float | None  # distance of the first fork past the ostium
    rows: tuple[np.ndarray, ...]  # (n_i, 3), its curves from the ostium on

    def aside(self, head: np.ndarray) -> bool | None:
        """Whether the end of one of its curves leads aside; `head` (3,) is a direction.

        None if no curve does, and all are too short past their fork to tell.
        """
        long = False
        for row in self.rows:
            s = arc_lengths(row)
            way = row[-1] - row[np.searchsorted(s, s[-1] - TAIL)]
            if s[-1] > ARM_SEEN and way @ head < ASIDE * np.linalg.norm(way):
                return True
            long |= bool(s[-1] - (self.fork or 0.0) > NO_ARM)
        return False if long else None


def offshoots(
    ways: Ways, bend: Bend, depth: np.ndarray, curves: Sequence[np.ndarray]
) -> list[Offshoot]:
    """Branches of an aorta with depths (n,) m, which curves (m_i, 3) m leave."""
    groups_: list[tuple[list[int], list[np.ndarray], float]] = []
    for number, row, s in departures(bend, depth, curves):
        for members, rows, _ in groups_:
            shared = arc_lengths(rows[0][: max(common(rows[0], row), 1)])[-1]
            # Curves that leave in one lumen are one branch, even if they fork at once.
            apart = np.linalg.norm(rows[0][0] - row[0])
            if apart < depth_of(ways, rows[0][:1])[0] or shared > SHARED:
                members.append(number)
                rows.append(row)
                break
        else:
            groups_.append(([number], [row], s))
    found: list[Offshoot] = []
    for members, rows, s in groups_:
        if max((row[-1] - row[0]) @ bend.up for row in rows) > 0.0:
            forks = [
                arc_lengths(one)[min(common(one, other), len(one) - 1)]
                for one, other in combinations(rows, 2)
            ]
            fork = float(min(forks)) if forks else None
            place, radius = rows[0][0], _calibre(ways, rows[0], fork)
            found.append(Offshoot(place, s, radius, tuple(members), fork, tuple(rows)))
    places = np.array([one.s for one in found])
    for stub in _stubs(ways, bend, depth, curves):
        if len(places) and abs(places - stub.s).min() < STUB_APART:
            found.append(stub)
    found = [f for f in found if abs(f.s - 1e-3 * bend.apex) < NEAR]
    return sorted(found, key=lambda f: f.s)


def departures(
    bend: Bend, depth: np.ndarray, curves: Sequence[np.ndarray]
) -> Iterator[tuple[int, np.ndarray, float]]:
    """Yields index, points (k, 3) beyond the aorta and arc length of leaving curves."""
    aorta = cKDTree(bend.line)
    for number, curve in enumerate(curves):
        distance, near = aorta.query(curve)
        inside = np.flatnonzero(distance < OUT * depth[near])
        start = int(inside[-1]) + 1 if len(inside) else 0
        if len(curve) - start > 2:
            yield number, curve[start:], 1e-3 * near[start]


def third_limb(
    ways: Ways, bend: Bend, depth: np.ndarray, curves: Sequence[np.ndarray]
) -> tuple[np.ndarray, float] | None:
    """Place (3,) and radius (m) of the widest branch at a bend, relative to the aorta.

    None if all branches are much narrower than the aorta, as in an arch.
    """
    sixth = max(1, len(depth) // 6)
    ends = min(float(np.median(end)) for end in (depth[:sixth], depth[-sixth:]))
    tapered = ends < TAPERED * float(np.median(depth))
    widest, found = THIRD_OF_TAPERED if tapered else THIRD, None
    for _, row, s in departures(bend, depth, curves):
        if abs(s - 1e-3 * bend.apex) > ARM:
            continue
        at = round(1e3 * s)
        radius = _calibre(ways, row, None)
        share = radius / float(np.median(depth[max(at - 10, 0) : at + 10]))
        if share > widest:
            widest, found = share, (row[0], radius)
    return found


def depth_of(ways: Ways, line: np.ndarray) -> np.ndarray:
    """Radius (n,) m of the lumen at nodes (n, 3) of the lattice."""
    return ways.depths(line) + CELL


def _calibre(ways: Ways, row: np.ndarray, fork: float | None) -> float:
    s = arc_lengths(row)
    first = min(CALIBRE[0], 0.3 * s[-1])
    last = min(CALIBRE[1], max(first + 2e-3, fork or np.inf))
    part = row[(s >= first) & (s <= last)]
    return float(np.median(depth_of(ways, part if len(part) else row)))


def _stubs(
    ways: Ways, bend: Bend, depth: np.ndarray, curves: Sequence[np.ndarray]
) -> Iterator[Offshoot]:
    """Branches that were cut short: lumen that rises from the aorta's wall."""
    nodes = ways.nodes
    aorta = cKDTree(bend.line)
    distance, near = aorta.query(ways.points[nodes], distance_upper_bound=60e-3)
    there = np.isfinite(distance)
    nodes, distance, near = nodes[there], distance[there], near[there]
    wide = depth[near]
    outside = distance > STUB_OUT[0] * wide + STUB_OUT[1]
    # Stubs at the ends of the aorta are corners into which its line leads.
    from_end = 1e-3 * np.minimum(near, len(bend.line) - 1 - near)
    outside &= from_end > STUB_END * wide
    row = np.full(len(ways.points), -1)
    row[nodes[outside]] = np.arange(int(outside.sum()))
    height, at = (distance - wide)[outside], near[outside]
    points, radius = ways.points[nodes[outside]], ways.depth[nodes[outside]]
    if not len(points):
        return
    pairs = row[ways.links]
    label = groups(len(points), pairs[(pairs >= 0).all(axis=1)])
    known = cKDTree(np.concatenate([resample(curve) for curve in curves]))
    taken = np.unique(label[known.query(points)[0] < 1.2e-3])
    for key in np.setdiff1d(np.unique(label), taken):
        among = np.flatnonzero(label == key)
        span = 1e-3 * float(np.ptp(at[among]))
        top = among[height[among].argmax()]
        low = among[height[among].argmin()]
        rise = (points[top] - bend.line[at[low]]) @ bend.up
        if (
            height[top] > STUB
            and radius[among].max() > STUB_RADIUS
            and span < STUB_WIDE
            and rise > 0.0
        ):
            calibre = float(radius[among].max()) + CELL
            yield Offshoot(points[low], 1e-3 * at[low], calibre, (), None, ())
