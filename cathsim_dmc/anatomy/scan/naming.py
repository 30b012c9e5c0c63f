"""Names of computed centrelines, by hypotheses about the arch that they leave."""

import re
from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise, product
from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.scan import forks
from cathsim_dmc.anatomy.scan.aorta import Bend, chord
from cathsim_dmc.anatomy.scan.forks import EXTRA, SPREAD, SURE, normal
from cathsim_dmc.anatomy.scan.offshoots import Offshoot
from cathsim_dmc.anatomy.scan.units import shown
from cathsim_dmc.anatomy.scan.ways import Ways, common

ROOT, TRUNK = "aorta", "trunk"  # the vessel that starts at the inlet; without an arch
ARCH_BRANCHES = ("bca", "lcca", "lsa")  # in their order from the heart
# Patterns of branches in their order from the heart, with their frequency and what they
# are called. "bovine" is the common trunk of BCA and LCCA.
PATTERNS = {
    ("bca", "lcca", "lsa"): (0.74, "a usual arch"),
    ("bovine", "lsa"): (0.18, "a bovine arch"),
    ("bca", "lcca", "lva", "lsa"): (0.04, "an arch with its own left vertebral artery"),
    ("rcca", "lcca", "lsa", "rsa"): (0.02, "an aberrant right subclavian artery"),
    ("bovine", "lva", "lsa"): (0.01, "a bovine arch with its own left vertebral"),
    ("bicarotid", "lsa", "rsa"): (
        0.004,
        "an aberrant right subclavian artery with a common trunk of both carotids",
    ),
    (): (0.003, "none of these"),
}
TRUNKS = {"bovine": "trunk of bca and lcca", "bicarotid": "trunk of rcca and lcca"}
# Any branch of an unlisted arch: radius, m, with its log deviation, probability of a
# visible fork, and distance between neighbours, m, with its log deviation.
OTHER, OTHER_FORKS, OTHER_SPACE = (4.2e-3, 0.5), 0.5, (18e-3, 0.8)
CUT = 0.03  # probability that a branch is missing from the scan
SHORT = 0.04  # probability that a branch is cut short
# Thin arteries without a name: radius, m, and log deviation of wider ones.
EXTRA_RADIUS, EXTRA_SPREAD = 2.0e-3, 0.8
# Share of these that leave between LCCA and LSA, as vertebral arteries do: others, such
# as a lowest thyroid artery, leave before the LCCA.
BETWEEN = 0.05
ALONE = 0.3  # probability of a vertebral artery without the wider LSA beside it
BUMP = 0.02  # probability that an apparent branch that is cut short is none
# Each branch: radius beyond the ostium, m (`arch.sampler`, vertebral: 1.9 mm), in an
# aorta of the radius `AORTA` (`SPREAD`: deviation of its logarithm); its share of the
# distance between neighbours, m (0 for a vertebral artery, which leaves between others
# at their usual distance); length up to the first fork, m: mean, deviation, and
# probability of no visible fork.
BRANCHES = {
    "bca": (6.2e-3, 12e-3, (42e-3, 10e-3, 0.5)),
    "bovine": (6.4e-3, 26e-3, (12e-3, 8e-3, 0.02)),
    "lcca": (4.0e-3, 8e-3, (120e-3, 30e-3, 0.95)),
    "lsa": (5.0e-3, 6.3e-3, (38e-3, 10e-3, 0.5)),
    "lva": (1.9e-3, 0.0, (150e-3, 30e-3, 0.99)),
    "rcca": (3.9e-3, 10e-3, (120e-3, 30e-3, 0.95)),
    "rsa": (4.8e-3, 6e-3, (38e-3, 10e-3, 0.5)),
    "bicarotid": (5.3e-3, 14e-3, (18e-3, 11e-3, 0.02)),
}
AORTA = 13.3e-3
APART = 0.5  # deviation of the logarithm of a distance between neighbours
# Cosine between the direction of a branch, or of its ostium from the aorta's middle,
# and the normal of the arch's plane (right and back): mean and deviation. An aberrant
# right subclavian artery leaves the back of the aorta and runs behind it to the right.
SIDES = {"way": (0.0, 0.35), "ostium": (0.0, 0.3)}
SIDES_OF_RSA = {"way": (0.55, 0.3), "ostium": (0.6, 0.25)}
# Probability that a branch leads aside, to an arm, if it is long enough for
# `Offshoot.aside`; 0.5 for others.
TO_ARM = {"bca": 0.8, "lsa": 0.7, "rsa": 0.7}
TO_ARM |= dict.fromkeys(("lcca", "rcca", "bicarotid", "lva"), 0.05)
_SIDES = np.log(2.0 / np.sqrt(2.0 * np.pi))  # density relative to a uniform cosine
VESSEL_NAME = re.compile("[a-z][a-z0-9_]*")
_FORK_DENSITY = 1.0 / 60e-3  # 1/m, reference of the densities of forks


