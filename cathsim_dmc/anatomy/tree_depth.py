"""True distance to the wall of a vessel tree, inside and outside of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cathsim_dmc.anatomy.centreline import Array, Centreline, VesselTree
from cathsim_dmc.anatomy.parts import End
from cathsim_dmc.anatomy.tree_depth_loops import onto_creases, tree_depths

# Farther from the wall than this, m, another vessel does not matter to a point.
_SLACK = 3e-3
# Points around a ring from which creases are looked for, and their way to one, m.
_AROUND = 120
_SEED = 1.5e-3
_APART = 0.1e-3
_GROUP = 2.5  # points along each axis of a group, about
# Projections on the one wall and the other; walls that meet at 30° take the most.
_ROUNDS = 30
_ON_BOTH = 5e-6  # m


class TreeDepth:
    """Distance to the wall of a union of tubes.

    A tube is the union of its cross-sections: rings around the centreline, across it,
    whose centres, directions and radii change linearly between its points. Next to a
    tapered wall and within an ostium, `VesselTree.depths` (radius less distance from
    the centreline) is not the distance to the wall; this is. Where a ring lies in
    another vessel there is no wall, and where two walls meet there is an edge, a
    crease, which is kept as points. Closed ends are flat walls; an open end goes on as
    a straight tube.
    """

    def __init__(self, tree: VesselTree, ends: Sequence[End] = ()):
        """Finds the creases.

        Args:
            ends: flat ends of the tree; those that are not named are closed.
        """
        lines = [vessel.centreline for vessel in tree.vessels.values()]
        self._nodes = np.concatenate([_rings(line) for line in lines])
        stops = np.cumsum([len(line.points) for line in lines])
        starts = np.concatenate([[0], stops[:-1]])
        self._spans = np.stack([starts, stops - 1], axis=1)
        free = [end.position for end in ends if end.open]
        self._flats = np.array(
            [
                [
                    2 if row and not at_end else int(not _among(free, line, at_end))
                    for at_end in (0, 1)
                ]
                for row, line in enumerate(lines)
            ]
        )
        self._creases = self._find_creases()

    def __call__(self, points: Array) -> Array:
        """Signed distances (n,) m at points (n, 3) m, > 0 inside."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        return self.around(points, np.zeros((1, 3)))[:, 0]

    def around(self, blocks: Array, points: Array) -> Array:
        """Signed distances (n, m) m at blocks (n, 3) + points (m, 3) m, > 0 inside."""
        blocks, points = np.asarray(blocks), np.asarray(points)
        groups, middles, reaches = _grouped(points)
        out = np.empty((len(blocks), len(points)))
        tree_depths(
            self._nodes,
            self._spans,
            self._flats,
            self._creases,
            np.ascontiguousarray(blocks, dtype=np.float64),
            np.ascontiguousarray(points, dtype=np.float64),
            float(np.linalg.norm(points, axis=1).max()),
            groups,
            middles,
            reaches,
            _SLACK,
            out,
        )
        return out

    @property
    def box(self) -> tuple[Array, Array]:
        """Corners (3,), (3,) of a box around the lumen, m."""
        return _box(self._nodes)

    def _find_creases(self) -> Array:
        found = [np.empty((0, 3))]
        count = len(self._spans)
        for one in range(count):
            for two in range(one + 1, count):
                seeds = self._on_walls(two)
                first, last = self._spans[one]
                low, high = _box(self._nodes[first : last + 1])
                seeds = seeds[((seeds > low) & (seeds < high)).all(axis=1)]
                seeds = seeds[np.abs(self._onto(one, two, seeds, 0)[:, 0]) < _SEED]
                left = self._onto(one, two, seeds, _ROUNDS)
                seeds = seeds[(np.abs(left) < _ON_BOTH).all(axis=1)]
                for other in set(range(count)) - {one, two}:
                    inside = self._onto(other, two, seeds, 0)[:, 0] > _ON_BOTH
                    seeds = seeds[~inside]
                # Many seeds come to one place.
                _, kept = np.unique(np.rint(seeds / _APART), axis=0, return_index=True)
                found.append(seeds[kept])
        return np.concatenate(found)

    def _onto(self, one: int, two: int, seeds: Array, rounds: int) -> Array:
        """Moves seeds (n, 3) onto both walls; their depths (n, 2) in both, m."""
        left = np.empty((len(seeds), 2))
        onto_creases(
            self._nodes, self._spans, self._flats, one, two, seeds, rounds, left
        )
        return left

    def _on_walls(self, vessel: int) -> Array:
        """Points (n, 3) on the rings of a vessel, m."""
        first, last = self._spans[vessel]
        nodes = self._nodes[first : last + 1]
        across = np.eye(3)[np.abs(nodes[:, 3:6]).argmin(axis=1)]
        u = np.cross(nodes[:, 3:6], across)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        v = np.cross(nodes[:, 3:6], u)
        angle = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)[:, None, None]
        spokes = np.cos(angle) * u + np.sin(angle) * v
        return (nodes[:, :3] + nodes[:, 6:] * spokes).reshape(-1, 3)


def _rings(line: Centreline) -> Array:
    """Centres, unit tangents and radii (n, 7) of the rings at a centreline's points."""
    steps = np.diff(line.points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return np.concatenate([line.points, tangents, line.radii[:, None]], axis=1)


def _grouped(points: Array) -> tuple[np.ndarray, Array, Array]:
    along = max(1, round(len(points) ** (1 / 3) / _GROUP))
    size = max(float(np.ptp(points, axis=0).max()), 1e-9) / along
    cells = ((points - points.min(axis=0)) / size).astype(int).clip(0, along - 1)
    _, groups = np.unique(cells @ (1, along, along**2), return_inverse=True)
    middles, reaches = [], []
    for group in range(groups.max() + 1):
        own = points[groups == group]
        middles.append(own.mean(axis=0))
        reaches.append(np.linalg.norm(own - middles[-1], axis=1).max())
    return groups, np.array(middles), np.array(reaches)


def _box(nodes: Array) -> tuple[Array, Array]:
    centres, radii = nodes[:, :3], nodes[:, 6:]
    return (centres - radii).min(axis=0), (centres + radii).max(axis=0)


def _among(places: Sequence[Array], line: Centreline, at_end: int) -> bool:
    """Whether an end of a centreline is one of some places."""
    point = line.points[-at_end]
    return any(np.linalg.norm(point - place) < 1e-6 for place in places)
