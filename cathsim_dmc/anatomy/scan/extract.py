"""Inlet of a lumen, and centrelines between its free ends."""

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.anatomy.reach import AHEAD_RADII, OSTIUM_AHEAD
from cathsim_dmc.anatomy.scan.ends import FreeEnd, is_sac
from cathsim_dmc.anatomy.scan.rings import Cover, rings, round_ring
from cathsim_dmc.anatomy.scan.units import enlargement, mm, shown
from cathsim_dmc.anatomy.scan.ways import CELL, Ways, common

WIDE = 0.4  # of the widest free end: least width of a default inlet
ROOT_WIDTH = 0.5  # of the inlet: least width of the far end of the root
STARTS = 30e-3  # m along the lumen; curves that start nearer to an end start there
# Least passable length, m, of a branch beyond the vessels already found; or, if it is
# also WIDTHS times as long as wide, beyond the wall of the main vessel.
BRANCH, WIDTHS = 15e-3, 1.5
EVEN = 0.6  # least ratio of the widths of two branches at whose fork a trunk ends
INLET_CUT = 1.8  # radii of the trunk, about what is cut off at its inlet
EVEN_PART = (1.5, 4.0)  # radii of the trunk past the fork, where widths are compared
TRUNK_LENGTH = 3.0  # of its radii, least
FITS = 0.5  # of the length of the vessels, which the default device must pass


class LumenEntry(NamedTuple):
    """Place (3,) m where the device enters, and `far` end (3,) m of the root, or None.

    The place is a free end if `at_end`; else the lumen is cut there. `sacs` are the
    wider ends that belong to aneurysms.
    """

    position: np.ndarray
    at_end: bool
    far: np.ndarray | None
    sacs: tuple[FreeEnd, ...] = ()


def plan_inlet(
    ways: Ways,
    ends: Sequence[FreeEnd],
    curves: Sequence[np.ndarray],
    inlet: np.ndarray | None,
) -> LumenEntry:
    """Choose where the device enters and where the root vessel leads.

    The device enters at the free end near `inlet` (3,) m; without a near end the vessel
    is cut at `inlet`. None chooses the end at which drawn curves (n_i, 3) m start, else
    the wide end farthest from their starts; without curves it chooses the widest end
    that is no sac. ValueError lists the ends if none can be chosen.
    """
    nodes = [ways.node(end.position) for end in ends]
    width = np.array([end.bottleneck for end in ends])
    # Ends at which a curve ends are no candidates.
    free = np.ones(len(ends), dtype=bool)
    close = np.array([max(2.5 * end.radius, 4e-3) for end in ends])
    for curve in curves:
        gap = np.array([np.linalg.norm(end.position - curve[-1]) for end in ends])
        nearest = int((gap / close).argmin())
        free[nearest] &= gap[nearest] >= close[nearest]
    cut, sacs = False, []
    if inlet is not None:
        gap = np.array([np.linalg.norm(end.position - inlet) for end in ends])
        chosen = int(gap.argmin())
        # Near a free end the inlet is that end: only its tip would be cut off.
        cut = bool(gap[chosen] > 2.5 * ends[chosen].radius)
    elif curves:
        chosen = _chosen_by_curves(ways, ends, width, free, curves)
    else:
        order = [int(k) for k in np.argsort(-width, kind="stable")]
        chosen = next((k for k in order if not is_sac(ways, nodes, k)), order[0])
        sacs = [ends[k] for k in order[: order.index(chosen)]]
    position = inlet if inlet is not None and cut else ends[chosen].position
    # The root leads to the widest other end, if a wide vessel leads there.
    reach = ways.lengths_from(ways.node(position))
    around = ways.depth[ways.main & (reach < 25e-3)].max()
    floor = ROOT_WIDTH * around
    others = free & (reach[nodes] > 2.0 * around)
    others[chosen] &= cut
    if curves:
        lasts = [ways.node(curve[-1]) for curve in curves]
        floor = max(floor, 1.2 * float(np.median(ways.depth[lasts])))
        if cut:
            # Ends behind the inlet are farther from the end of the curve than it is.
            others &= ways.lengths_from(lasts[0])[nodes] < reach[lasts[0]]
    others &= width > floor
    for row in np.argsort(-np.where(others, width, -np.inf), kind="stable"):
        if others[row] and not is_sac(ways, nodes, int(row)):
            return LumenEntry(position, not cut, ends[row].position, tuple(sacs))
    return LumenEntry(position, not cut, None, tuple(sacs))