class Naming(NamedTuple):
    """Names of a lumen's curves, and notes: their probability, and questions."""

    names: list[str]
    notes: Sequence[str] = ()
    right: tuple[int, ...] = ()  # indices of the curves that share a BCA


class Hypothesis(NamedTuple):
    """Whether the heart is at the aorta's last point, pattern, labels from heart on."""

    heart_last: bool
    pattern: tuple[str, ...]
    labels: tuple[str, ...]


def name_branches(
    ways: Ways,
    bend: Bend,
    scale: float,
    found: Sequence[Offshoot],
    curves: Sequence[np.ndarray],
    heart_last: bool,
) -> Naming:
    """Names for the curves (m_i, 3) m that leave an arch; see `hypotheses`."""
    share = hypotheses(bend, found, scale, {heart_last: 0.0})
    seen = list(found)[::-1] if heart_last else list(found)
    names: dict[int, str] = {}
    said, right, forked = [], [], []
    asks = False
    labels: list[tuple[str, float]] = []
    for place in range(len(seen)):
        odds = forks.summed(share, lambda key, place=place: key.labels[place])
        labels.append(max(odds.items(), key=lambda item: item[1]))
    others = {label for label, sure in labels if sure >= SURE}
    for one, (label, sure) in zip(seen, labels, strict=True):
        if not one.curves:
            continue
        if sure < SURE or label in ("extra", "other"):
            asks = True
            continue
        if label == "bca" and len(one.curves) > 1:
            right += one.curves
            said.append(f"bca {sure:.2f}")
        called = label, sure
        parts = forks.leads(ways, bend, one, called, scale, heart_last, others)
        for number, (name, surety) in parts.items():
            names[number] = name
            said.append(f"{name} {surety:.2f}")
        if len(parts) < len(forks.without_twins(one.rows)):
            forked.append((label, one))
    rest = [i for i in range(len(curves)) if i not in names]
    rest.sort(key=lambda i: _leaves(curves[i], bend))
    names |= {i: f"branch_{number + 1}" for number, i in enumerate(rest)}
    notes = ["names with their probability: " + ", ".join(said)] if said else []
    if asks:
        notes.append(question(share, seen, names))
    for label, one in forked:
        own = " and ".join(sorted(names[i] for i in one.curves))
        called = TRUNKS.get(label, label)
        if mixed := forks.mixed(label, others):
            called = f"{label}, or trunk of {label} and {mixed}, or one with a bypass,"
        notes.append(
            f"question: the {called} that leaves the arch at {shown(one.place)} leads "
            f"to {own}: which is which? Name them (--rename)"
        )
    return Naming([names[i] for i in range(len(curves))], notes, tuple(right))


def neutral_names(curves: Sequence[np.ndarray]) -> list[str]:
    """Neutral names of curves, numbered in the order in which they fork."""
    leave = [
        max((common(a, b) for b in curves if b is not a), default=0) for a in curves
    ]
    order = np.argsort(np.argsort(leave, kind="stable"))
    return [f"branch_{place + 1}" for place in order]


