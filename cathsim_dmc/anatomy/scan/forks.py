"""Names of the vessels that a branch of the arch leads to, where it forks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import product

import numpy as np

from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.anatomy.scan.aorta import BRANCH, Bend, chord
from cathsim_dmc.anatomy.scan.offshoots import Offshoot, common, depth_of
from cathsim_dmc.anatomy.scan.ways import Ways

SURE = 0.95  # least probability of a name, and of the end at the heart
EXTRA = 0.002  # probability that a branch is none of those that are looked for
SPREAD = 0.3  # standard deviation of the logarithm of a radius
VARIED = 0.45  # the same of vertebral arteries
# Of the vessels that a branch leads to: radius (m), range of the angle of their way
# from the head's direction (degrees), and the deviation beyond it.
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
    "lsa": ("lsa", "lva"),
    "rsa": ("rsa", "rva"),
}
_STEM = {"bovine": "bca"}
TWINS = 85e-3  # m that two curves share after all others have left: one vessel


def leads(
    ways: Ways,
    bend: Bend,
    one: Offshoot,
    called: tuple[str, float],
    scale: float,
    heart_last: bool,
) -> tuple[dict[int, str], dict[int, float]]:
    """Names of the curves of a branch, and their probabilities.

    Args:
        ways: of the lumen.
        bend: of its aorta.
        one: the branch.
        called: what the branch is, and the probability of that.
        scale: width of the aorta by that of a usual one.
        heart_last: whether the heart is at the last point of the aorta.
    """
    label, sure = called
    if not one.curves:
        return {}, {}
    kept = without_twins(one.rows) if label in LEADS else [0]
    rows = [one.rows[k] for k in kept]
    if len(rows) == 1:
        return {one.curves[kept[0]]: _STEM.get(label, label)}, {
            one.curves[kept[0]]: sure
        }
    share = _shares(rows)
    seen = [_look(ways, bend, row, max(share[i])) for i, row in enumerate(rows)]
    downstream = bend.along * (-1.0 if heart_last else 1.0)
    aside = np.array([(row[-1] - row[0]) @ downstream for row in rows])
    weights = {}
    for order in product((*LEADS[label], "extra"), repeat=len(rows)):
        names = [name for name in order if name != "extra"]
        if len(set(names)) < len(names):
            continue
        if "bca" in order and {"rcca", "rsa", "rva"} & set(order):
            continue
        weights[order] = _assignment(order, label, seen, share, aside, scale)
    most = max(weights.values())
    odds = {key: np.exp(value - most) for key, value in weights.items()}
    total = sum(odds.values())
    names, surety = {}, {}
    for place, row in enumerate(kept):
        number = one.curves[row]
        by = defaultdict(float)
        for order, value in odds.items():
            by[order[place]] += value / total
        name = max(by, key=lambda key: by[key])
        if sure * by[name] >= SURE and name != "extra":
            names[number], surety[number] = name, sure * by[name]
    numbers = [one.curves[row] for row in kept]
    if label == "bovine" and len(rows) == 2 and list(names.values()) == ["lcca"]:
        # What parts from the left carotid begins as the brachiocephalic artery.
        (other,) = set(numbers) - set(names)
        names[other], surety[other] = "bca", surety[numbers[1 - numbers.index(other)]]
    return names, surety


def _shares(rows: Sequence[np.ndarray]) -> list[list[int]]:
    """First points that every two of some curves share."""
    return [[0 if a is b else common(a, b) for b in rows] for a in rows]


def without_twins(rows: Sequence[np.ndarray]) -> list[int]:
    """Rows of the curves but for those that run in the vessel of a longer one."""
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
    """Radius (m) and angle (degrees) from the head of what a curve has for its own."""
    own = row[min(shared, len(row) - 3) :]
    s = arc_lengths(own)
    part = own[(s >= min(8e-3, 0.4 * s[-1])) & (s <= BRANCH)]
    cosine = chord(part if len(part) > 1 else own) @ bend.head
    radius = float(np.median(depth_of(ways, part)))
    return radius, float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _assignment(order, label, seen, share, aside, scale) -> float:
    """Log weight of names for the curves of one branch."""
    weight = 0.0
    for name, (radius, angle) in zip(order, seen, strict=True):
        if name == "extra":
            weight += np.log(EXTRA)
            continue
        mean, least, most, deviation = PARTS[name]
        spread = VARIED if name in ("rva", "lva") else SPREAD
        weight += normal(np.log(radius / (scale * mean)), spread)
        off = max(least - angle, angle - most, 0.0) / deviation
        weight += max(normal(off, 1.0), -6.0)
    place = {name: k for k, name in enumerate(order) if name != "extra"}
    for vertebral, artery in (("rva", "rsa"), ("lva", "lsa")):
        # It leaves the subclavian artery, not the trunk.
        if vertebral in place and artery in place:
            own = share[place[vertebral]]
            if own[place[artery]] < max(own):
                weight -= 5.0
        elif vertebral in place:
            weight -= 3.0
    if {"rcca", "rva", "rsa"} <= set(place):
        arm = share[place["rsa"]]
        weight -= 6.0 if arm[place["rva"]] < arm[place["rcca"]] else 0.0
    if label in ("bca", "bovine") and "bca" not in place:
        weight -= 1.0 if "rsa" not in place else 0.0
        weight -= 4.0 if "rcca" not in place else 0.0
    if label == "bovine":
        if "lcca" not in place:
            weight -= 4.0
        else:
            # It leaves the trunk first, on the side of the descending aorta.
            k = place["lcca"]
            rest = [j for j in range(len(order)) if j != k]
            if len(rest) > 1:
                inner = min(share[i][j] for i in rest for j in rest if i != j)
                weight -= 5.0 if max(share[k]) > inner else 0.0
            gap = aside[k] - np.mean(aside[rest])
            weight += float(np.clip(gap / 8e-3, -4.0, 4.0))
    if label in ("lsa", "rsa") and label not in place:
        weight -= 4.0
    return float(weight)


def normal(value: float, deviation: float) -> float:
    """Logarithm of a normal density, but for a constant."""
    return float(-0.5 * (value / deviation) ** 2 - np.log(deviation))
