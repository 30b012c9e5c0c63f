"""Length of the shortest path inside the lumen to one point."""

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from cathsim_dmc.anatomy import lattice

SPACING = 1.5e-3  # m: vessels down to a radius of 1.3 mm stay connected
FINEST = 0.4e-3  # m: the lattice is refined down to here where they do not


class LumenDistance:
    """Length of the shortest way inside the lumen to a target, as a lattice.

    The way of a head in another branch leads back through the parent vessel, however
    near the target lies behind the wall. Ways run along the edges and diagonals of the
    lattice (26 neighbours), which makes them up to a tenth too long, never too short by
    more than a cell.
    """

    def __init__(
        self,
        depth: Callable[[np.ndarray], np.ndarray],
        bounds: np.ndarray,
        target: np.ndarray,
        origin: np.ndarray,
        spacing: float = SPACING,
    ):
        """Computes the distances to a target; takes 0.4 to 0.8 s.

        Args:
            depth: Signed depth (n,) of points (n, 3) in the lumen, m, > 0 inside.
            bounds: (2, 3), m, corners of a box that holds the lumen.
            target: (3,), m, point in the lumen.
            origin: (3,), m, another point in it, which must be connected to the target.
            spacing: Edge of a cell, m; halved while target and origin are apart.

        Raises:
            ValueError: if no way inside the lumen joins origin and target.
        """
        # Slow to import, and only a reward along the path needs it.
        from skimage import graph

        low, high = np.asarray(bounds, float)
        while True:
            self._low, self._spacing = low - 1.5 * spacing, spacing
            shape = np.ceil((high - low) / spacing).astype(int) + 4
            cells, _ = lattice.inside(depth, self._low, shape, spacing)
            inside = np.zeros(shape, bool)
            inside[tuple(cells.T)] = True
            start, end = (self._nearest(cells, point) for point in (target, origin))
            costs = graph.MCP_Geometric(np.where(inside, 1.0, -1.0)).find_costs(
                [start]
            )[0]
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

    def _nearest(self, cells: np.ndarray, point: np.ndarray) -> tuple[int, ...]:
        offset = self._low + self._spacing * cells - point
        return tuple(cells[np.vecdot(offset, offset).argmin()].tolist())

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Length (...) of the ways from points (..., 3), m.

        Linear between the lattice points inside the lumen; those outside, which may
        be nearer to another vessel, count only where there is no other.
        """
        points = np.asarray(points, float)
        cell = (points.reshape(-1, 3) - self._low) / self._spacing
        cell = np.clip(cell, 0.0, np.array(self._ways.shape) - 1.001)
        corner = cell.astype(int)
        rest = cell - corner
        total = np.zeros(len(cell))
        weight = np.zeros(len(cell))
        for offset in np.ndindex(2, 2, 2):
            share = np.where(offset, rest, 1.0 - rest)
            share = share[:, 0] * share[:, 1] * share[:, 2]
            at = tuple((corner + offset).T)
            share = share * self._inside[at]
            weight += share
            total += share * self._ways[at]
        outside = weight < 1e-6
        if outside.any():
            at = tuple(np.rint(cell[outside]).astype(int).T)
            total[outside], weight[outside] = self._ways[at], 1.0
        return (total / weight).reshape(points.shape[:-1])
