"""From curves drawn in a scan to a tree of vessels that starts at an inlet.

Centrelines of a scan seldom reach the place where a device enters, and seldom start
at the same point. Here each is continued to the inlet along the deepest way through
the lumen, the shared beginnings are merged, and every curve is moved to the middle
of the lumen, whose depth then serves as its radius.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.scan.centring import STEP, centred, resample
from cathsim_dmc.anatomy.wall.depth import DepthField

LATTICE = 1e-3  # m, spacing of the lattice on which ways are searched
CORRIDOR = 2e-3  # m, distance from a drawn curve at which a way costs twice
SHALLOW = 0.2e-3  # m, lattice points nearer to the wall are no way
NEAR_END = 2.0  # radii; a curve that starts nearer to a free end starts there
WIDE = 0.4  # of the widest free end: narrower ends are no inlet by default
ROOT_WIDTH = 0.5  # of the inlet: narrower free ends do not continue the root
TAIL = 15e-3  # m, end of a centreline that is cut off where it is too narrow
TAIL_RADIUS = 1.1e-3  # m, of a 6 Fr device (1.0 mm) and a tenth to spare
END_TRIM = 8e-3  # m, most that is cut off where a curve runs into its end
END_SEARCH = 15e-3  # m from a blind end in which its width is looked for
MIN_RADIUS = 0.1e-3  # m, floor of a centreline's radius where it scrapes the wall


@dataclass(frozen=True)
class FreeEnd:
    """A blind end of the lumen.

    Attributes:
        position: (3,) m.
        bottleneck: m, largest sphere that reaches the widest part from here.
        distance: m, along the lumen, from the widest part.
    """

    position: np.ndarray
    bottleneck: float
    distance: float


class Ways:
    """Shortest and deepest ways through a lumen, on a lattice of its inside."""

    def __init__(self, field: DepthField, spacing: float = LATTICE):
        """Build the lattice graph of ``field`` (26 neighbours)."""
        ijk, points, depth = field.lattice(spacing, SHALLOW)
        shape = ijk.max(0) + 3
        key = np.ravel_multi_index(tuple((ijk + 1).T), tuple(shape))
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
        # Only the largest piece of the lattice is the lumen; crumbs are noise.
        count, label = connected_components(self._graph(self._lengths), directed=False)
        if count > 1:
            self.main = label == np.bincount(label).argmax()
        else:
            self.main = np.ones(len(key), dtype=bool)
        self._nodes = np.nonzero(self.main)[0]
        self._lookup = cKDTree(self.points[self.main])

    def _graph(self, weights: np.ndarray) -> csr_matrix:
        n = len(self.points)
        return csr_matrix((weights, (self._rows, self._cols)), shape=(n, n))

    def node(self, position: np.ndarray) -> int:
        """Lattice point nearest to ``position`` (3,) m."""
        return int(self._nodes[self._lookup.query(position)[1]])

    def lengths_from(self, node: int) -> np.ndarray:
        """Length (n,) m of the shortest way from ``node`` to every point."""
        graph = self._graph(self._lengths)
        return dijkstra(graph, directed=False, indices=node)

    def deepest_from(self, node: int) -> np.ndarray:
        """Predecessors (n,) on the deepest ways from ``node``.

        A step costs its length over the square of the depth, so that a way keeps
        to the middle and prefers wide vessels.
        """
        depth = 0.5 * (self.depth[self._rows] + self.depth[self._cols])
        graph = self._graph(self._lengths * (LATTICE / depth) ** 2)
        _, before = dijkstra(
            graph, directed=False, indices=node, return_predecessors=True
        )
        return before

    def along(self, curve: np.ndarray) -> np.ndarray:
        """Deepest way (m, 3) near ``curve`` (n, 3) m, from its start to its end.

        Depth decides, but leaving the curve by ``CORRIDOR`` doubles the price, so
        that a drawn curve chooses the vessel and the lumen the way through it.
        """
        tree = cKDTree(resample(curve))
        off = tree.query(self.points, distance_upper_bound=5.0 * CORRIDOR)[0]
        off = np.minimum(off, 5.0 * CORRIDOR)
        price = (LATTICE / self.depth) ** 2 * (1.0 + (off / CORRIDOR) ** 2)
        weights = self._lengths * 0.5 * (price[self._rows] + price[self._cols])
        start, end = self.node(curve[0]), self.node(curve[-1])
        _, before = dijkstra(
            self._graph(weights),
            directed=False,
            indices=start,
            return_predecessors=True,
        )
        return self.points[self.trace(before, end)]

    def trace(self, before: np.ndarray, node: int) -> np.ndarray:
        """Nodes of the way that ends at ``node``, first to last."""
        way = [node]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        return np.asarray(way[::-1])

    def free_ends(self) -> list[FreeEnd]:
        """Blind ends of the lumen."""
        nodes = self._nodes
        centre = int(nodes[self.depth[nodes].argmax()])
        before = self.deepest_from(centre)
        # Seen from one blind end, every other one is farther than all around it.
        from_centre = self.lengths_from(centre)
        first = int(nodes[from_centre[nodes].argmax()])
        reach = self.lengths_from(first)
        ends = []
        taken = np.zeros(len(self.points), dtype=bool)
        for node in [first, *nodes[np.argsort(-reach[nodes])]]:
            if taken[node]:
                continue
            way = self.trace(before, node)[::-1]
            steps = np.linalg.norm(np.diff(self.points[way], axis=0), axis=1)
            along = np.concatenate([[0.0], np.cumsum(steps)])
            local = self.depth[way][along < END_SEARCH].max()
            place = self.points[node]
            near = nodes[self._lookup.query_ball_point(place, 2.5 * local)]
            taken[near] = True
            if node != first and reach[near].max() > reach[node] + 1e-9:
                continue
            # The depth falls to nothing at the very end, which is no bottleneck.
            inner = along > 2.0 * local
            narrow = self.depth[way][inner].min() if inner.any() else local
            ends.append(FreeEnd(place, float(narrow), float(from_centre[node])))
        return ends


def plan_inlet(
    ways: Ways, curves: list[np.ndarray], inlet: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Choose where the device enters and where the root vessel leads.

    Args:
        ways: of the lumen.
        curves: (n_i, 3) m, the given centrelines, first point proximal.
        inlet: (3,) m near the end to use or in the middle of a vessel that is to be
            cut there, or None to choose: the end at which the
            curves start, else the wide end farthest along the lumen from their starts.

    Returns:
        (inlet (3,) m, far end of the root (3,) m or None).
    """
    ends = ways.free_ends()
    if not ends:
        raise ValueError(
            "the lumen has no free end; give a mesh of a tube-like vessel with at "
            "least one blind end for the device to enter by."
        )
    position = np.stack([end.position for end in ends])
    last = np.stack([curve[-1] for curve in curves])
    first = np.stack([curve[0] for curve in curves])
    width = np.array([end.bottleneck for end in ends])
    to_last = np.linalg.norm(position[:, None] - last, axis=-1).min(1)
    to_first = np.linalg.norm(position[:, None] - first, axis=-1).min(1)
    margin = np.maximum(NEAR_END * width, 4e-3)
    goal_end = to_last < margin
    if inlet is not None:
        node = ways.node(inlet)
        gap = np.linalg.norm(position - inlet, axis=-1)
        chosen = int(gap.argmin())
        if gap[chosen] > max(3.0 * width[chosen], 2.5 * ways.depth[node]):
            return inlet, _far_end(ways, position, width, goal_end, last, node, True)
    elif ((to_first < margin) & ~goal_end).any():
        chosen = int(np.where(~goal_end, to_first, np.inf).argmin())
    else:
        wide = ~goal_end & (width >= WIDE * width[~goal_end].max(initial=0.0))
        if not wide.any():
            raise ValueError(
                "every free end of the lumen is the end of a given centreline; pass "
                "inlet=(x, y, z) near the end by which the device enters."
            )
        reach = ways.lengths_from(ways.node(first[0]))
        distance = reach[[ways.node(end) for end in position]]
        chosen = int(np.where(wide, distance, -np.inf).argmax())
    far = _far_end(ways, position, width, goal_end, last, ways.node(position[chosen]))
    return position[chosen], far


