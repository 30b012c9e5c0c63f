"""Free ends of a lumen, and the one by which the device enters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from cathsim_dmc.anatomy.scan.ways import Ways

END_SEARCH = 15e-3  # m from a blind end in which its width is looked for
COVER = 1.5  # radii; what lies nearer to a way is no vessel of its own
STUB = 3e-3  # m, shortest own vessel beyond that
WIDE = 0.4  # of the widest free end: narrower ends are no inlet by default
ROOT_WIDTH = 0.5  # of the inlet: narrower free ends do not continue the root
STARTS = 30e-3  # m along the lumen; curves that start nearer to an end start there


@dataclass(frozen=True)
class FreeEnd:
    """A blind end of the lumen.

    Attributes:
        position: (3,) m.
        radius: m, of the lumen near the end.
        bottleneck: m, largest sphere that reaches the widest part from here.
    """

    position: np.ndarray
    radius: float
    bottleneck: float


class Cover:
    """Nodes in or close to vessels that are already known."""

    def __init__(self, ways: Ways):
        """Nothing is covered yet."""
        self._ways = ways
        self._centres = np.empty((0, 3))
        self._reach = np.empty(0)

    def add(self, way: np.ndarray) -> None:
        """Cover the surroundings of a way (n,) of nodes."""
        # Every other point does: their spheres overlap.
        way = way[::2]
        self._centres = np.concatenate([self._centres, self._ways.points[way]])
        reach = COVER * self._ways.depth[way] + 1e-3
        self._reach = np.concatenate([self._reach, reach])

    def covers(self, nodes: np.ndarray) -> np.ndarray:
        """Whether each of some nodes (n,) is covered."""
        if not len(self._centres):
            return np.zeros(len(nodes), dtype=bool)
        points = self._ways.points[nodes]
        out = np.empty(len(nodes), dtype=bool)
        for first in range(0, len(nodes), 256):
            part = slice(first, first + 256)
            gap = cdist(points[part], self._centres)
            out[part] = (gap < self._reach).any(axis=1)
        return out

    def own_part(self, way: np.ndarray) -> np.ndarray:
        """Nodes of a way, given from its tip on, before it meets what is covered."""
        met = self.covers(way)
        return way[: int(met.argmax())] if met.any() else way


def length_of(ways: Ways, way: np.ndarray) -> float:
    """Length (m) of a way (n,) of nodes."""
    return float(np.linalg.norm(np.diff(ways.points[way], axis=0), axis=1).sum())


def free_ends(ways: Ways) -> list[FreeEnd]:
    """Blind ends of the lumen, bulges left out."""
    nodes = ways.nodes
    centre = int(nodes[ways.depth[nodes].argmax()])
    before = ways.deepest_from(centre)
    # Seen from one blind end, every other one is farther than all around it.
    first = int(nodes[ways.lengths_from(centre)[nodes].argmax()])
    reach = ways.lengths_from(first)
    # Own vessels are told on the ways to that end: the widest place may be one, too.
    back = ways.deepest_from(first)
    taken = np.zeros(len(ways.points), dtype=bool)
    cover, ends = Cover(ways), []
    tips = _local_maxima(ways, reach)
    for node in [first, *tips[np.argsort(-reach[tips])]]:
        if taken[node] or (node != first and cover.covers(np.array([node]))[0]):
            continue
        way = ways.trace(before, node)[::-1]
        steps = np.linalg.norm(np.diff(ways.points[way], axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        local = float(ways.depth[way][along < END_SEARCH].max())
        near = ways.around(node, 2.5 * local)
        taken[near] = True
        if node != first and reach[near].max() > reach[node] + 1e-9:
            continue
        if node != first:
            path = ways.trace(back, node)[::-1]
            own = cover.own_part(path)
            own_length = length_of(ways, own) if len(own) > 1 else 0.0
            width = float(np.median(ways.depth[own])) if len(own) else 0.0
            if own_length < max(STUB, width):
                continue  # a bulge of a vessel that is known
            cover.add(path)
        # The depth falls to nothing at the very end, which is no bottleneck.
        inner = along > 2.0 * local
        narrow = float(ways.depth[way][inner].min()) if inner.any() else local
        part = (along > 0.5 * local) & (along < END_SEARCH)
        radius = float(np.median(ways.depth[way][part])) if part.any() else local
        ends.append(FreeEnd(ways.points[node], radius, narrow))
    if not ends:
        raise ValueError(
            "the lumen has no free end; give a mesh of a tube-like vessel with at "
            "least one end for the device to enter by."
        )
    return ends


def _local_maxima(ways: Ways, reach: np.ndarray) -> np.ndarray:
    """Nodes of the largest piece from which no neighbour is farther."""
    rows, cols = ways.links
    top = ways.main.copy()
    top[rows[reach[cols] > reach[rows]]] = False
    top[cols[reach[rows] > reach[cols]]] = False
    return np.flatnonzero(top)


@dataclass(frozen=True)
class LumenEntry:
    """Where the device enters and where the root vessel leads.

    Attributes:
        position: (3,) m.
        at_end: whether that is a free end, or a place where the lumen is cut.
        far: (3,) m, far end of the root, or None.
    """

    position: np.ndarray
    at_end: bool
    far: np.ndarray | None


def plan_inlet(
    ways: Ways,
    ends: Sequence[FreeEnd],
    curves: Sequence[np.ndarray],
    inlet: np.ndarray | None,
) -> LumenEntry:
    """Choose where the device enters and where the root vessel leads.

    Args:
        ways: of the lumen.
        ends: its free ends.
        curves: (n_i, 3) m, given centrelines, first point proximal; may be empty.
        inlet: (3,) m near the end to use or in the middle of a vessel that is to be
            cut there, or None to choose: the end at which the curves start, else the
            wide end farthest along the lumen from their starts. Without curves it is
            the widest.

    Raises:
        ValueError: if no end can be chosen; lists them.
    """
    position = np.stack([end.position for end in ends])
    width = np.array([end.bottleneck for end in ends])
    nodes = [ways.node(end) for end in position]
    at_goal = _ends_of_curves(ways, ends, [curve[-1] for curve in curves])
    if inlet is not None:
        gap = np.linalg.norm(position - inlet, axis=-1)
        chosen = int(gap.argmin())
        # Beyond the last place where the vessel has its width, there is nothing to
        # cut off but the end itself.
        if gap[chosen] > 2.5 * ends[chosen].radius:
            return LumenEntry(
                inlet, False, _far_end(ways, ends, at_goal, ways.node(inlet), curves)
            )
    elif curves:
        chosen = _chosen_by_curves(ways, ends, nodes, at_goal, curves)
    else:
        chosen = int(width.argmax())
    far = _far_end(ways, ends, at_goal, nodes[chosen], curves, chosen)
    return LumenEntry(position[chosen], True, far)


def _ends_of_curves(ways, ends, lasts) -> np.ndarray:
    """Which ends (e,) are the distal end of a given curve."""
    at_goal = np.zeros(len(ends), dtype=bool)
    for last in lasts:
        gap = np.array([np.linalg.norm(end.position - last) for end in ends])
        reach = np.array([max(2.5 * end.radius, 4e-3) for end in ends])
        nearest = int((gap / reach).argmin())
        at_goal[nearest] |= gap[nearest] < reach[nearest]
    return at_goal


def _chosen_by_curves(ways, ends, nodes, at_goal, curves) -> int:
    starts = [ways.node(curve[0]) for curve in curves]
    reach = np.stack([ways.lengths_from(node)[nodes] for node in starts])
    near = np.where(at_goal, np.inf, reach.min(axis=0))
    behind = np.ones(len(ends), dtype=bool)
    for row, curve in zip(reach, curves, strict=True):
        # The curve leads away from the end at which it starts.
        there = ways.lengths_from(ways.node(curve[-1]))[nodes]
        behind &= there > row
    near = np.where(behind, near, np.inf)
    if near.min() < STARTS:
        return int(near.argmin())
    width = np.array([end.bottleneck for end in ends])
    wide = ~at_goal & (width >= WIDE * width[~at_goal].max(initial=0.0))
    if not wide.any():
        raise ValueError(
            "every free end of the lumen is the end of a given centreline; pass "
            f"inlet=(x, y, z) near the end by which the device enters: {listed(ends)}."
        )
    return int(np.where(wide, reach[0], -np.inf).argmax())


def _far_end(ways, ends, at_goal, node, curves, chosen=None) -> np.ndarray | None:
    """The widest other end, if a wide vessel leads there from the inlet's node.

    Where the lumen is cut at the inlet, ends behind it are no candidates: they are
    nearer to the inlet than to the places where the curves end.
    """
    position = np.stack([end.position for end in ends])
    width = np.array([end.bottleneck for end in ends])
    reach = ways.lengths_from(node)
    nodes = [ways.node(point) for point in position]
    around = ways.depth[ways.main & (reach < 25e-3)].max()
    others = ~at_goal & (reach[nodes] > 2.0 * around)
    if chosen is not None:
        others[chosen] = False
    floor = ROOT_WIDTH * around
    if curves:
        lasts = [ways.node(curve[-1]) for curve in curves]
        floor = max(floor, 1.2 * float(np.median(ways.depth[lasts])))
        if chosen is None:
            to_goal = ways.lengths_from(lasts[0])
            others &= to_goal[nodes] < reach[lasts[0]]
    others &= width > floor
    if not others.any():
        return None
    return position[np.where(others, width, -np.inf).argmax()]


def listed(ends: Sequence[FreeEnd]) -> str:
    """Ends with their places and widths, widest first, for a message."""
    ordered = sorted(ends, key=lambda end: -end.radius)
    return ", ".join(
        "({}) mm, {:.1f} mm wide".format(
            ", ".join(f"{x * 1e3:.0f}" for x in end.position), end.radius * 2e3
        )
        for end in ordered[:8]
    )
