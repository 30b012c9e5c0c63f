"""Names of computed centrelines, by hypotheses about the arch that they leave.

A hypothesis says which end of the aorta is at the heart and which branch each offshoot
of the arch is. Its probability is that of the pattern of branches times those of the
calibres, spacings and forks that are seen. A branch gets its name if the hypotheses
that give it sum up to `SURE`; otherwise it gets a neutral one, and the notes ask.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from cathsim_dmc.anatomy.scan.aorta import Bend, chord
from cathsim_dmc.anatomy.scan.forks import (
    EXTRA,
    SPREAD,
    SURE,
    leads,
    normal,
    without_twins,
)
from cathsim_dmc.anatomy.scan.offshoots import Offshoot, common
from cathsim_dmc.anatomy.scan.units import in_mm
from cathsim_dmc.anatomy.scan.ways import Ways

ARCH_BRANCHES = ("bca", "lcca", "lsa")  # in their order from the heart
ANATOMICAL = frozenset((*ARCH_BRANCHES, "rcca", "rsa", "rva", "lva"))
# Patterns of branches in their order from the heart, with their frequency and what they
# are called. "bovine" is the common trunk of BCA and LCCA.
PATTERNS = {
    ("bca", "lcca", "lsa"): (0.74, "a usual arch"),
    ("bovine", "lsa"): (0.18, "a bovine arch"),
    ("bca", "lcca", "lva", "lsa"): (0.04, "an arch with its own left vertebral artery"),
    ("rcca", "lcca", "lsa", "rsa"): (0.02, "an aberrant right subclavian artery"),
    ("bovine", "lva", "lsa"): (
        0.01,
        "a bovine arch with its own left vertebral artery",
    ),
}
CUT = 0.03  # probability that the scan shows nothing of a branch
SHORT = 0.04  # that it is cut short
# Arteries of the arch that have no name here, such as a thyroid or a bronchial one, are
# thin: radius in m, and the standard deviation of the logarithm of a wider one.
EXTRA_RADIUS, EXTRA_SPREAD = 2.0e-3, 0.8
BETWEEN = 0.2  # of these, how many leave between LCCA and LSA, where vertebral ones do
BUMP = 0.02  # that one that looks cut short is none
# Radii beyond the ostium, m (`arch.sampler`, vertebral: 1.9), for an aorta as wide as
# `AORTA`; `SPREAD` is the standard deviation of their logarithm.
RADII = {
    "bca": 6.2e-3,
    "bovine": 6.4e-3,
    "lcca": 4.0e-3,
    "lsa": 5.0e-3,
    "lva": 1.9e-3,
    "rcca": 3.9e-3,
    "rsa": 4.8e-3,
}
AORTA = 13.3e-3
# Share of each in the distance (m) between neighbours; the deviation of its logarithm.
# A vertebral artery leaves between others that are no farther apart.
SPACING = {"bca": 11e-3, "lcca": 9e-3, "lsa": 8e-3, "bovine": 26e-3, "lva": 0.0}
APART = 0.5
# Length up to the first fork, m: mean, deviation, and how often none is in the scan.
FORKS = {
    "bca": (42e-3, 10e-3, 0.5),
    "bovine": (12e-3, 8e-3, 0.02),
    "lsa": (38e-3, 10e-3, 0.5),
    "lcca": (120e-3, 30e-3, 0.95),
    "rcca": (120e-3, 30e-3, 0.95),
    "rsa": (38e-3, 10e-3, 0.5),
    "lva": (150e-3, 30e-3, 0.99),
}
# Cosine between the way of a branch and the right and back of the arch's plane: mean
# and deviation. An aberrant right subclavian artery runs behind to the right.
SIDE, SIDE_OF_RSA = (0.0, 0.35), (0.65, 0.3)
_SIDES = np.log(2.0 / np.sqrt(2.0 * np.pi))  # against one of any side
_FORK_DENSITY = 1.0 / 60e-3  # 1/m, to which densities of forks are compared
_NAME = re.compile(r"[a-z][a-z0-9_]*")


@dataclass(frozen=True)
class Naming:
    """What a lumen's branches are.

    Attributes:
        names: of the curves.
        heart_last: whether the last point of the aorta is at the heart.
        heart: probability of that.
        notes: names with their probability, and questions.
        right: rows of the curves that share a brachiocephalic artery, named or not.
    """

    names: list[str]
    heart_last: bool
    heart: float
    notes: list[str]
    right: tuple[int, ...] = ()


def name_branches(
    ways: Ways,
    bend: Bend,
    width: float,
    found: Sequence[Offshoot],
    curves: Sequence[np.ndarray],
    odds: float,
) -> Naming:
    """Names for the curves that leave an aortic arch.

    Args:
        ways: of the lumen.
        bend: of its aorta.
        width: m, median radius of the aorta.
        found: offshoots of the arch, in the order of the bend's line.
        curves: (m_i, 3) m, computed centrelines.
        odds: log odds that the heart is at the last point of the line; infinite where
            that is given.
    """
    scale = float(np.clip(width / AORTA, 0.5, 1.5))
    share = _probabilities(found, _sides(bend, found), odds, scale)
    heart = sum(value for (last, _, _), value in share.items() if last)
    heart_last = bool(heart >= 0.5)
    heart = max(heart, 1.0 - heart)
    seen = list(found)[::-1] if heart_last else list(found)
    marginal: list[dict[str, float]] = [defaultdict(float) for _ in seen]
    for (last, _, labels), value in share.items():
        for place, label in enumerate(labels):
            if last == heart_last:
                marginal[place][label] += value
    names: dict[int, str] = {}
    said, right = [], []
    open_: list[Offshoot] = []
    forked: list[tuple[str, Offshoot]] = []
    for one, odds_of in zip(seen, marginal, strict=True):
        label = max(odds_of, key=lambda key: odds_of[key])
        sure = odds_of[label]
        if sure < SURE or label == "extra":
            if one.curves:
                open_.append(one)
            continue
        if label == "bca" and len(one.curves) > 1:
            right += one.curves
            said.append(f"bca {sure:.2f}")
        parts, surety = leads(ways, bend, one, (label, sure), scale, heart_last)
        for number, name in parts.items():
            names[number] = name
            said.append(f"{name} {surety[number]:.2f}")
        if len(parts) < len(without_twins(one.rows)):
            forked.append((label, one))
    _neutral(names, curves, bend)
    notes = []
    if said:
        notes.append("names with their probability: " + ", ".join(said))
    if open_:
        notes.append(_question(share, seen, heart_last, names))
    for label, one in forked:
        own = " and ".join(sorted(names[i] for i in one.curves))
        label = "trunk of bca and lcca" if label == "bovine" else label
        notes.append(
            f"question: the {label} that leaves the arch at {in_mm(one.place)} leads "
            f"to {own}: which is which? Name them (--rename)"
        )
    if heart < SURE:
        notes.append(
            f"question: which end of the aorta is at the heart? ({heart:.2f} for the "
            "one taken); give a point near it (--heart)"
        )
    every = [names[i] for i in range(len(curves))]
    return Naming(every, heart_last, heart, notes, tuple(right))


def neutral_names(curves: Sequence[np.ndarray]) -> list[str]:
    """Names of curves that leave no arch, in the order in which they part."""
    leave = [
        max((common(one, other) for other in curves if other is not one), default=0)
        for one in curves
    ]
    order = sorted(range(len(curves)), key=leave.__getitem__)
    return [f"branch_{order.index(i) + 1}" for i in range(len(curves))]


def renamed(names: Sequence[str], changes: Mapping[str, str], root: str) -> list[str]:
    """Names after the user's changes.

    Raises:
        ValueError: if a name to change does not exist, or a new one is taken or is
            no name.
    """
    for old, new in changes.items():
        if old not in names:
            raise ValueError(
                f"no vessel {old!r} to rename; there are {', '.join(names)}."
            )
        if not _NAME.fullmatch(str(new)):
            raise ValueError(
                f"{new!r} is no vessel name; give small letters, digits and '_'."
            )
    out = [changes.get(name, name) for name in names]
    for name in out:
        if out.count(name) > 1 or name == root:
            raise ValueError(f"the vessel name {name!r} is taken; choose another.")
    return out


def _sides(bend: Bend, found: Sequence[Offshoot]) -> list[float]:
    """Cosine of each branch to one side of the arch's plane, where it can be seen.

    The side is the patient's right and back if the heart is at the first point.
    """
    side = np.cross(bend.up, bend.along)
    ways = [max(one.rows, key=len, default=np.zeros((1, 3))) for one in found]
    return [float(chord(way) @ side) for way in ways]


def _probabilities(
    found: Sequence[Offshoot], sides: Sequence[float], odds: float, scale: float
) -> dict[tuple[bool, tuple[str, ...], tuple[str, ...]], float]:
    """Of every (heart at the last point, pattern, labels from the heart on)."""
    weights = {}
    for heart_last in (False, True):
        side = odds if heart_last else 0.0
        if np.isinf(odds):
            if heart_last != (odds > 0.0):
                continue
            side = 0.0
        seen, right = list(found), list(sides)
        if heart_last:
            seen, right = seen[::-1], [-value for value in right[::-1]]
        for pattern, labels, weight in _hypotheses(seen, right, scale):
            weights[heart_last, pattern, labels] = weight + side
    most = max(weights.values())
    share = {key: float(np.exp(weight - most)) for key, weight in weights.items()}
    total = sum(share.values())
    return {key: value / total for key, value in share.items()}


def _hypotheses(seen: Sequence[Offshoot], right: Sequence[float], scale: float):
    """Every (pattern, labels, log weight) of offshoots in order from the heart."""
    count = len(seen)
    for pattern, (frequency, _) in PATTERNS.items():
        for kept in range(min(count, len(pattern)) + 1):
            for shown in combinations(range(len(pattern)), kept):
                for at in combinations(range(count), kept):
                    labels = ["extra"] * count
                    for place, which in zip(at, shown, strict=True):
                        labels[place] = pattern[which]
                    weight = np.log(frequency)
                    weight += np.log(CUT) * (len(pattern) - kept)
                    weight += sum(
                        _fit(one, label, scale, side)
                        for one, label, side in zip(seen, labels, right, strict=True)
                    )
                    weight += _spacings(seen, pattern, shown, at, scale)
                    weight += np.log(BETWEEN) * _between(seen, labels)
                    yield pattern, tuple(labels), float(weight)


def _between(seen: Sequence[Offshoot], labels: Sequence[str]) -> int:
    """How many arteries without a name leave between LCCA and LSA."""
    near = zip(labels, seen[1:], labels[1:], labels[2:], strict=False)
    return sum(
        first in ("lcca", "bovine") and label == "extra" and last == "lsa"
        for first, one, label, last in near
        if one.curves
    )


def _fit(one: Offshoot, label: str, scale: float, side: float) -> float:
    """Log probability of the calibre, the fork and the side of an offshoot."""
    if label == "extra":
        if not one.curves:
            return float(np.log(BUMP))
        wider = max(np.log(one.radius / (scale * EXTRA_RADIUS)), 0.0) / EXTRA_SPREAD
        return float(np.log(EXTRA) - 0.5 * wider**2)
    # What was cut short shows little more than the mouth of a branch.
    spread = SPREAD if one.curves else 2.0 * SPREAD
    weight = normal(np.log(one.radius / (scale * RADII[label])), spread)
    if one.curves:
        mean, deviation = SIDE_OF_RSA if label == "rsa" else SIDE
        weight += normal(side - mean, deviation) + _SIDES
    mean, deviation, none = FORKS[label]
    if one.fork is None:
        return weight + np.log(none if one.curves else SHORT)
    density = np.exp(-0.5 * ((one.fork - mean) / deviation) ** 2)
    density = 0.02 + density / (deviation * np.sqrt(2.0 * np.pi) * _FORK_DENSITY)
    return weight + np.log((1.0 - none) * density)


def _spacings(seen, pattern, shown, at, scale: float) -> float:
    """Log probability of the distances between neighbours of a pattern."""
    weight = 0.0
    for k in range(len(at) - 1):
        between = pattern[shown[k] : shown[k + 1] + 1]
        wanted = sum(SPACING.get(name, 8e-3) for name in between[:-1])
        wanted += sum(SPACING.get(name, 8e-3) for name in between[1:])
        there = max(abs(seen[at[k + 1]].s - seen[at[k]].s), 2e-3)
        weight += normal(np.log(there / (scale * wanted)), APART)
    return weight


def _neutral(names: dict[int, str], curves, bend: Bend) -> None:
    """Gives what has no name a neutral one, in the order from the bend's start."""
    rest = [i for i in range(len(curves)) if i not in names]
    tips = {
        i: int(np.linalg.norm(bend.line - _leaves(curves[i], bend), axis=1).argmin())
        for i in rest
    }
    for number, i in enumerate(sorted(rest, key=lambda k: tips[k])):
        names[i] = f"branch_{number + 1}"