def _chosen_by_curves(
    ways: Ways,
    ends: Sequence[FreeEnd],
    width: np.ndarray,
    free: np.ndarray,
    curves: Sequence[np.ndarray],
) -> int:
    """Index of the end at which the curves start, else of a wide one far from there.

    Args:
        width: (n,), least radius of the way to each end, m.
        free: (n,) bool, ends at which no curve ends.
        curves: (m_i, 3) m.
    """
    nodes = [ways.node(end.position) for end in ends]
    reach = np.stack([ways.lengths_from(ways.node(c[0]))[nodes] for c in curves])
    # A curve leads away from the end at which it starts.
    last = np.stack([ways.lengths_from(ways.node(c[-1]))[nodes] for c in curves])
    behind = (last > reach).all(axis=0)
    near = np.where(free & behind, reach.min(axis=0), np.inf)
    if near.min() < STARTS:
        return int(near.argmin())
    wide = free & (width >= WIDE * width[free].max(initial=0.0))
    if not wide.any():
        raise ValueError(
            "every free end of the lumen is the end of a given centreline; pass "
            f"inlet=(x, y, z) near the end by which the device enters: {listed(ends)}."
        )
    return int(np.where(wide, reach[0], -np.inf).argmax())


def listed(ends: Sequence[FreeEnd]) -> str:
    """Places and widths of up to eight ends, widest first, for a message."""
    ordered = sorted(ends, key=lambda end: -end.radius)
    return ", ".join(
        f"{shown(end.position)}, {mm(2.0 * end.radius):.1f} mm wide"
        for end in ordered[:8]
    )


def centrelines(
    ways: Ways, ends: Sequence[FreeEnd], entry: LumenEntry, *, rooted: bool = True
) -> list[np.ndarray]:
    """Deepest paths (n_i, 3) m from the inlet to all branches that the device enters.

    A branch has a free end, or closes a ring (such as the two vertebral arteries, which
    meet in the basilar). Paths are sorted by the sum of their depths, rings last. If
    `rooted`, the path to the far end of the entry is left out.
    """
    before = ways.deepest_from(ways.node(entry.position))
    cover, known, toward, main = Cover(ways), [entry.position], None, None
    if entry.far is not None:
        toward = ways.trace(before, ways.node(entry.far))
        if rooted:
            known.append(entry.far)
            cover.add(toward)
            main = Cover(ways, toward)
    todo = []
    for end in ends:
        if any(end is sac for sac in entry.sacs):
            continue
        way = ways.trace(before, ways.node(end.position))
        apart = min(np.linalg.norm(end.position - place) for place in known)
        if apart < 1e-6 or len(way) <= 3:
            continue
        if entry.at_end or toward is None or _ahead(ways, way, toward):
            todo.append(way)
    todo.sort(key=lambda way: -float(ways.depth[way].sum()))
    # Rings last: parts that they share with a branch with an end belong to that branch.
    closed = (round_ring(cover, one, other) for one, other in rings(ways, before))
    found = []
    for way in chain(todo, closed):
        own = cover.own_part(way[::-1])[::-1]
        if len(own) < 3:
            continue
        passable = _passed(ways, own, from_inlet=len(own) == len(way))
        if len(passable) < 3:
            continue
        length = ways.length(passable)
        width = 2.0 * float(np.median(ways.depth[passable]) + CELL)
        if length < BRANCH:  # a wide main vessel covers much of a branch
            length += _mouth(ways, main, way, own)
            length = 0.0 if length < WIDTHS * width else length
        if length >= BRANCH:
            cover.add(way)
            found.append(ways.points[way])
            main = main or Cover(ways, way)
    return found


def _mouth(ways: Ways, main: Cover | None, way: np.ndarray, own: np.ndarray) -> float:
    """Length (m) of a path from the wall of the main vessel to its own part, or 0."""
    if main is None or len(main.own_part(way[::-1])) > len(own):
        return 0.0  # the path leaves another vessel
    whole = main.own_part(way[::-1], wall=True)[::-1]
    return ways.length(whole) - ways.length(own)


