"""Centrelines computed from a lumen's surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cathsim_dmc.anatomy.scan.ends import Cover, FreeEnd, LumenEntry, length_of
from cathsim_dmc.anatomy.scan.topology import groups
from cathsim_dmc.anatomy.scan.ways import CELL, Ways

DEVICE_RADIUS = 0.84e-3  # m, 5 Fr catheter (1 Fr = 1/3 mm diameter)
BRANCH = 15e-3  # m, shortest passable length of a branch worth a name
# A ring of vessels has no free end: two ways from the inlet meet in it. They come from
# different vessels if, some way back, they are farther apart than these widths.
BACK = 25e-3  # m
APART = 1.5  # of the sum of both depths
APART_MIN = 4e-3  # m
RING = 40e-3  # m, shortest ring


@dataclass(frozen=True)
class Found:
    """A computed centreline, from the inlet to an end.

    Attributes:
        points: (n, 3) m, first point at the inlet.
        tip: (3,) m, where it ends.
        own: m, length that it shares with no wider one.
    """

    points: np.ndarray
    tip: np.ndarray
    own: float


def centrelines(
    ways: Ways, ends: Sequence[FreeEnd], entry: LumenEntry
) -> tuple[list[Found], int]:
    """Deepest ways from the inlet to every branch that a 5 Fr catheter can enter.

    Branches have a free end, or close a ring (such as the two vertebral arteries,
    which meet in the basilar).

    Args:
        ways: of the lumen.
        ends: its free ends.
        entry: where the device enters and where the root leads.

    Returns:
        (centrelines, the bulkiest first, without the root; how many more branches
        are too thin or too short).
    """
    start = ways.node(entry.position)
    before = ways.deepest_from(start)
    cover = Cover(ways)
    if entry.far is not None:
        cover.add(ways.trace(before, ways.node(entry.far)))
    todo = []
    for end in ends:
        gaps = [np.linalg.norm(end.position - entry.position)]
        if entry.far is not None:
            gaps.append(np.linalg.norm(end.position - entry.far))
        if min(gaps) > 1e-6:
            todo.append(ways.trace(before, ways.node(end.position)))
    if not entry.at_end and entry.far is not None:
        toward = ways.trace(before, ways.node(entry.far))
        todo = [way for way in todo if _ahead(ways, way, toward)]
    todo = [way for way in todo if len(way) > 3]
    todo.sort(key=lambda way: -float(ways.depth[way].sum()))
    # Rings last: what they share with a branch that has an end is that branch's.
    todo += _rings(ways, before)
    found, thin = [], 0
    for way in todo:
        if isinstance(way, tuple):
            way = _round(cover, *way)
        own = cover.own_part(way[::-1])[::-1]
        if len(own) < 3:
            continue
        if len(own) == len(way):
            # It begins at the inlet, at whose very end the lattice has no depth.
            own = own[int((ways.depth[own] >= DEVICE_RADIUS).argmax()) :]
        depth = ways.depth[own] + CELL
        narrow = np.flatnonzero(depth < DEVICE_RADIUS)
        passable = own[: narrow[0]] if len(narrow) else own
        if len(passable) < 2 or length_of(ways, passable) < BRANCH:
            thin += 1
            continue
        cover.add(way)
        found.append(
            Found(ways.points[way], ways.points[way[-1]], length_of(ways, own))
        )
    return found, thin


def continued(
    ways: Ways,
    ends: Sequence[FreeEnd],
    curves: dict[str, np.ndarray],
    entry: LumenEntry,
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Given centrelines, each drawn on to the end of its vessel.

    A curve that stops half way says which vessel is meant, not where that ends.

    Args:
        ways: of the lumen.
        ends: its free ends.
        curves: (n, 3) m by name, first point proximal.
        entry: where the device enters.

    Returns:
        (curves; metres by which each was continued, where it was).
    """
    start = ways.node(entry.position)
    before = ways.deepest_from(start)
    paths = [ways.trace(before, ways.node(end.position)) for end in ends]
    added: dict[str, float] = {}
    out = dict(curves)
    # Of two that end in one another the wider one goes on.
    order = sorted(
        curves, key=lambda key: -ways.depth[[ways.node(p) for p in curves[key]]].sum()
    )
    for name in order:
        curve = curves[name]
        last = ways.node(curve[-1])
        here = ways.points[last]
        reach = max(3.0 * ways.depth[last], 6e-3)
        if any(np.linalg.norm(end.position - here) < reach for end in ends):
            continue
        # It may end in a vessel that goes on, as one vertebral artery in the other's.
        others = [line for key, line in out.items() if key in added]
        if any(np.linalg.norm(c - here, axis=1).min() < reach for c in others):
            continue
        best = None
        for path in paths:
            gap = np.linalg.norm(ways.points[path] - here, axis=1)
            at = int(gap.argmin())
            if gap[at] < max(ways.depth[path[at]], 1.5e-3) and len(path) - at > 3:
                bulk = float(ways.depth[path[at:]].sum())
                if best is None or bulk > best[0]:
                    best = (bulk, path[at + 1 :])
        if best is not None:
            rest = ways.points[best[1]]
            added[name] = length_of(ways, best[1])
            out[name] = np.concatenate([curve, rest])
    return out, added