def _far_end(
    ways, position, width, goal_end, last, node, cut=False
) -> np.ndarray | None:
    """The widest other end, if a wide vessel leads there from the inlet's node.

    Where the lumen is cut at the inlet, ends behind it are no candidates:
    they are nearer to the inlet than to the places where the curves end.
    """
    reach = ways.lengths_from(node)
    nodes = [ways.node(point) for point in position]
    to_goal = ways.lengths_from(ways.node(last[0]))
    total = reach[ways.node(last[0])]
    ahead = to_goal[nodes] < total
    around = ways.depth[ways.main & (reach < 25e-3)].max()
    others = ~goal_end & (ahead | (not cut)) & (reach[nodes] > 2.0 * around)
    others &= width > max(ROOT_WIDTH * around, 1.2 * _median_depth(ways, last))
    if not others.any():
        return None
    return position[np.where(others, width, -np.inf).argmax()]


def _median_depth(ways: Ways, points: np.ndarray) -> float:
    return float(np.median(ways.depth[[ways.node(point) for point in points]]))


def grow_tree(
    field: DepthField,
    ways: Ways,
    curves: dict[str, np.ndarray],
    inlet: np.ndarray,
    far: np.ndarray | None,
    root_name: str,
) -> VesselTree:
    """Join the curves into one tree whose root starts at the inlet.

    Args:
        field: depth of the lumen.
        ways: of the lumen.
        curves: (n, 3) m by vessel name, first point proximal.
        inlet: (3,) m, end of the lumen where the root starts.
        far: (3,) m, end of the root, or None: then the root ends where the last
            of the curves leaves it.
        root_name: name of the root.
    """
    start = ways.node(inlet)
    before = ways.deepest_from(start)
    raw = {}
    for name, curve in curves.items():
        lead = ways.points[ways.trace(before, ways.node(curve[0]))]
        raw[name] = resample(np.concatenate([lead, ways.along(curve)]))
    if far is not None:
        root = resample(ways.points[ways.trace(before, ways.node(far))])
    else:
        root = _shared_beginning(list(raw.values()), field)
    root = _deep_start(root, field)
    lines = {root_name: root}
    vessels = {root_name: Vessel(root_name, _finish(field, root, None))}
    for name, curve in sorted(raw.items(), key=lambda item: -_bulk(field, item[1])):
        parent, at = _parent(curve, lines, vessels, field)
        trunk = vessels[parent].centreline
        anchor = trunk.at(trunk.project(curve[at]).arc_length).position
        own = resample(np.concatenate([anchor[None], curve[at + 1 :]]))
        line = _finish(field, own, anchor)
        lines[name] = curve
        vessels[name] = Vessel(name, line, parent, ostium_of(line, trunk))
    # Report in the order in which the files were given, parents first.
    ordered = {root_name: vessels[root_name]}
    while len(ordered) < len(vessels):
        for name in curves:
            if name not in ordered and vessels[name].parent in ordered:
                ordered[name] = vessels[name]
    return VesselTree(ordered)


