"""Nodes covered by known vessels, and rings of vessels, which have no free end."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.distance import cdist

from cathsim_dmc.anatomy.scan.topology import groups
from cathsim_dmc.anatomy.scan.ways import Ways, common

COVER = 1.5  # radii around a path that belong to its vessel
# A ring of vessels has no free end: two paths from the inlet meet in it. They come from
# different vessels if their points BACK upstream are farther apart than these widths.
BACK = 25e-3  # m
APART = 1.5  # of the sum of both depths
APART_MIN = 4e-3  # m
RING = 40e-3  # m, shortest ring


class Cover:
    """Nodes in or close to vessels that are already known."""

    def __init__(self, ways: Ways, *known: np.ndarray):
        """Covers the known paths (n,) of nodes."""
        self._ways = ways
        self._centres, self._reach = np.empty((0, 3)), np.empty(0)
        for way in known:
            self.add(way)

    def add(self, way: np.ndarray) -> None:
        """Cover the surroundings of a path (n,) of nodes."""
        # Every other point suffices: their spheres overlap.
        way = way[::2]
        self._centres = np.concatenate([self._centres, self._ways.points[way]])
        reach = COVER * self._ways.depth[way] + 1e-3
        self._reach = np.concatenate([self._reach, reach])

    def own_part(self, way: np.ndarray, *, wall: bool = False) -> np.ndarray:
        """Nodes of a path, given from its tip on, up to the first covered one.

        With `wall`, up to the wall of a known vessel.
        """
        reach = (self._reach - 1e-3) / COVER if wall else self._reach
        gap = cdist(self._ways.points[way], self._centres)
        met = (gap < reach).any(axis=1)
        return way[: int(met.argmax())] if met.any() else way

    def beyond(self, way: np.ndarray) -> np.ndarray:
        """A path (n,) of nodes up to the last one that is not covered."""
        gap = cdist(self._ways.points[way], self._centres)
        free = np.flatnonzero(~(gap < self._reach).any(axis=1))
        return way[: int(free[-1]) + 1] if len(free) else way[:0]


def rings(ways: Ways, before: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields, for each ring of vessels, two paths from the inlet whose ends touch."""
    up = _upstream(ways, before)
    one, other = up[ways.links.T]
    links = ways.links[one != other]
    back = up[links]
    gap = np.linalg.norm(np.diff(ways.points[back], axis=1)[:, 0], axis=1)
    wide = ways.depth[back].sum(axis=1)
    apart = gap > APART * wide + APART_MIN
    # Nearer paths also come from different vessels if a wall is between them.
    near = np.flatnonzero(~apart & (gap > wide + APART_MIN) & ways.main[links[:, 0]])
    here, there = ways.points[back[near]].swapaxes(0, 1)
    apart[near] = ways.walled(here, there)
    links = links[ways.main[links[:, 0]] & apart]
    depth = ways.depth[links].min(axis=1)
    label = groups(len(ways.points), links)[links[:, 0]]
    for key in np.unique(label):
        # Of each group of links the deepest.
        at = int(np.where(label == key, depth, -np.inf).argmax())
        one, other = (ways.trace(before, int(node)) for node in links[at])
        shared = common(ways.points[one], ways.points[other])
        own = [way[shared:] for way in (one, other)]
        if depth[at] >= ways.device and sum(map(ways.length, own)) > RING:
            yield one, other


def _upstream(ways: Ways, before: np.ndarray) -> np.ndarray:
    """Node (n,) that is ``BACK`` upstream of each node, or the start of its path."""
    here, gone = np.arange(len(ways.points)), np.zeros(len(ways.points))
    up = np.where(before >= 0, before, here)
    step = np.linalg.norm(ways.points - ways.points[up], axis=1)
    while (fits := (up[here] != here) & (gone + step[here] <= BACK)).any():
        gone[fits] += step[here[fits]]
        here[fits] = up[here[fits]]
    return here


def round_ring(cover: Cover, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """One path around a ring: along the side that leaves first, then the other side.

    If the sides meet in a known vessel, it is the side that is not known.
    """
    if not len(cover.own_part(one[-1:])) or not len(cover.own_part(other[-1:])):
        sides = [cover.beyond(way) for way in (one, other)]
        return max(sides, key=lambda way: len(cover.own_part(way[::-1])))
    own = [cover.own_part(way[::-1])[::-1] for way in (one, other)]
    alone = [len(way) - len(part) for way, part in zip((one, other), own, strict=True)]
    if alone[1] < alone[0]:
        one, other, own = other, one, own[::-1]
    return np.concatenate([one, own[1][::-1]])