def _passed(ways: Ways, way: np.ndarray, *, from_inlet: bool) -> np.ndarray:
    """The first part of a path (n,) of nodes, up to where the device does not pass."""
    if from_inlet:  # the lattice has no depth at the inlet itself
        way = way[int((ways.depth[way] >= ways.device).argmax()) :]
    narrow = np.flatnonzero(ways.depth[way] + CELL < ways.device)
    return way[: narrow[0]] if len(narrow) else way


def fits(ways: Ways, ends: Sequence[FreeEnd], entry: LumenEntry) -> bool:
    """Whether the device passes most of the vessels between the free ends."""
    before = ways.deepest_from(ways.node(entry.position))
    traces = [ways.trace(before, ways.node(end.position)) for end in ends]
    passed = [_passed(ways, way, from_inlet=True) for way in traces]
    every = len(np.unique(np.concatenate(traces)))
    return len(np.unique(np.concatenate(passed))) > FITS * every


def trunk(
    ways: Ways, curves: Sequence[np.ndarray]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """End (3,) m of the trunk of a tree's curves (n_i, 3) m, and those that leave it.

    The trunk is the first part of the first curve, up to the first fork into branches
    of similar width that is far enough from the inlet for a device to enter them; the
    whole curve without such a fork.
    """
    main, others = curves[0], list(curves[1:])
    depth, s = ways.depths(main), arc_lengths(main)
    forks = []
    for other in others:
        at = common(main, other) - 1
        radius = float(np.median(depth[max(at - 3, 0) : at + 1]))
        past = arc_lengths(other)
        wide = [
            _width(s - s[at], depth, radius),
            _width(past - past[at], ways.depths(other), radius),
        ]
        # The cut at the inlet, and the least distance of an ostium ahead of it.
        ahead = min(OSTIUM_AHEAD * enlargement(), AHEAD_RADII * radius)
        least = max(TRUNK_LENGTH * radius, INLET_CUT * radius + ahead)
        if s[at] > least and min(wide) > EVEN * max(wide):
            forks.append(at)
    if not forks:
        return main[-1], others
    return main[min(forks)], list(curves)


def _width(past: np.ndarray, depth: np.ndarray, radius: float) -> float:
    """Median depth (m) of a curve in `EVEN_PART` past a fork of a trunk of `radius`."""
    part = (past > EVEN_PART[0] * radius) & (past < EVEN_PART[1] * radius)
    return float(np.median(depth[part])) if part.any() else 0.0


def continued(
    ways: Ways,
    ends: Sequence[FreeEnd],
    curves: dict[str, np.ndarray],
    entry: LumenEntry,
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Drawn centrelines (n, 3) m by name, each continued to the end of its vessel.

    A drawn curve names a vessel and may stop before its end. Also returns the lengths
    (m), by name, by which curves were continued.
    """
    before = ways.deepest_from(ways.node(entry.position))
    paths = [ways.trace(before, ways.node(end.position)) for end in ends]
    added: dict[str, float] = {}
    out = dict(curves)
    # Of two curves that end in each other the wider one is continued.
    for name in sorted(curves, key=lambda key: -ways.depths(curves[key]).sum()):
        last = ways.node(curves[name][-1])
        here, depth = ways.points[last], float(ways.depth[last])
        # A curve may end in a continued vessel, as one vertebral artery in the other.
        others = [out[key] for key in added] + [end.position[None] for end in ends]
        gaps = [np.linalg.norm(other - here, axis=1).min() for other in others]
        if min(gaps) < max(3.0 * depth, 6e-3):
            continue
        rests = []
        for path in paths:
            gap = np.linalg.norm(ways.points[path] - here, axis=1)
            at = int(gap.argmin())
            if gap[at] < max(ways.depth[path[at]], 1.5e-3) and len(path) - at > 3:
                rests.append(path[at:])
        if rests:
            rest = max(rests, key=lambda path: ways.depth[path].sum())[1:]
            added[name] = ways.length(rest)
            out[name] = np.concatenate([curves[name], ways.points[rest]])
    return out, added


def _ahead(ways: Ways, way: np.ndarray, toward: np.ndarray) -> bool:
    """Whether two paths from one node start towards the same side."""
    step = min(10, len(way) - 1, len(toward) - 1)
    here = ways.points[way[0]]
    one, other = (ways.points[each[step]] - here for each in (way, toward))
    return float(one @ other) > 0.0
