"""Shortest and deepest ways through a lumen, on a lattice of its inside."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy import geodesic
from cathsim_dmc.anatomy.scan.centring import resample
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

LATTICE = 1e-3  # m, spacing of the lattice on which ways are searched
CELL = 0.2e-3  # m by which depths of its points are less than radii, in the mean
CORRIDOR = 2e-3  # m, distance from a drawn curve at which a way costs twice
SHALLOW = 0.2e-3  # m, lattice points nearer to the wall are no way
# A narrow place splits that lattice. There a finer one joins the pieces again.
FINE = 0.2e-3  # m, its spacing
FINE_SHALLOW = 0.02e-3  # m
REACH = 6e-3  # m, gap between two pieces that is searched
PIECE = 30  # lattice points; smaller pieces are noise of the lattice
NEAR = 2.5e-3  # m, of a place in the lumen to the lattice, if it belongs to it


class Ways:
    """Shortest and deepest ways through a lumen.

    Attributes:
        points: (n, 3) m, the lattice's points in the lumen.
        depth: (n,) m, of each.
        main: (n,) bool, in the largest connected piece.
        pinches: (k, 3) m, where pieces were joined through a narrow place.
    """

    def __init__(self, field: SurfaceDepth, spacing: float = LATTICE):
        """Build the lattice graph of a depth ``field`` (26 neighbours)."""
        low, high = field.box
        size = np.ceil((high - low) / spacing).astype(int) + 1
        ijk, depth = geodesic.inside(field, low, size, spacing, SHALLOW)
        points = low + spacing * ijk
        shape = tuple((ijk.max(axis=0) + 3).tolist())
        key = np.asarray(np.ravel_multi_index(tuple((ijk + 1).T), shape))
        order = np.argsort(key)
        self.points, self.depth, key = points[order], depth[order], key[order]
        rows, cols, lengths = [], [], []
        stride = (shape[1] * shape[2], shape[2], 1)
        offsets = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), -1)
        for offset in offsets.reshape(-1, 3)[14:]:
            at = np.searchsorted(key, key + offset @ np.asarray(stride))
            at = np.minimum(at, len(key) - 1)
            found = key[at] == key + offset @ np.asarray(stride)
            rows.append(np.nonzero(found)[0])
            cols.append(at[found])
            lengths.append(np.full(found.sum(), spacing * np.linalg.norm(offset)))
        self._rows, self._cols = np.concatenate(rows), np.concatenate(cols)
        self._lengths = np.concatenate(lengths)
        self._pattern: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._reach: dict[int, np.ndarray] = {}
        self._before: dict[int, np.ndarray] = {}
        self.pinches = np.empty((0, 3))
        self._join(field)
        label = self._pieces()
        self.main = label == np.bincount(label).argmax()
        self._nodes = np.nonzero(self.main)[0]
        self._lookup = cKDTree(self.points[self.main])

    def _pieces(self) -> np.ndarray:
        return connected_components(self._graph(self._lengths), directed=False)[1]

    def _join(self, field: SurfaceDepth) -> None:
        """Connect pieces of the lattice through places narrower than its cells."""
        label = self._pieces()
        sizes = np.bincount(label)
        if (sizes >= PIECE).sum() < 2:
            return
        pinches = []
        trees = {
            k: (np.nonzero(label == k)[0], cKDTree(self.points[label == k]))
            for k in np.nonzero(sizes >= PIECE)[0]
        }
        for number, (one, (_, tree)) in enumerate(trees.items()):
            for other in list(trees)[number + 1 :]:
                nodes = trees[other][0]
                gap, _ = tree.query(self.points[nodes], distance_upper_bound=REACH)
                # Several places: the nearest may lie across the wall between two.
                for row in _scattered(self.points[nodes], gap):
                    middle = self.points[nodes[row]]
                    if self._bridge(field, middle, label, one, other):
                        pinches.append(middle)
                        break
        self.pinches = np.array(pinches).reshape(-1, 3)

    def _bridge(self, field, middle, label, one, other) -> bool:
        """Add the deepest fine way near ``middle`` from one piece to another."""
        steps = np.arange(-REACH - 1e-3, REACH + 1e-3, FINE)
        local = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1)
        points = middle + local.reshape(-1, 3)
        depth = field(points)
        keep = depth > FINE_SHALLOW
        points, depth = points[keep], depth[keep]
        pairs = cKDTree(points).query_pairs(1.8 * FINE, output_type="ndarray")
        if not len(pairs):
            return False
        ends = []
        for piece in (one, other):
            nodes = np.nonzero(label == piece)[0]
            gap, near = cKDTree(self.points[nodes]).query(points)
            close = np.nonzero(gap < FINE)[0]
            ends.append((close, nodes[near[close]]))
        if not all(len(close) for close, _ in ends):
            return False
        step = np.linalg.norm(np.diff(points[pairs], axis=1)[:, 0], axis=1)
        price = step * (FINE / depth[pairs].min(axis=1)) ** 2
        graph = csr_matrix((price, pairs.T), shape=(len(points),) * 2)
        cost, before, _ = dijkstra(
            graph,
            directed=False,
            indices=ends[0][0],
            return_predecessors=True,
            min_only=True,
        )
        last = int(cost[ends[1][0]].argmin())
        if not np.isfinite(cost[ends[1][0][last]]):
            return False
        way = [int(ends[1][0][last])]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        first = int(ends[0][1][np.nonzero(ends[0][0] == way[-1])[0][0]])
        fresh = len(self.points) + np.arange(len(way))
        chain = np.concatenate([[ends[1][1][last]], fresh, [first]])
        self.points = np.concatenate([self.points, points[way]])
        self.depth = np.concatenate([self.depth, depth[way]])
        gaps = np.linalg.norm(np.diff(self.points[chain], axis=0), axis=1)
        self._rows = np.concatenate([self._rows, chain[:-1]])
        self._cols = np.concatenate([self._cols, chain[1:]])
        self._lengths = np.concatenate([self._lengths, np.maximum(gaps, 1e-6)])
        return True

    def _graph(self, weights: np.ndarray) -> csr_matrix:
        """The lattice's links with ``weights`` (e,), in one direction."""
        n = len(self.points)
        if self._pattern is None or len(self._pattern[0]) != len(weights):
            # Sorting the links takes longer than the searches: once is enough.
            numbers = np.arange(len(weights), dtype=np.float64)
            sorted_ = csr_matrix((numbers, (self._rows, self._cols)), shape=(n, n))
            order = sorted_.data.astype(np.int64)
            self._pattern = (order, sorted_.indices, sorted_.indptr)
        order, indices, indptr = self._pattern
        return csr_matrix((weights[order], indices, indptr), shape=(n, n))

    @property
    def nodes(self) -> np.ndarray:
        """Rows (m,) of the points in the largest connected piece."""
        return self._nodes

    @property
    def links(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows (e,) and (e,) of neighbouring points."""
        return self._rows, self._cols

    def node(self, position: np.ndarray) -> int:
        """Lattice point nearest to ``position`` (3,) m in the largest piece."""
        return int(self._nodes[self._lookup.query(position)[1]])

    def checked_node(self, position: np.ndarray, what: str) -> int:
        """As ``node``, for a place that must be connected to the rest of the lumen.

        Raises:
            ValueError: if the lumen is closed between that place and the rest.
        """
        node = self.node(position)
        if np.linalg.norm(self.points[node] - position) > NEAR:
            # Points hug the wall where a curve runs into its vessel's end.
            own = int(np.linalg.norm(self.points - position, axis=1).argmin())
            if not self.main[own]:
                raise ValueError(
                    f"{what} lies in a part of the lumen that is closed off: between "
                    f"it and the rest the lumen is narrower than "
                    f"{2 * FINE * 1e3:g} mm. Open the vessel in the segmentation, or "
                    "leave this branch out."
                )
        return node

    def around(self, node: int, radius: float) -> np.ndarray:
        """Rows (m,) of the points in a ball (m) that are joined to its middle in it."""
        near = self._nodes[self._lookup.query_ball_point(self.points[node], radius)]
        part = self._graph(self._lengths)[near][:, near]
        label = connected_components(part, directed=False)[1]
        return near[label == label[near == node]]

    def lengths_from(self, node: int) -> np.ndarray:
        """Length (n,) m of the shortest way from ``node`` to every point."""
        if node not in self._reach:
            graph = self._graph(self._lengths)
            self._reach[node] = dijkstra(graph, directed=False, indices=node)
        return self._reach[node]

    def deepest_from(self, node: int) -> np.ndarray:
        """Predecessors (n,) on the deepest ways from ``node``.

        A step costs its length over the fourth power of the depth, as blood flow
        does (Poiseuille): a way keeps to the middle, and in a ring of vessels it
        takes the artery, not the thin communicating one.
        """
        if node not in self._before:
            depth = 0.5 * (self.depth[self._rows] + self.depth[self._cols])
            graph = self._graph(self._lengths * (LATTICE / depth) ** 4)
            _, self._before[node] = dijkstra(
                graph, directed=False, indices=node, return_predecessors=True
            )
        return self._before[node]

    def along(self, curve: np.ndarray, name: str) -> np.ndarray:
        """Deepest way (m, 3) near ``curve`` (n, 3) m, from its start to its end.

        Depth decides, but leaving the curve by ``CORRIDOR`` doubles the price, so
        that a drawn curve chooses the vessel and the lumen the way through it.
        """
        tree = cKDTree(resample(curve))
        off = tree.query(self.points, distance_upper_bound=5.0 * CORRIDOR)[0]
        off = np.minimum(off, 5.0 * CORRIDOR)
        price = (LATTICE / self.depth) ** 2 * (1.0 + (off / CORRIDOR) ** 2)
        weights = self._lengths * 0.5 * (price[self._rows] + price[self._cols])
        start = self.checked_node(curve[0], f"the start of centreline {name!r}")
        end = self.checked_node(curve[-1], f"the end of centreline {name!r}")
        graph = self._graph(weights)
        # Few ways leave the corridor; where one must, the whole lumen is searched.
        near = off < 5.0 * CORRIDOR
        near[[start, end]] = True
        kept = np.flatnonzero(near)
        ends = np.searchsorted(kept, [start, end])
        cost, before = dijkstra(
            graph[kept][:, kept],
            directed=False,
            indices=ends[0],
            return_predecessors=True,
        )
        if np.isfinite(cost[ends[1]]):
            return self.points[kept[self.trace(before, int(ends[1]))]]
        _, before = dijkstra(
            graph, directed=False, indices=start, return_predecessors=True
        )
        return self.points[self.trace(before, end)]

    def trace(self, before: np.ndarray, node: int) -> np.ndarray:
        """Nodes of the way that ends at ``node``, first to last."""
        way = [node]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        return np.asarray(way[::-1])


def _scattered(points: np.ndarray, gap: np.ndarray) -> list[int]:
    """Rows of the smallest gaps that lie apart, at most four."""
    chosen: list[int] = []
    for row in np.argsort(gap):
        if not np.isfinite(gap[row]) or len(chosen) == 4:
            break
        apart = np.linalg.norm(points[chosen] - points[row], axis=1) if chosen else ()
        if not chosen or np.min(apart) > REACH:
            chosen.append(int(row))
    return chosen