def renamed(names: Sequence[str], changes: Mapping[str, str]) -> list[str]:
    """Names after the user's changes; ValueError if one is unknown, or taken."""
    for old in changes:
        if old not in names:
            raise ValueError(
                f"no vessel {old!r} to rename; there are {', '.join(names)}."
            )
    out = [changes.get(name, name) for name in names]
    for name in out:
        if out.count(name) > 1:
            raise ValueError(f"the vessel name {name!r} is taken; choose another.")
    return out


def hypotheses(
    bend: Bend, found: Sequence[Offshoot], scale: float, odds: Mapping[bool, float]
) -> dict[Hypothesis, float]:
    """Probability of every hypothesis about offshoots in the order of an aorta's line.

    `scale` is the width of the aorta relative to a usual one. `odds` are log odds of
    other evidence by whether the heart is at the last point; a missing key excludes it.
    """
    # This points to the patient's right and back if the heart is at the first point.
    side = np.cross(bend.up, bend.along)
    sides = []
    for one in found:
        way = max(one.rows, key=len, default=np.zeros((1, 3)))
        out = one.place - bend.line[min(round(1e3 * one.s), len(bend.line) - 1)]
        ostium = out / max(float(np.linalg.norm(out)), 1e-12)
        sides.append(np.array([chord(way), ostium]) @ side)
    weights = {}
    for last, more in odds.items():
        seen, right = list(found), sides
        if last:
            seen, right = seen[::-1], [-values for values in sides[::-1]]
        for pattern, labels, weight in _labellings(seen, right, scale, bend.head):
            weights[Hypothesis(last, pattern, labels)] = weight + more
    return forks.normalised(weights)


def _labellings(
    seen: Sequence[Offshoot],
    right: Sequence[np.ndarray],
    scale: float,
    head: np.ndarray,
):
    """Yields all (pattern, labels, log weight) of offshoots in order from the heart."""
    count = len(seen)
    for pattern, (frequency, _) in PATTERNS.items():
        if not pattern:
            yield pattern, ("other",) * count, _unlisted(seen, frequency, scale)
            continue
        for kept in range(min(count, len(pattern)) + 1):
            wholes = combinations(range(len(pattern)), kept)
            for whole, at in product(wholes, combinations(range(count), kept)):
                labels = ["extra"] * count
                for place, which in zip(at, whole, strict=True):
                    labels[place] = pattern[which]
                weight = np.log(frequency)
                weight += np.log(CUT) * (len(pattern) - kept)
                weight += sum(
                    _fit(one, label, scale, side, head)
                    for one, label, side in zip(seen, labels, right, strict=True)
                )
                weight += _spacings(seen, pattern, whole, at, scale)
                weight += np.log(BETWEEN) * _between(seen, labels)
                if "lva" in labels and "lsa" not in labels:
                    weight += np.log(ALONE)
                yield pattern, tuple(labels), float(weight)


def _unlisted(seen: Sequence[Offshoot], frequency: float, scale: float) -> float:
    """Log weight of offshoots that follow no pattern of the list."""
    radius, spread = OTHER
    space, apart = OTHER_SPACE
    weight = np.log(frequency)
    for one in seen:
        weight += normal(np.log(one.radius / (scale * radius)), spread)
        if one.curves:
            weight += np.log(1.0 - OTHER_FORKS if one.fork is None else OTHER_FORKS)
        else:
            weight += np.log(SHORT)
    for gap in np.abs(np.diff([one.s for one in seen])):
        weight += normal(np.log(max(gap, 2e-3) / (scale * space)), apart)
    return float(weight)


def _between(seen: Sequence[Offshoot], labels: Sequence[str]) -> int:
    """Number of arteries without a name that leave between LCCA and LSA."""
    near = zip(labels, seen[1:], labels[1:], labels[2:], strict=False)
    return sum(
        first in ("lcca", "bovine") and label == "extra" and last == "lsa"
        for first, one, label, last in near
        if one.curves
    )