def _bulk(field: DepthField, curve: np.ndarray) -> float:
    """Length times mean depth: the larger of two branches becomes the parent."""
    return float(np.maximum(field(curve), 0.0).sum())


def _separation(curve: np.ndarray, other: np.ndarray, field: DepthField) -> int:
    """Index of the last point of ``curve`` before it leaves ``other`` for good."""
    distance = cKDTree(other).query(curve)[0]
    apart = distance > np.maximum(0.4 * field(curve), 1e-3)
    # The two may begin at different places; only what follows their meeting counts.
    apart[: int((~apart).argmax())] = False
    first = int(apart.argmax()) if apart.any() else len(curve) - 2
    # Walk back to where the two still ran together.
    while (
        first > 0
        and distance[first] > 0.5e-3
        and distance[first - 1] < (distance[first])
    ):
        first -= 1
    return min(first, len(curve) - 3)


def _parent(curve, lines, vessels, field) -> tuple[str, int]:
    """Vessel that ``curve`` leaves last, and the index at which it does.

    Two curves may leave a wide vessel side by side before they part: as long as
    they have not left its lumen, that vessel is the parent of both.
    """
    at = {key: _separation(curve, line, field) for key, line in lines.items()}
    key = max(at, key=lambda name: at[name])
    while vessels[key].parent is not None:
        vessel = vessels[key]
        if vessel.centreline.project(curve[at[key]]).arc_length > vessel.ostium:
            break
        key = vessel.parent
    return key, at[key]


def _shared_beginning(curves: list[np.ndarray], field: DepthField) -> np.ndarray:
    """Part that the first curve shares with any other, or 60 % of it if alone."""
    longest = max(curves, key=lambda curve: _bulk(field, curve))
    others = [curve for curve in curves if curve is not longest]
    if not others:
        return longest[: max(4, int(0.6 * len(longest)))]
    shared = max(_separation(longest, other, field) for other in others)
    return longest[: max(4, shared + 1)]


def _deep_start(curve: np.ndarray, field: DepthField) -> np.ndarray:
    """Cut the beginning up to where the lumen has its full width."""
    depth = field(curve)
    head = depth[: max(2, len(curve) // 3)]
    settled = depth >= 0.8 * np.maximum.accumulate(head)[min(15, len(head) - 1)]
    return curve[int(settled.argmax()) :]


def _finish(
    field: DepthField, curve: np.ndarray, anchor: np.ndarray | None
) -> Centreline:
    """Centre a curve in the lumen and measure its radii."""
    # Towards a blind end the depth tells the distance to the end, not the middle.
    last = min(len(curve) // 2, int(END_TRIM / STEP))
    deep = field(curve[-last:])
    wide = np.nonzero(deep >= 0.6 * deep.max())[0][-1]
    curve = curve[: len(curve) - last + wide + 1]
    points = centred(field, curve, fixed_start=anchor is not None)
    depth = field(points)
    # A tail that no device can follow is cut off; a stenosis farther up is kept.
    tail = max(2, len(points) - int(TAIL / STEP))
    narrow = np.nonzero(depth[tail:] < TAIL_RADIUS)[0]
    if narrow.size:
        points, depth = points[: tail + narrow[0]], depth[: tail + narrow[0]]
    return Centreline(points, np.maximum(depth, MIN_RADIUS))


def ostium_of(line: Centreline, trunk: Centreline) -> float:
    """Arc length at which a branch leaves its parent's tube."""
    place = trunk.project(line.points)
    outside = place.distance > place.radius
    at = int(outside.argmax()) if outside.any() else len(outside) // 2
    return float(min(line.arc_length[at], 0.5 * line.length))
