"""What a branch of an arch leads to past its fork: names of its curves."""

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.special import softmax

from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.anatomy.scan.aorta import CHORD, Bend, chord
from cathsim_dmc.anatomy.scan.offshoots import Offshoot, depth_of
from cathsim_dmc.anatomy.scan.ways import Ways, common

SURE = 0.95  # least probability of a name, and of the end at the heart
EXTRA = 0.002  # probability that a branch is none of those that are looked for
SPREAD = 0.3  # standard deviation of the logarithm of a radius
# The same of vertebral arteries, and of wide ones that may be carotids.
VARIED, WIDER = 0.45, 0.25


class Part(NamedTuple):
    """A vessel that a branch leads to: radius, m, and angles to the head, degrees."""

    radius: float
    least: float
    most: float
    deviation: float  # beyond the range of the angle


PARTS = {
    "rcca": Part(3.2e-3, 0.0, 25.0, 15.0),
    "lcca": Part(3.2e-3, 0.0, 30.0, 15.0),
    "rsa": Part(3.4e-3, 65.0, 160.0, 15.0),
    "lsa": Part(3.6e-3, 65.0, 160.0, 15.0),
    "rva": Part(1.9e-3, 0.0, 35.0, 15.0),
    "lva": Part(1.9e-3, 0.0, 35.0, 15.0),
    "bca": Part(5.6e-3, 0.0, 50.0, 20.0),
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
# The artery of an arm past a fork: least radius, m, and angle to the head, degrees.
ARM_RADIUS, ARM_ANGLE = 2.2e-3, 50.0
# Vessel that a branch may also lead to, by a common trunk or a bypass, unless it leaves
# the arch itself; and the probability.
MIXED, MIXES = {"lsa": "lcca", "rsa": "rcca", "lcca": "lsa"}, 0.02
TWINS = 85e-3  # m, common length without others from which two curves are one vessel


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
        arm = any(
            look.radius > scale * ARM_RADIUS and look.angle > ARM_ANGLE for look in seen
        )
        return {} if arm else {one.curves[0]: (label, sure)}
    downstream = bend.along * (-1.0 if heart_last else 1.0)
    aside = np.array([(row[-1] - row[0]) @ downstream for row in rows])
    fork = _Fork(label, doubt, scale, seen, share, aside)
    weights = {}
    choices = (*LEADS[label], *([doubt] if doubt else []), "extra")
    for order in product(choices, repeat=len(rows)):
        names = [name for name in order if name != "extra"]
        twice = len(set(names)) < len(names)
        if not twice and not ("bca" in order and {"rcca", "rsa", "rva"} & set(order)):
            weights[order] = fork.weight(order)
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


class _Look(NamedTuple):
    """The own part of a curve: radius, m, and angle to the head, degrees."""

    radius: float
    angle: float


def _look(ways: Ways, bend: Bend, row: np.ndarray, shared: int) -> _Look:
    """Looks at a curve (n, 3), m, past the points that it shares with others."""
    own = row[min(shared, len(row) - 3) :]
    s = arc_lengths(own)
    part = own[(s >= min(8e-3, 0.4 * s[-1])) & (s <= CHORD)]
    cosine = chord(part if len(part) > 1 else own) @ bend.head
    radius = float(np.median(depth_of(ways, part)))
    return _Look(radius, float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))


@dataclass(frozen=True, eq=False)
class _Fork:
    """The n curves of one branch, to be named."""

    label: str  # of the branch
    doubt: str | None  # vessel that it may also lead to
    scale: float  # width of the aorta relative to a usual one
    seen: Sequence[_Look]  # n
    share: Sequence[Sequence[int]]  # (n, n), number of first points shared
    aside: np.ndarray  # (n,), way downstream along the aorta, m

    def weight(self, order: Sequence[str]) -> float:
        """Log weight of names (n) for the curves."""
        label, share, aside = self.label, self.share, self.aside
        weight = np.log(EXTRA) * order.count("extra")
        place = {name: k for k, name in enumerate(order) if name != "extra"}
        for name, k in place.items():
            usual, look = PARTS[name], self.seen[k]
            wide = float(np.log(look.radius / (self.scale * usual.radius)))
            spread = SPREAD
            if name in ("rva", "lva"):
                spread = WIDER if self.doubt and wide > 0.0 else VARIED
            weight += normal(wide, spread)
            beyond = max(usual.least - look.angle, look.angle - usual.most, 0.0)
            weight += max(normal(beyond / usual.deviation, 1.0), -6.0)
        for vertebral, artery in (("rva", "rsa"), ("lva", "lsa")):
            # A vertebral artery leaves the subclavian artery, not the trunk.
            if vertebral in place and artery in place:
                own = share[place[vertebral]]
                weight -= 5.0 if own[place[artery]] < max(own) else 0.0
            elif vertebral in place and label != "lcca":
                weight -= 3.0
        if label == "lcca" and "lva" in place:  # the thinner of the two
            least = min(look.radius for look in self.seen)
            weight -= 3.0 if self.seen[place["lva"]].radius > least else 0.0
        if {"rcca", "rva", "rsa"} <= set(place):
            arm = share[place["rsa"]]
            weight -= 6.0 if arm[place["rva"]] < arm[place["rcca"]] else 0.0
        if label in ("bca", "bovine") and "bca" not in place:
            weight -= 1.0 if "rsa" not in place else 0.0
            weight -= 4.0 if "rcca" not in place else 0.0
        if self.doubt in place:
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
