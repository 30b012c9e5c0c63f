"""Distances of many points to many straight segments at once."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def as_points(points: ArrayLike, name: str = "points") -> Array:
    """Return `points` as float64 (..., 3); ValueError if the last axis is another."""
    array = np.asarray(points, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(
            f"{name} has shape {array.shape}; give coordinates (x, y, z) in metres "
            "on the last axis, shape (..., 3)."
        )
    return array


def arc_lengths(points: Array) -> Array:
    """Arc length (n,) of each point (n, k) of a polyline from the first."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


class Segments:
    """Straight segments prepared for the projection of many points at once.

    Attributes are per segment: start (s, 3), direction (s, 3) not normalised,
    length (s,). Distances come from the expanded square, so the work per
    point and segment is two matrix products and a few elementwise passes.
    """

    def __init__(self, start: Array, end: Array) -> None:
        self.start = start
        self.direction = end - start
        self.squared = np.einsum("sj,sj->s", self.direction, self.direction)
        self.length = np.sqrt(self.squared)
        # One matrix product gives p.d/|d|^2 and -2 p.a for every segment.
        self._matrix = np.concatenate(
            [(self.direction / self.squared[:, None]).T, -2.0 * start.T], axis=1
        )
        self._offset = np.concatenate(
            [
                -np.einsum("sj,sj->s", start, self.direction) / self.squared,
                np.einsum("sj,sj->s", start, start),
            ]
        )

    def squared_distance(self, points: Array) -> tuple[Array, Array]:
        """Squared distance less |p|^2, and unclamped parameter, both (n, s)."""
        product = points @ self._matrix
        product += self._offset
        count = len(self.length)
        raw, base = product[:, :count], product[:, count:]
        # |p-a|^2 - 2 t raw |d|^2 + t^2 |d|^2 with t = clip(raw, 0, 1)
        clamped = np.clip(raw, 0.0, 1.0)
        step = clamped - 2.0 * raw
        step *= clamped
        step *= self.squared
        step += base
        return step, raw
