"""Lattice points inside a lumen, and shortest paths among them to a target."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import ndimage

Depth = Callable[[np.ndarray], np.ndarray]

SPACING = 1.5e-3  # m: vessels down to a radius of 1.3 mm stay connected
FINEST = 0.4e-3  # m: finest lattice for thinner vessels

_BLOCKS = ((8, 2), (2, 1))  # points along the edges of blocks, and of their parts
_SLOPE = 1.2  # m per m, largest slope of an interpolated depth


def inside(
    depth: Depth, low: np.ndarray, shape: np.ndarray, spacing: float, above: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Lattice points deeper than a depth; only blocks near the lumen are evaluated.

    The lattice begins at `low` (3,) m and has a shape (3,). Returns ijk (n, 3) int64
    and depths (n,) m, > 0 inside.
    """
    size = _BLOCKS[0][0]
    ijk = size * np.argwhere(np.ones(-(-np.asarray(shape) // size), bool))
    for size, part in _BLOCKS:
        half = 0.5 * (size - 1) * spacing
        near = depth(low + spacing * ijk + half) > above - _SLOPE * np.sqrt(3) * half
        cells = part * np.argwhere(np.ones((size // part,) * 3, bool))
        ijk = (ijk[near][:, None] + cells).reshape(-1, 3)
    ijk = ijk[(ijk < shape).all(-1)]
    found = depth(low + spacing * ijk)
    return ijk[found > above], found[found > above]


def nearest_cell(cells: np.ndarray, place: np.ndarray) -> tuple[int, ...]:
    """Cell among `cells` (n, 3) that is nearest to a place (3,), in cell units."""
    return tuple(cells[np.square(cells - place).sum(axis=1).argmin()].tolist())


def search(price: np.ndarray, start: tuple[int, ...]) -> tuple[Any, np.ndarray]:
    """Cheapest paths from a cell of a lattice to all others (26 neighbours).

    Args:
        price: (X, Y, Z) cost of a path per cell of length; negative for no passage.
        start: The cell.

    Returns:
        The graph, whose `traceback(cell)` lists the cells of a path, and the cost
        (X, Y, Z) of the path to each cell, inf where there is none.
    """
    from skimage.graph import MCP_Geometric  # slow to import

    graph = MCP_Geometric(price)
    return graph, graph.find_costs([start])[0]


class LumenDistance:
    """Length of the shortest path inside the lumen to a target, on a lattice.

    Paths run along the edges and diagonals of the lattice (26 neighbours): they are up
    to a tenth too long, and too short by at most one cell.
    """

    def __init__(
        self, depth: Depth, bounds: np.ndarray, target: np.ndarray, origin: np.ndarray
    ):
        """Computes the distances to a target; takes 0.4 to 0.8 s.

        Args:
            depth: Signed depth (n,) of points (n, 3) in the lumen, m, > 0 inside.
            bounds: (2, 3), m, corners of a box that holds the lumen.
            target: (3,), m, point in the lumen.
            origin: (3,), m, another one; ValueError if no path joins it to the target.
        """
        (low, high), spacing = np.asarray(bounds, float), SPACING
        while True:
            self._low, self._spacing = low - 1.5 * spacing, spacing
            shape = np.ceil((high - low) / spacing).astype(int) + 4
            cells, _ = inside(depth, self._low, shape, spacing)
            lumen = np.zeros(shape, bool)
            lumen[tuple(cells.T)] = True
            start, end = (
                nearest_cell(cells, (point - self._low) / spacing)
                for point in (target, origin)
            )
            _, costs = search(np.where(lumen, 1.0, -1.0), start)
            if np.isfinite(costs[end]):
                break
            spacing /= 2.0
            if spacing < FINEST:
                raise ValueError(
                    f"no way inside the lumen joins {np.round(origin, 4)} m and "
                    f"{np.round(target, 4)} m: is the lumen closed in between, or is "
                    f"one of them in another vessel?"
                )
        self._inside = np.isfinite(costs)
        nearest = ndimage.distance_transform_edt(
            ~self._inside, return_distances=False, return_indices=True
        )
        self._ways = (costs * spacing)[tuple(nearest)].astype(np.float32)
        self._own = np.where(self._inside, self._ways, 0.0)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Length (...), m, of the paths from points (..., 3), m, to the target."""
        # Lattice points outside the lumen may belong to another vessel. They count only
        # if none of the eight is inside.
        points = np.asarray(points, float)
        cell = ((points.reshape(-1, 3) - self._low) / self._spacing).T
        total, weight = (
            ndimage.map_coordinates(lattice, cell, float, order=1, mode="nearest")
            for lattice in (self._own, self._inside)
        )
        last = np.array(self._ways.shape)[:, None] - 1
        nearest = self._ways[tuple(np.rint(cell).astype(int).clip(0, last))]
        with np.errstate(invalid="ignore"):  # 0 / 0 without a lattice point inside
            lengths = np.where(weight < 1e-6, nearest, total / weight)
        return lengths.reshape(points.shape[:-1])