def _ahead(ways: Ways, way: np.ndarray, toward: np.ndarray) -> bool:
    """Whether two ways from one place leave it towards the same side."""
    step = min(10, len(way) - 1, len(toward) - 1)
    here = ways.points[way[0]]
    one, other = (ways.points[each[step]] - here for each in (way, toward))
    return float(one @ other) > 0.0


def _rings(ways: Ways, before: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs of ways from the inlet whose ends touch, for every ring of vessels."""
    back = _upstream(ways, before)
    rows, cols = ways.links
    gap = np.linalg.norm(ways.points[back[rows]] - ways.points[back[cols]], axis=1)
    near = APART * (ways.depth[back[rows]] + ways.depth[back[cols]]) + APART_MIN
    meet = ways.main[rows] & (gap > near)
    rows, cols = rows[meet], cols[meet]
    if not len(rows):
        return []
    label = groups(len(ways.points), np.stack([rows, cols], axis=1))[rows]
    depth = np.minimum(ways.depth[rows], ways.depth[cols])
    order = np.lexsort((-depth, label))  # of each place the deepest link first
    first = order[np.unique(label[order], return_index=True)[1]]
    rings = []
    for at in first[depth[first] >= DEVICE_RADIUS]:
        one, other = (ways.trace(before, int(k[at])) for k in (rows, cols))
        count = min(len(one), len(other))
        same = one[:count] == other[:count]
        shared = count if same.all() else int(same.argmin())
        if length_of(ways, one[shared:]) + length_of(ways, other[shared:]) > RING:
            rings.append((one, other))
    return rings


def _upstream(ways: Ways, before: np.ndarray) -> np.ndarray:
    """Node (n,) that lies ``BACK`` up the way of each node, or the way's start."""
    count = len(ways.points)
    up = [np.where(before >= 0, before, np.arange(count))]
    step = [np.linalg.norm(ways.points - ways.points[up[0]], axis=1)]
    # Jumps of 2, 4, 8 ... nodes, put together to the longest that is not too long.
    while 2 ** len(up) * 1e-3 < BACK:
        step.append(step[-1] + step[-1][up[-1]])
        up.append(up[-1][up[-1]])
    here, gone = np.arange(count), np.zeros(count)
    for jump, length in zip(up[::-1], step[::-1], strict=True):
        fits = gone + length[here] <= BACK
        gone = np.where(fits, gone + length[here], gone)
        here = np.where(fits, jump[here], here)
    return here


def _round(cover: Cover, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """One way through a ring: up the side that leaves first, on to the other side."""
    own = [cover.own_part(way[::-1])[::-1] for way in (one, other)]
    alone = [len(way) - len(part) for way, part in zip((one, other), own, strict=True)]
    if alone[1] < alone[0]:
        one, other, own = other, one, own[::-1]
    return np.concatenate([one, own[1][::-1]])