def _fit(
    one: Offshoot, label: str, scale: float, sides: np.ndarray, head: np.ndarray
) -> float:
    """Log probability of the calibre, the fork and the directions of an offshoot."""
    if label == "extra":
        if not one.curves:
            return float(np.log(BUMP))
        wider = max(np.log(one.radius / (scale * EXTRA_RADIUS)), 0.0) / EXTRA_SPREAD
        return float(np.log(EXTRA) - 0.5 * wider**2)
    radius, _, (length, spread_of_it, none) = BRANCHES[label]
    # A branch that is cut short shows little more than its ostium.
    spread = SPREAD if one.curves else 2.0 * SPREAD
    weight = normal(np.log(one.radius / (scale * radius)), spread)
    if one.curves:
        usual = SIDES_OF_RSA if label == "rsa" else SIDES
        for side, (mean, deviation) in zip(sides, usual.values(), strict=True):
            weight += normal(float(side) - mean, deviation) + _SIDES
        arm = TO_ARM.get(label, 0.5)
        aside = one.aside(head)
        if aside is not None:
            weight += np.log(2.0 * (arm if aside else 1.0 - arm))
    if one.fork is None:
        return weight + np.log(none if one.curves else SHORT)
    density = np.exp(-0.5 * ((one.fork - length) / spread_of_it) ** 2)
    density = 0.02 + density / (spread_of_it * np.sqrt(2.0 * np.pi) * _FORK_DENSITY)
    return weight + np.log((1.0 - none) * density)


def _spacings(
    seen: Sequence[Offshoot],
    pattern: Sequence[str],
    places: Sequence[int],
    at: Sequence[int],
    scale: float,
) -> float:
    """Log probability of the distances between neighbours of a pattern.

    Args:
        places: Places in the pattern that offshoots have.
        at: The indices of these offshoots.
        scale: Width of the aorta relative to a usual one.
    """
    weight = 0.0
    named = zip(pairwise(places), pairwise(at), strict=True)
    for (first, last), (one, other) in named:
        shares = [BRANCHES[name][1] for name in pattern[first : last + 1]]
        wanted = sum(shares[:-1]) + sum(shares[1:])
        there = max(abs(seen[other].s - seen[one].s), 2e-3)
        weight += normal(np.log(there / (scale * wanted)), APART)
    return weight


def _leaves(curve: np.ndarray, bend: Bend) -> int:
    """Row of the bend's line where a curve leaves it."""
    gap = np.linalg.norm(curve[:, None] - bend.line[None, ::8], axis=2).min(axis=1)
    away = np.flatnonzero(gap < 6e-3)
    place = curve[int(away[-1]) if len(away) else 0]
    return int(np.linalg.norm(bend.line - place, axis=1).argmin())


def question(
    share: Mapping[Hypothesis, float],
    seen: Sequence[Offshoot],
    names: Mapping[int, str],
) -> str:
    """Question about offshoots without a name, which are given from the heart on."""

    def text(key: Hypothesis) -> str:
        missing = [
            TRUNKS.get(name, name) for name in key.pattern if name not in key.labels
        ]
        without = f" without its {' and '.join(missing)}" if missing else ""
        return PATTERNS[key.pattern][1] + without

    best = sorted(forks.summed(share, text).items(), key=lambda item: -item[1])
    texts = [f"{text} ({value:.2f})" for text, value in best[:3] if value > 0.02]
    return f"{left_by(seen, names)}: {', or '.join(texts)}? Name them (--rename)"


def right_sided(seen: Sequence[Offshoot], curves: Sequence[np.ndarray]) -> Naming:
    """Neutral names of the curves of a right-sided arch, and a question.

    `seen` are its branches from the heart on.
    """
    names = neutral_names(curves)
    which = left_by(seen, dict(enumerate(names)))
    side = "it is taken for a right-sided one, as its heart and axes are given"
    return Naming(names, [f"{which}; {side}: which is which? Name them (--rename)"])


def left_by(seen: Sequence[Offshoot], names: Mapping[int, str]) -> str:
    """Beginning of a question: the offshoots of an arch, from the heart on."""
    places = []
    for one in seen:
        own = ", ".join(names[i] for i in one.curves) or "a branch that is cut short"
        places.append(f"{own} at {shown(one.place)}")
    few = ("one branch leaves", "two branches leave")
    count = few[len(seen) - 1] if len(seen) < 3 else f"{len(seen)} branches leave"
    return f"question: {count} the arch, from the heart on {'; '.join(places)}"
