"""Free ends of a lumen: where its vessels end blindly, and which are aneurysms."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.anatomy.scan.rings import COVER, Cover
from cathsim_dmc.anatomy.scan.topology import groups
from cathsim_dmc.anatomy.scan.ways import Ways, common, in_reach

END_SEARCH = 15e-3  # m from a blind end, within which its width is measured
STUB = 3e-3  # m, least length of the own part of a vessel
# A blind end hidden by branches beside it: its least length past their fork and largest
# width of the branches, in widths at the fork; its least width in that of other ends.
BLIND, BESIDE, WIDER = 1.3, 0.5, 1.2
STUMP = 500  # least number of lattice points of a wide vessel that is cut off
# A sac is about as long as wide: every path out of it narrows to NECK of its largest
# radius within SAC_LENGTH of these radii from its end.
NECK, SAC_LENGTH = 0.5, 3.2


class FreeEnd(NamedTuple):
    """A blind end of the lumen: place (3,) and radius near it, m.

    `bottleneck` is the radius, m, of the largest sphere that passes from the end to the
    widest part.
    """

    position: np.ndarray
    radius: float
    bottleneck: float


def free_ends(ways: Ways) -> list[FreeEnd]:
    """Blind ends of the lumen, without bulges."""
    nodes = ways.nodes
    centre = int(nodes[ways.depth[nodes].argmax()])
    before = ways.deepest_from(centre)
    # Every other blind end is a local maximum of the distance from this one.
    first = int(nodes[ways.lengths_from(centre)[nodes].argmax()])
    reach = ways.lengths_from(first)
    # Own parts are those of paths to that end: the widest point may be an end, too.
    back = ways.deepest_from(first)
    taken = np.zeros(len(ways.points), dtype=bool)
    cover, ends = Cover(ways), []
    # Nodes of the largest component without a farther neighbour.
    rows, cols = ways.links.T
    top = ways.main.copy()
    top[rows[reach[cols] > reach[rows]]] = False
    top[cols[reach[rows] > reach[cols]]] = False
    tips = np.flatnonzero(top)
    for node in [first, *tips[np.argsort(-reach[tips])]]:
        covered = not len(cover.own_part(np.array([node])))
        if taken[node] or (node != first and covered):
            continue
        way = ways.trace(before, node)[::-1]
        along, depth = arc_lengths(ways.points[way]), ways.depth[way]
        local = float(depth[along < END_SEARCH].max())
        near = ways.around(node, 2.5 * local)
        taken[near] = True
        if node != first:
            if reach[near].max() > reach[node] + 1e-9:
                continue
            path = ways.trace(back, node)[::-1]
            own = cover.own_part(path)
            if ways.length(own) < max(STUB, float(np.median(ways.depth[own]))):
                continue  # a bulge of a known vessel
            cover.add(path)
        # The depth falls to zero at the end itself, which is no bottleneck.
        inner = along > 2.0 * local
        narrow = float(depth[inner].min()) if inner.any() else local
        part = (along > 0.5 * local) & (along < END_SEARCH)
        radius = float(np.median(depth[part])) if part.any() else local
        ends.append(FreeEnd(ways.points[node], radius, narrow))
    blind = _blind_end(ways, ends, tips[np.argsort(-reach[tips])], back)
    return ends if blind is None else [*ends, blind]


def _blind_end(
    ways: Ways, ends: Sequence[FreeEnd], tips: np.ndarray, back: np.ndarray
) -> FreeEnd | None:
    """The end of the widest vessel, if thin branches beside it hide it.

    The coronary arteries hide the root of the aorta in this way. `tips` (n,) are nodes,
    `back` (m,) the predecessors of all nodes on deepest paths from the first end.
    """
    traces = [ways.trace(back, ways.node(end.position)) for end in ends[1:]]
    known = np.array([end.position for end in ends])
    widest = WIDER * max(end.bottleneck for end in ends)
    for tip in tips:
        path = ways.trace(back, tip)
        shared = [common(path[:, None], way[:, None]) for way in traces]
        at = max(shared, default=1) - 1
        place, wide = ways.points[path[at]], float(ways.depth[path[at]])
        away = np.linalg.norm(ways.points[path[at:]] - ways.points[tip], axis=1)
        if wide < widest or away[0] < BLIND * wide:
            continue
        if np.linalg.norm(known - ways.points[tip], axis=1).min() < 2.0 * wide:
            continue
        # The end is wide up to its tip, the paths to other ends leave it by thin
        # branches, and unlike an aneurysm it is joined to another end by a wide lumen.
        if (ways.depth[path[at:]] < BESIDE * np.minimum(wide, away)).any():
            continue
        beside = [
            way[at:] for way, n in zip(traces, shared, strict=True) if n == at + 1
        ]
        if not all(_leaves_thin(ways, way, place, wide) for way in beside):
            continue
        before = ways.deepest_from(int(tip))
        if any(_joined(ways, before, end, wide) for end in ends):
            return FreeEnd(ways.points[tip], wide, wide)
    return None


def _leaves_thin(ways: Ways, way: np.ndarray, place: np.ndarray, wide: float) -> bool:
    """Whether a path continues, far from a wide place (3,) m, only in a thin branch."""
    far = np.linalg.norm(ways.points[way] - place, axis=1) > 2.0 * wide
    return bool(far.any() and (ways.depth[way[far]] < BESIDE * wide).all())


def _joined(ways: Ways, before: np.ndarray, end: FreeEnd, wide: float) -> bool:
    """Whether the deepest path to an end stays wider than `BESIDE` of `wide` (m)."""
    way = ways.trace(before, ways.node(end.position))
    inner = arc_lengths(ways.points[way])
    inner = np.minimum(inner, inner[-1] - inner) > wide
    return bool(inner.any() and (ways.depth[way[inner]] > BESIDE * wide).all())


def stump(ways: Ways, ends: Sequence[FreeEnd]) -> FreeEnd | None:
    """The end of a wide vessel that is cut off less than its width past a branch.

    It is the largest part of the lumen away from all paths between the free ends.
    """
    wide = ways.node(max(ends, key=lambda end: end.bottleneck).position)
    before = ways.deepest_from(wide)
    traces = [ways.trace(before, ways.node(end.position)) for end in ends]
    centres = np.unique(np.concatenate(traces))
    places, reach = ways.points[centres], COVER * ways.depth[centres] + 1e-3
    beyond = ways.main & ~in_reach(ways.points, places, reach)
    label = groups(len(beyond), ways.links[beyond[ways.links].all(axis=1)])
    sizes = np.bincount(label, beyond)
    piece = np.flatnonzero(beyond & (label == sizes.argmax()))
    if len(piece) < STUMP:
        return None
    last = int(piece[cKDTree(places).query(ways.points[piece])[0].argmax()])
    radius = float(ways.depth[ways.around(last, END_SEARCH)].max())
    return FreeEnd(ways.points[last], radius, radius)


def is_sac(ways: Ways, nodes: Sequence[int], row: int) -> bool:
    """Whether the end `nodes[row]` is that of an aneurysm, not of a vessel.

    `nodes` are those of all free ends. A vessel keeps its width for longer than a sac.
    """
    before = ways.deepest_from(nodes[row])
    for node in [*nodes[:row], *nodes[row + 1 :]]:
        way = ways.trace(before, node)
        depth = ways.depth[way]
        wide = np.maximum.accumulate(depth)
        away = np.linalg.norm(ways.points[way] - ways.points[way[0]], axis=1)
        if not ((depth < NECK * wide) & (away < SAC_LENGTH * wide)).any():
            return False
    return len(nodes) > 1
