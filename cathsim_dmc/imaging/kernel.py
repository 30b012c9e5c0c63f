"""The shadow of a device, integrated over pixels.

The chord of a ray through a round rod, as a function of the ray's distance from the
axis, is a half ellipse; a uniform disc swept along the projected axis leaves exactly
that profile, whatever the direction. So the shadow of a device is a sum of discs,
and what a pixel receives of a disc is the area the two share, which has a closed
form. The shares are tabulated over radius and sub-pixel position; each row of a table
sums to one, so rounding to the table moves attenuation by at most 1/128 pixel and
never creates or loses any.
"""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import ArrayLike

# Steps of the radius per pixel. It sets only the spread of a shadow, not its weight.
RADIUS_STEPS = 64
# Steps of the sub-pixel position per pixel for discs up to one pixel in radius; wider
# shadows are smoother and need fewer.
OFFSET_STEPS = 64
# Discs wider than this (px) would need tables of gigabytes.
WIDEST = 128


def disc_quadrant(x: ArrayLike, y: ArrayLike) -> np.ndarray:
    """Area of the part of the unit disc left of `x` and below `y`.

    Args:
        x, y: coordinates of the corner, broadcast together.

    Returns:
        Area in [0, pi], float64.
    """
    x, y = np.broadcast_arrays(np.clip(x, -1.0, 1.0), np.clip(y, -1.0, 1.0))

    def left(t):  # area of the disc on one side of a line
        return 0.5 * np.pi + t * np.sqrt(1.0 - t * t) + np.arcsin(t)

    hx, hy = left(x), left(y)
    inside = 0.5 * (hx + hy) + x * y - 0.25 * np.pi
    outside = np.where(
        x < 0.0,
        np.where(y < 0.0, 0.0, hx),
        np.where(y < 0.0, hy, hx + hy - np.pi),
    )
    return np.where(x * x + y * y < 1.0, inside, outside)


def reach(radius: np.ndarray) -> np.ndarray:
    """Pixels a disc of `radius` (px) can touch on each side of its own: ceil, >= 1."""
    return np.maximum(np.ceil(radius).astype(np.int64), 1)


def _offset_steps(reach: int) -> int:
    return max(OFFSET_STEPS // reach, 4)


def _shares(radius: float, reach: int) -> np.ndarray:
    """Shares of a disc for all offsets, (steps + 1, steps + 1, K, K), K = 2 reach + 1.

    The first axis is the row offset, the second the column offset, in [-1/2, 1/2].
    """
    steps = _offset_steps(reach)
    offset = np.arange(steps + 1) / steps - 0.5
    edge = np.arange(2 * reach + 2) - reach - 0.5
    edge = (edge[None, :] - offset[:, None]) / radius
    corner = disc_quadrant(edge[None, :, None, :], edge[:, None, :, None]) / np.pi
    return np.diff(np.diff(corner, axis=-1), axis=-2)


class _Table:
    """Shares for every radius of one reach, filled when first used."""

    def __init__(self, reach: int) -> None:
        self.reach = reach
        self.steps = _offset_steps(reach)
        self.size = (2 * reach + 1) ** 2
        offsets = (self.steps + 1) ** 2
        # np.empty: pages of radii never asked for are never touched.
        self.shares = np.empty((RADIUS_STEPS * offsets, self.size), dtype=np.float32)
        self._filled = np.zeros(RADIUS_STEPS, dtype=bool)
        self._lock = threading.Lock()

    def rows(self, radius: np.ndarray, row: np.ndarray, column: np.ndarray):
        """Index into `shares` of discs with `radius` px at sub-pixel offsets (n,)."""
        level = np.rint((radius - (self.reach - 1)) * RADIUS_STEPS).astype(np.int64)
        level = np.minimum(np.maximum(level - 1, 0), RADIUS_STEPS - 1)
        for missing in np.flatnonzero(
            (np.bincount(level, minlength=RADIUS_STEPS) > 0) & ~self._filled
        ):
            self._fill(int(missing))
        i = np.rint((row + 0.5) * self.steps).astype(np.int64)
        j = np.rint((column + 0.5) * self.steps).astype(np.int64)
        return (level * (self.steps + 1) + i) * (self.steps + 1) + j

    def _fill(self, level: int) -> None:
        with self._lock:
            if self._filled[level]:
                return
            radius = self.reach - 1 + (level + 1) / RADIUS_STEPS
            offsets = (self.steps + 1) ** 2
            shares = _shares(radius, self.reach).reshape(offsets, self.size)
            self.shares[level * offsets : (level + 1) * offsets] = shares
            self._filled[level] = True


_TABLES: dict[int, _Table] = {}


def table(reach: int) -> _Table:
    """The table of discs that reach `reach` pixels beyond their own."""
    if reach not in _TABLES:
        _TABLES[reach] = _Table(reach)
    return _TABLES[reach]