def _leaves(curve: np.ndarray, bend: Bend) -> np.ndarray:
    gap = np.linalg.norm(curve[:, None] - bend.line[None, ::8], axis=2).min(axis=1)
    away = np.flatnonzero(gap < 6e-3)
    return curve[int(away[-1]) if len(away) else 0]


def _question(share, seen, heart_last, names) -> str:
    """What the notes ask where not every branch has a name."""
    by: dict[str, float] = defaultdict(float)
    for (last, pattern, labels), value in share.items():
        if last == heart_last:
            missing = [name for name in pattern if name not in labels]
            text = PATTERNS[pattern][1]
            if missing:
                text += f" without its {' and '.join(missing)}"
            by[text] += value
    best = sorted(by.items(), key=lambda item: -item[1])
    texts = [f"{text} ({value:.2f})" for text, value in best[:3] if value > 0.02]
    places = []
    for one in seen:
        own = ", ".join(names[i] for i in one.curves) or "a branch that is cut short"
        places.append(f"{own} at {in_mm(one.place)}")
    count = {1: "one branch leaves", 2: "two branches leave"}.get(
        len(seen), f"{len(seen)} branches leave"
    )
    return (
        f"question: {count} the arch, from the heart on {'; '.join(places)}: "
        f"{', or '.join(texts)}? Name them (--rename)"
    )
