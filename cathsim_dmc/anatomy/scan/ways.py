"""Shortest and deepest paths through a lumen, on a lattice of its inside."""

from functools import cache

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy import geodesic
from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.anatomy.scan.centring import resample
from cathsim_dmc.anatomy.scan.units import mm
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

DEVICE_RADIUS = 0.84e-3  # m, 5 Fr catheter (1 Fr = 1/3 mm diameter)
LATTICE = 1e-3  # m, spacing of the lattice on which paths are searched
CELL = 0.2e-3  # m, mean difference of radii and the depths of lattice points
CORRIDOR = 2e-3  # m, distance from a drawn curve at which a path costs twice
SHALLOW = 0.2e-3  # m, least depth of lattice points
NEAR = 2.5e-3  # m, largest distance from the lattice of a place that belongs to it


class Ways:
    """Shortest and deepest paths through a lumen.

    The lattice has `points` (n, 3) m with their `depth` (n,) m and `links` (e, 2) of
    neighbours; `main` (n,) bool is the largest component, `nodes` (m,) its indices.
    `device` is the radius (m) of the device that must pass.
    """

    def __init__(self, field: SurfaceDepth, device: float = DEVICE_RADIUS):
        """Build the lattice graph of a depth ``field`` (26 neighbours).

        ``device`` is the radius (m) for which paths are searched.
        """
        self.device = device
        low, high = field.box
        size = np.ceil((high - low) / LATTICE).astype(int) + 1
        ijk, depth = geodesic.inside(field, low, size, LATTICE, SHALLOW)
        shape = tuple((ijk.max(axis=0) + 3).tolist())
        key = np.asarray(np.ravel_multi_index(tuple((ijk + 1).T), shape))
        order = np.argsort(key)
        self.points, self.depth = (low + LATTICE * ijk)[order], depth[order]
        key, links, lengths = key[order], [], []
        stride = np.array((shape[1] * shape[2], shape[2], 1))
        for offset in np.argwhere(np.ones((3, 3, 3)))[14:] - 1:
            at = np.searchsorted(key, key + offset @ stride).clip(max=len(key) - 1)
            found = np.flatnonzero(key[at] == key + offset @ stride)
            links.append(np.stack([found, at[found]], axis=1))
            lengths.append(np.full(len(found), LATTICE * np.linalg.norm(offset)))
        self.links, self._lengths = np.concatenate(links), np.concatenate(lengths)
        # The links of a point are in order of their offsets: one stable sort is enough.
        self._order = np.argsort(self.links[:, 0], kind="stable")
        rows = self.links[self._order, 0]
        self._starts = np.searchsorted(rows, np.arange(len(self.points) + 1))
        self._near = self._graph(self._lengths)
        label = connected_components(self._near, directed=False)[1]
        self.main = label == np.bincount(label).argmax()
        self.nodes = np.flatnonzero(self.main)
        self._lookup = cKDTree(self.points[self.main])
        # A step of a deepest path costs its length over the fourth power of the depth,
        # like the resistance to flow (Poiseuille): paths keep to the middle, and in a
        # ring of vessels they take the artery, not the thin communicating one.
        depth = self.depth[self.links].mean(axis=1)
        deep = self._graph(self._lengths * (LATTICE / depth) ** 4)
        # By node: lengths (n,) m of shortest paths, predecessors (n,) on deepest paths.
        self.lengths_from = cache(lambda node: dijkstra(self._near, indices=node))
        self.deepest_from = cache(lambda node: _before(deep, node))

    def _graph(self, weights: np.ndarray) -> csr_matrix:
        """Graph of the lattice's links with ``weights`` (e,), in both directions.

        Dijkstra's algorithm is faster on it than on an undirected graph.
        """
        shape, order = (len(self.points),) * 2, self._order
        graph = csr_matrix((weights[order], self.links[order, 1], self._starts), shape)
        return graph + graph.T

    def node(self, position: np.ndarray) -> int:
        """Node nearest to ``position`` (3,) m in the largest component."""
        return int(self.nodes[self._lookup.query(position)[1]])

    def depths(self, curve: np.ndarray) -> np.ndarray:
        """Depths (n,) m at the nodes nearest to the points (n, 3) m of a curve."""
        return self.depth[self.nodes[self._lookup.query(curve)[1]]]

    def walled(self, first: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Mask (n,) of pairs of places (n, 3) m in the lumen with a wall in between."""
        share = np.linspace(0.0, 1.0, 7)[1:-1, None, None]
        between = first + share * (last - first)
        off = self._lookup.query(between, distance_upper_bound=1.5 * LATTICE)[0]
        return np.asarray(np.isinf(off).any(axis=0))

    def around(self, node: int, radius: float) -> np.ndarray:
        """Nodes (m,) that are connected to a node inside a ball of ``radius`` (m)."""
        near = self.nodes[self._lookup.query_ball_point(self.points[node], radius)]
        part = self._near[near][:, near]
        label = connected_components(part, directed=False)[1]
        return near[label == label[near == node]]

    def length(self, way: np.ndarray) -> float:
        """Length (m) of a path (n,) of nodes."""
        return float(arc_lengths(self.points[way])[-1])

    def along(self, curve: np.ndarray, name: str) -> np.ndarray:
        """Deepest path (m, 3) m near ``curve`` (n, 3) m, from its start to its end.

        The drawn curve selects the vessel, the lumen the path through it. ValueError if
        the lumen is closed between an end and the rest.
        """
        for place, which in ((curve[0], "start"), (curve[-1], "end")):
            own = int(np.linalg.norm(self.points - place, axis=1).argmin())
            # Near the end of a vessel, curves may be off the lattice but in the lumen.
            if self._lookup.query(place)[0] > NEAR and not self.main[own]:
                raise ValueError(
                    f"the {which} of centreline {name!r} lies in a part of the lumen "
                    "that is closed off: between it and the rest the lumen is narrower "
                    f"than {mm(LATTICE):.2g} mm. Open the vessel in the segmentation, "
                    "or leave this branch out."
                )
        far = 5.0 * CORRIDOR
        off = cKDTree(resample(curve)).query(self.points, distance_upper_bound=far)[0]
        price = (LATTICE / self.depth) ** 2
        price *= 1.0 + (np.minimum(off, far) / CORRIDOR) ** 2
        graph = self._graph(self._lengths * price[self.links].mean(axis=1))
        before = _before(graph, self.node(curve[0]))
        return self.points[self.trace(before, self.node(curve[-1]))]

    def out_of(
        self, taken: np.ndarray, links: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Shortest paths from the `taken` (n,) nodes along the given links (e, 2).

        Returns lengths (n,) m, inf without a path, and predecessors (n,), -1 for none.
        """
        rows = np.unique(links)
        local = np.searchsorted(rows, links)
        apart = np.linalg.norm(np.diff(self.points[links], axis=1)[:, 0], axis=1)
        graph = csr_matrix((apart, local.T), shape=(len(rows),) * 2)
        starts = np.flatnonzero(taken[rows])
        gone, before = np.full(len(taken), np.inf), np.full(len(taken), -1)
        if len(starts):
            far, back, _ = dijkstra(
                graph, False, starts, return_predecessors=True, min_only=True
            )
            gone[rows] = far
            before[rows] = np.where(back >= 0, rows[back.clip(min=0)], -1)
        return gone, before

    def trace(self, before: np.ndarray, node: int) -> np.ndarray:
        """Nodes of the path that ends at ``node``, first to last."""
        way = [node]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        return np.asarray(way[::-1])


def _before(graph: csr_matrix, node: int) -> np.ndarray:
    return dijkstra(graph, indices=node, return_predecessors=True)[1]


def in_reach(points: np.ndarray, centres: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Mask (n,) of points (n, 3) in any ball with centres (m, 3) and radii (m,).

    Centres are shifted along a fourth dimension so that all balls have the largest
    radius and one search suffices.
    """
    most = float(reach.max())
    lifted = np.column_stack([centres, np.sqrt(most**2 - reach**2)])
    flat = np.column_stack([points, np.zeros(len(points))])
    limit = most * (1.0 + 1e-9)
    return np.isfinite(cKDTree(lifted).query(flat, distance_upper_bound=limit)[0])


def common(one: np.ndarray, other: np.ndarray) -> int:
    """Number of first points that two curves share."""
    count = min(len(one), len(other))
    same = (one[:count] == other[:count]).all(axis=1)
    return count if same.all() else int(same.argmin())
