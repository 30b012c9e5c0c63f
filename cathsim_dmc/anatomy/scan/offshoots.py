"""Branches as they leave an aorta: ostia, calibres, forks, and what they lead to."""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import softmax

from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.anatomy.scan.aorta import (
    ARM,
    CHORD,
    TAPERED,
    THIRD,
    THIRD_OF_TAPERED,
    Bend,
    chord,
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
SURE = 0.95  # least probability of a name, and of the end at the heart
EXTRA = 0.002  # probability that a branch is none of those that are looked for
SPREAD = 0.3  # standard deviation of the logarithm of a radius
# The same of vertebral arteries, and of wide ones that may be carotids.
VARIED, WIDER = 0.45, 0.25
# Vessels that a branch leads to: radius (m), range of the angle between their direction
# and that to the head (degrees), and the deviation beyond this range.
PARTS = {
    "rcca": (3.2e-3, 0.0, 25.0, 15.0),
    "lcca": (3.2e-3, 0.0, 30.0, 15.0),
    "rsa": (3.4e-3, 65.0, 160.0, 15.0),
    "lsa": (3.6e-3, 65.0, 160.0, 15.0),
    "rva": (1.9e-3, 0.0, 35.0, 15.0),
    "lva": (1.9e-3, 0.0, 35.0, 15.0),
    "bca": (5.6e-3, 0.0, 50.0, 20.0),
}
LEADS = {
    "bca": ("rcca", "rsa", "rva"),
    "bovine": ("lcca", "bca", "rcca", "rsa", "rva"),
    "bicarotid": ("rcca", "lcca"),
    "lsa": ("lsa", "lva"),
    "rsa": ("rsa", "rva"),
    "lcca": ("lcca", "lva"),  # only where they part `AT_ONCE`
}
AT_ONCE = 8e-3  # m past the ostium; a vertebral artery does not leave a carotid later
# A branch leads to an arm if it is longer than ARM_SEEN, m, and the cosine between the
# direction of its last TAIL, m, and the head is below ASIDE. A branch longer than
# NO_ARM, m, past its fork that does not, leads to none.
TAIL, ARM_SEEN, ASIDE, NO_ARM = 25e-3, 60e-3, 0.5, 65e-3
# The artery of an arm past a fork: least radius, m, and angle to the head, degrees.
ARM_RADIUS, ARM_ANGLE = 2.2e-3, 50.0
# Vessel that a branch may also lead to, by a common trunk or a bypass, unless it leaves
# the arch itself; and the probability.
MIXED, MIXES = {"lsa": "lcca", "rsa": "rcca", "lcca": "lsa"}, 0.02
TWINS = 85e-3  # m, common length without others from which two curves are one vessel


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


def _stubs(ways, bend, depth, curves) -> Iterator[Offshoot]:
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


def mixed(label: str, others: Collection[str]) -> str | None:
    """Vessel that a branch may also lead to; None if `others` of the arch are it."""
    other = MIXED.get(label)
    return None if other in others else other


def leads(
    ways: Ways,
    bend: Bend,
    one: Offshoot,
    called: tuple[str, float],
    scale: float,
    heart_last: bool,
    others: Collection[str] = (),
) -> dict[int, tuple[str, float]]:
    """Names of the curves of a branch with their probabilities, by index.

    `called` is the name of the branch and its probability, `others` are the names of
    the other branches; `scale` is the width of the aorta relative to a usual one,
    `heart_last` whether its last point is at the heart.
    """
    label, sure = called
    doubt = mixed(label, others)
    single = label == "rcca" or label == "lcca" and (one.fork or 0.0) >= AT_ONCE
    kept = without_twins(one.rows) if label in LEADS or single else [0]
    rows, numbers = [one.rows[k] for k in kept], [one.curves[k] for k in kept]
    share = _shares(rows)
    if len(rows) == 1:
        name = "bca" if label == "bovine" else label
        return {} if label == "bicarotid" else {numbers[0]: (name, sure)}
    seen = [_look(ways, bend, row, max(share[i])) for i, row in enumerate(rows)]
    if single:
        # A carotid artery leads to an arm only by a common trunk or a bypass.
        arm = any(r > scale * ARM_RADIUS and angle > ARM_ANGLE for r, angle in seen)
        return {} if arm else {one.curves[0]: (label, sure)}
    downstream = bend.along * (-1.0 if heart_last else 1.0)
    aside = np.array([(row[-1] - row[0]) @ downstream for row in rows])
    weights = {}
    choices = (*LEADS[label], *([doubt] if doubt else []), "extra")
    for order in product(choices, repeat=len(rows)):
        names = [name for name in order if name != "extra"]
        twice = len(set(names)) < len(names)
        if not twice and not ("bca" in order and {"rcca", "rsa", "rva"} & set(order)):
            weights[order] = _assignment(order, label, seen, share, aside, scale, doubt)
    odds = normalised(weights)
    found = {}
    for place, number in enumerate(numbers):
        by = summed(
            odds,
            lambda order, place=place: "extra" if doubt in order else order[place],
        )
        name = max(by, key=by.__getitem__)
        if sure * by[name] >= SURE and name != "extra":
            found[number] = (name, sure * by[name])
    if label == "bovine" and len(rows) == 2 and len(found) == 1:
        # The curve that leaves the left carotid begins as the brachiocephalic artery.
        ((name, surety),) = found.values()
        (other,) = set(numbers) - set(found)
        if name == "lcca":
            found[other] = ("bca", surety)
    return found


def normalised(weights: Mapping[Any, float]) -> dict[Any, float]:
    """Probabilities of hypotheses that exclude each other, from their log weights."""
    return dict(zip(weights, softmax(list(weights.values())).tolist(), strict=True))


def summed(odds: Mapping[Any, float], of: Callable[[Any], str]) -> dict[str, float]:
    """Total probability of the hypotheses with each value of the function `of`."""
    by: dict[str, float] = defaultdict(float)
    for key, value in odds.items():
        by[of(key)] += value
    return by


def _shares(rows: Sequence[np.ndarray]) -> list[list[int]]:
    """Number of first points that each pair of curves shares."""
    return [[0 if a is b else common(a, b) for b in rows] for a in rows]


def without_twins(rows: Sequence[np.ndarray]) -> list[int]:
    """Indices of the curves without those that run in the vessel of a longer one."""
    share = _shares(rows)
    along = [arc_lengths(row) for row in rows]
    out: list[int] = []
    for i in sorted(range(len(rows)), key=lambda k: -along[k][-1]):
        for j in out:
            third = [share[i][k] for k in range(len(rows)) if share[i][k] < share[i][j]]
            alone = along[i][min(share[i][j], len(rows[i]) - 1)]
            if alone - along[i][max(third, default=0)] > TWINS:
                break
        else:
            out.append(i)
    return sorted(out)


def _look(ways: Ways, bend: Bend, row: np.ndarray, shared: int) -> tuple[float, float]:
    """Radius (m), and angle (degrees) to the head, of the own part of a curve."""
    own = row[min(shared, len(row) - 3) :]
    s = arc_lengths(own)
    part = own[(s >= min(8e-3, 0.4 * s[-1])) & (s <= CHORD)]
    cosine = chord(part if len(part) > 1 else own) @ bend.head
    radius = float(np.median(depth_of(ways, part)))
    return radius, float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _assignment(order, label, seen, share, aside, scale, doubt) -> float:
    """Log weight of names for the curves of one branch."""
    weight = np.log(EXTRA) * order.count("extra")
    place = {name: k for k, name in enumerate(order) if name != "extra"}
    for name, k in place.items():
        radius, angle = seen[k]
        mean, least, most, deviation = PARTS[name]
        wide = float(np.log(radius / (scale * mean)))
        spread = SPREAD
        if name in ("rva", "lva"):
            spread = WIDER if doubt and wide > 0.0 else VARIED
        weight += normal(wide, spread)
        off = max(least - angle, angle - most, 0.0) / deviation
        weight += max(normal(off, 1.0), -6.0)
    for vertebral, artery in (("rva", "rsa"), ("lva", "lsa")):
        # A vertebral artery leaves the subclavian artery, not the trunk.
        if vertebral in place and artery in place:
            own = share[place[vertebral]]
            weight -= 5.0 if own[place[artery]] < max(own) else 0.0
        elif vertebral in place and label != "lcca":
            weight -= 3.0
    if label == "lcca" and "lva" in place:  # the thinner of the two
        wider = seen[place["lva"]][0] > min(radius for radius, _ in seen)
        weight -= 3.0 if wider else 0.0
    if {"rcca", "rva", "rsa"} <= set(place):
        arm = share[place["rsa"]]
        weight -= 6.0 if arm[place["rva"]] < arm[place["rcca"]] else 0.0
    if label in ("bca", "bovine") and "bca" not in place:
        weight -= 1.0 if "rsa" not in place else 0.0
        weight -= 4.0 if "rcca" not in place else 0.0
    if doubt in place:
        weight += np.log(MIXES)
    if label == "bicarotid":
        missing = {"rcca", "lcca"} - set(place)
        weight -= 4.0 * len(missing)
        if not missing:
            gap = aside[place["lcca"]] - aside[place["rcca"]]
            weight += float(np.clip(gap / 8e-3, -4.0, 4.0))
    missing = "lcca" if label == "bovine" else label
    if label in ("lcca", "lsa", "rsa", "bovine") and missing not in place:
        weight -= 4.0
    elif label == "bovine":
        # The LCCA leaves the trunk first, on the side of the descending aorta.
        k = place["lcca"]
        rest = [j for j in range(len(order)) if j != k]
        if len(rest) > 1:
            inner = min(share[i][j] for i in rest for j in rest if i != j)
            weight -= 5.0 if max(share[k]) > inner else 0.0
        gap = aside[k] - np.mean(aside[rest])
        weight += float(np.clip(gap / 8e-3, -4.0, 4.0))
    return float(weight)


def normal(value: float, deviation: float) -> float:
    """Logarithm of a normal density, up to a constant."""
    return float(-0.5 * (value / deviation) ** 2 - np.log(deviation))
