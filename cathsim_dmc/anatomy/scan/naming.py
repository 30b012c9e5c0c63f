"""Names of computed centrelines, by where they leave the aorta and where they go."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from cathsim_dmc.anatomy.scan.centring import resample

ARCH_BRANCHES = ("bca", "lcca", "lsa")  # in their order from the heart
ARCH = 220e-3  # m from the root's far end, in which the arch's branches leave
CORONARY = 15e-3  # m from there, within which no branch of the arch leaves
SHARED = 8e-3  # m beyond the root; curves that share more are one branch of the arch
TALL = 0.6  # of the tallest: shorter upward branches are side branches
_STEP = 1e-3  # m
_NAME = re.compile(r"[a-z][a-z0-9_]*")


def name_branches(
    root: np.ndarray, curves: Sequence[np.ndarray], arch: bool
) -> list[str]:
    """Names for curves that start together with the root.

    Seen from the heart the arch gives off the brachiocephalic artery, the left common
    carotid and the left subclavian, whatever the frame of the scan. What leaves
    elsewhere, or fits none of the known patterns, is called branch_1, branch_2, ...
    from the inlet on.

    Args:
        root: (n, 3) m, centreline from the inlet to the heart.
        curves: (m_i, 3) m, from the inlet on; the first points equal the root's as
            long as they run together.
        arch: whether the root has a far end of its own, as an aorta has.
    """
    leave = [_common(root, curve) for curve in curves]
    names: dict[int, str] = {}
    if arch:
        s = _arc(root)
        from_heart = s[-1] - s[np.minimum(leave, len(root) - 1)]
        near = [i for i, d in enumerate(from_heart) if CORONARY < d < ARCH]
        if near:
            names = _arch_names(root, curves, leave, near)
    others = sorted(
        (i for i in range(len(curves)) if i not in names), key=leave.__getitem__
    )
    for number, i in enumerate(others):
        names[i] = f"branch_{number + 1}"
    return [names[i] for i in range(len(curves))]


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


def _arch_names(root, curves, leave, near) -> dict[int, str]:
    s = _arc(root)
    groups = _groups(curves, leave, near)
    first = min(leave[i] for i in near)
    back, ahead = np.searchsorted(s, [s[first] - 120e-3, s[first] - 20e-3])
    end = np.searchsorted(s, s[-1] - 30e-3)
    up = _unit(root[max(ahead, back + 2)] - root[back])
    if up @ _unit(root[-1] - root[end]) > 0.3:
        return {}  # the root does not turn back: no arch
    heart, descending = root[-1], root[:first]
    level = np.abs((descending - heart) @ up).argmin()
    behind = descending[level] - heart
    behind = _unit(behind - (behind @ up) * up)
    left = np.cross(behind, up)
    # Branches that go to the head or the arms, in order from the heart.
    rising = [
        group
        for group in groups
        if max((curves[i][-1] - root[leave[i]]) @ up for i in group) > 0.0
    ]
    rising.sort(key=lambda group: -leave[group[0]])
    sides = _order(curves, leave, rising, up)
    names: dict[int, str] = {}
    for group, side in zip(rising, sides, strict=False):
        rows = [curves[i][leave[i] :] for i in group]
        for i, name in zip(
            group, _group_names(rows, side, up, behind, left), strict=True
        ):
            names[i] = name
    return names


def _order(curves, leave, groups, up) -> list[str]:
    """Which branch of the arch each group is, or nothing where it is not clear."""
    if len(groups) == 3:
        return list(ARCH_BRANCHES)
    if len(groups) == 2:
        return ["bovine", "lsa"]
    if len(groups) == 4 and len(groups[2]) == 1:
        # A vertebral artery of its own goes up; the last of four that does is none.
        third = curves[groups[2][0]][leave[groups[2][0]] :]
        rise = third[-1] - third[0]
        if rise @ up > TALL * np.linalg.norm(rise):
            return ["bca", "lcca", "lva", "lsa"]
    return []


def _group_names(rows, side, up, behind, left) -> list[str]:
    """Names of the curves (n, 3) of one branch of the arch."""
    rel = [row[-1] - row[0] for row in rows]
    height = np.array([r @ up for r in rel])
    aside = np.array([np.linalg.norm(r - (r @ up) * up) for r in rel])
    if len(rows) == 1:
        return ["bca" if side == "bovine" else side]
    tall = np.flatnonzero((height > aside) & (height > TALL * height.max()))
    wide = np.flatnonzero((height <= aside) & (aside > 20e-3))
    right = side in ("bca", "bovine")
    names: dict[int, str] = {}
    if len(wide) and side != "lcca":
        names[int(wide[aside[wide].argmax()])] = "rsa" if right else "lsa"
    if len(tall):
        middle = 0.5 * height[tall].min()
        places = np.stack([_at_height(rows[i], up, middle) for i in tall])
        order = list(tall)
        if side == "bovine" and len(tall) > 1:
            leftmost = int(tall[(places @ left).argmax()])
            names[leftmost] = "lcca"
            keep = tall != leftmost
            order, places = list(tall[keep]), places[keep]
        front = [int(order[k]) for k in np.argsort(places @ behind)]
        main = {"lcca": ["lcca"], "lsa": ["lva"], "lva": ["lva"]}.get(
            side, ["rcca", "rva"]
        )
        for i, name in zip(front, main, strict=False):
            names.setdefault(i, name)
    # What is left takes the name of the one it runs with the longest.
    known = dict(names)
    for i in range(len(rows)):
        if i not in names:
            shared = {j: _common(rows[i], rows[j]) for j in known}
            base = known[max(shared, key=shared.__getitem__)] if shared else side
            number = 2
            while f"{base}_{number}" in names.values():
                number += 1
            names[i] = f"{base}_{number}" if shared or i else base
    return [names[i] for i in range(len(rows))]


def _groups(curves, leave, near) -> list[list[int]]:
    groups: list[list[int]] = []
    for i in near:
        for group in groups:
            j = group[0]
            together = _common(curves[i], curves[j])
            line = curves[i][leave[i] : together]
            if len(line) > 1 and _arc(line)[-1] > SHARED:
                group.append(i)
                break
        else:
            groups.append([i])
    return groups


def _common(one: np.ndarray, other: np.ndarray) -> int:
    """How many first points two curves share."""
    count = min(len(one), len(other))
    same = (one[:count] == other[:count]).all(axis=1)
    return count if same.all() else int(same.argmin())


def _at_height(row: np.ndarray, up: np.ndarray, height: float) -> np.ndarray:
    line = resample(row, _STEP)
    above = (line - row[0]) @ up >= height
    return line[int(above.argmax())]


def _arc(line: np.ndarray) -> np.ndarray:
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
