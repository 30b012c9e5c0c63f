"""Signed depth of a lumen, sampled on sparse bricks."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import file_maps
from cathsim_dmc.anatomy.centreline import Array, VesselTree, as_rows
from cathsim_dmc.anatomy.parts import MARGIN, End, Surface
from cathsim_dmc.laws.field import END, FIRST_END, FieldArrays, depths, gradients

EDGE = 4e-3  # m, of a brick
# Range of depths, m, of the axis of a device in contact: from the deepest penetration
# in an impact to slightly more than the radius of the thickest device.
SHELL = (-1e-3, 1.3e-3)
# Largest error, m, of linear interpolation in this range: at 95 % of the points of a
# brick with a lattice of its own, and at any point of a brick without one.
TOLERANCE, _COARSE = 8e-6, 3e-5
LARGEST = 5_000_000  # bytes of a field; the tolerance grows until it fits
MOST_CELLS = 12  # along the edge of a brick
QUANTUM = 1e-6  # m, of the depths kept in 16 bits, which reach to 32.767 mm
_LARGEST = 32767
_STEP = 0.25e-3  # m, to both sides, of the central differences of a gradient
_CHUNK = 2048  # bricks measured at once
_FAR = -25e-3  # m; depths farther outside the lumen are not used
_TOGETHER = 4  # corners along each axis that are measured at once

# Depths (n, m) m at blocks (n, 3) + points (m, 3) m.
Measure = Callable[[Array, Array], Array]


@dataclass(frozen=True, eq=False, repr=False)
class Field:
    """Signed depth in a lumen: distance to its wall, m, > 0 inside.

    Space is divided into bricks of `EDGE`. A brick near the wall holds a lattice whose
    resolution follows the curvature of the depth. Any other brick has the depths at its
    eight corners. Between these points the depth is trilinear.

    Attributes:
        head: float64; origin (3) m, edge m, bricks along x, y and z (3), m a unit,
            number of open ends, and of each: position (3) m, direction out of the
            lumen (3), radii of the lumen and of the hole in its cap, m.
        coarse: ((a + 1)(b + 1)(c + 1),) int16, depths at the corners of the bricks.
        index: (a b c,) int32, offset of a brick in `samples`; -1 for none.
        samples: int16; for each brick the number n of cells along its edge and
            (n + 1)^3 depths.
        pages: memory-mapped file that holds the arrays, or None.
    """

    head: Array
    coarse: np.ndarray
    index: np.ndarray
    samples: np.ndarray
    pages: np.ndarray | None = None

    def __call__(self, points: ArrayLike, free: bool = False) -> Array:
        """Depths (...) m at points (..., 3) m; NaN at points that are not finite.

        Args:
            points: m.
            free: whether points behind an open end, in the straight continuation of
                the lumen, have the depth `laws.field.FREE`; otherwise they are outside
                by their distance from the plane of the end.
        """
        flat, out = as_rows(points), np.empty(np.shape(points)[:-1])
        depths(self.arrays, flat, free, out.reshape(-1))
        return out

    def gradient(self, points: ArrayLike) -> Array:
        """Gradients (..., 3) of the depth at points (..., 3) m; open ends are ignored.

        They point away from the wall and are continuous from cell to cell; NaN at
        points that are not finite.
        """
        flat = as_rows(points)
        out = np.empty_like(flat)
        gradients(self.arrays, flat, _STEP, out)
        return out.reshape(np.shape(points))

    @property
    def arrays(self) -> FieldArrays:
        """The arrays in the form that the laws take."""
        return FieldArrays(self.head, self.coarse, self.index, self.samples)

    @property
    def nbytes(self) -> int:
        """Memory of the arrays, bytes."""
        return sum(array.nbytes for array in self.arrays)

    @property
    def box(self) -> tuple[Array, Array]:
        """Corners (3,), (3,) m, of the box of all bricks."""
        return self.head[:3], self.head[:3] + self.head[3] * self.head[4:7]

    @cached_property
    def body(self) -> bytes:
        """SHA-256 of the arrays without the head."""
        joined = hashlib.sha256()
        for array in self.arrays[1:]:
            joined.update(np.ascontiguousarray(array).data)
        return joined.digest()

    @property
    def digest(self) -> bytes:
        """SHA-256 of the arrays."""
        return hashlib.sha256(self.head.tobytes() + self.body).digest()

    def with_hole(self, radius: float) -> Field:
        """The same lumen with capped open ends, each with a hole of `radius` (m)."""
        head = self.head.copy()
        head[FIRST_END + END - 1 :: END] = radius
        field = replace(self, head=head)
        vars(field)["body"] = self.body
        return field

    def release(self) -> None:
        """Releases the memory of the mapped file, which is read again when needed."""
        if self.pages is not None:
            file_maps.release(self.pages)

    def __getstate__(self) -> dict[str, object]:
        """State of copies and pickles: the arrays without the mapped file."""
        return {**vars(self), "pages": None}

    @classmethod
    def of(cls, lumen: VesselTree | Surface, ends: Sequence[End] = ()) -> Field:
        """Field of the union of a tree's tubes, or of what a surface encloses.

        Args:
            lumen: vessel tree, or closed surface with outward normals and flat ends.
            ends: flat ends; those that are open let a device pass.
        """
        from cathsim_dmc.anatomy.surface_depth import SurfaceDepth
        from cathsim_dmc.anatomy.tree_depth import TreeDepth

        kind = SurfaceDepth if isinstance(lumen, Surface) else TreeDepth
        measure = kind(lumen, ends)  # type: ignore[arg-type]
        low, high = measure.box
        return cls.sampled(measure.around, low, high, ends)

    @classmethod
    def sampled(
        cls, measure: Measure, low: Array, high: Array, ends: Sequence[End] = ()
    ) -> Field:
        """Field that samples a depth function.

        Args:
            measure: exact depths; open ends do not limit them.
            low: (3,) m, lower corner of a box around the lumen.
            high: (3,) m, upper corner.
            ends: flat ends of the lumen.
        """
        origin = np.asarray(low) - MARGIN
        shape = np.ceil((np.asarray(high) + MARGIN - origin) / EDGE).astype(int)
        coarse = _corners(measure, origin, shape + 1)
        corners = np.lib.stride_tricks.sliding_window_view(coarse, (2, 2, 2))
        low, high = corners.min(axis=(3, 4, 5)), corners.max(axis=(3, 4, 5))
        rows = np.argwhere(_near_wall(low, high))
        middles = origin + EDGE * (rows + 0.5)
        depth = measure(middles, np.zeros((1, 3)))[:, 0]
        # The depth is discontinuous behind an open end.
        across = (low < SHELL[1]) & (high > SHELL[0])
        near = _near_wall(depth, depth) | across[tuple(rows.T)]
        rows, middles = rows[near], middles[near]
        exact = _measured(measure, middles, 4)
        eight = corners[tuple(rows.T)]
        cells = _cells(exact, eight, LARGEST - 6 * coarse.size)
        index = np.full(tuple(shape), -1, dtype=np.int32)
        parts, end = [], 0
        for n in np.unique(cells[cells > 1]):
            chosen = cells == n
            if n in (2, 4):
                depth = exact[chosen, :: 4 // n, :: 4 // n, :: 4 // n]
            else:
                depth = _measured(measure, middles[chosen], n)
            bricks = np.full((len(depth), 1 + (n + 1) ** 3), n, dtype=np.int16)
            bricks[:, 1:] = _whole(depth).reshape(len(depth), -1)
            first = end + bricks.shape[1] * np.arange(len(depth))
            index[tuple(rows[chosen].T)] = first
            parts.append(bricks.ravel())
            end += bricks.size
        free = [(*e.position, *e.direction, e.radius, e.radius) for e in ends if e.open]
        head = np.concatenate([origin, [EDGE], shape, [QUANTUM, len(free)], *free])
        samples = np.concatenate([*parts, np.zeros(1, np.int16)])
        return cls(head, _whole(coarse).ravel(), index.ravel(), samples)


def _corners(measure: Measure, origin: Array, shape: np.ndarray) -> Array:
    """Depths (m) at all brick corners; far outside, one depth for a block of them."""
    blocks, half = -(-shape // _TOGETHER), (_TOGETHER - 1) / 2
    middles = origin + EDGE * (
        _TOGETHER * _lattice([np.arange(count) for count in blocks]) + half
    )
    local = _lattice([EDGE * (np.arange(_TOGETHER) - half)] * 3)
    depth = np.repeat(measure(middles, np.zeros((1, 3))), len(local), axis=1)
    near = depth[:, 0] > _FAR
    depth[near] = measure(middles[near], local)
    depth = depth.reshape((*blocks, _TOGETHER, _TOGETHER, _TOGETHER))
    depth = depth.transpose(0, 3, 1, 4, 2, 5).reshape(_TOGETHER * blocks)
    return depth[: shape[0], : shape[1], : shape[2]]


def _lattice(along: Sequence[np.ndarray]) -> Array:
    """Points (n, 3) of a lattice with the given coordinates along the three axes."""
    return np.stack(np.meshgrid(*along, indexing="ij"), -1).reshape(-1, 3)


def _near_wall(low: Array, high: Array) -> np.ndarray:
    """Mask of bricks that may reach the shell, from depths at corners or middles."""
    reach = EDGE * np.sqrt(3.0) / 2.0
    # The depth changes by at most the distance moved.
    return (high + reach > SHELL[0]) & (low - reach < SHELL[1])


def _measured(measure: Measure, middles: Array, cells: int) -> Array:
    """Depths (n, c + 1, c + 1, c + 1) m in bricks with middles (n, 3) m."""
    local = _lattice([EDGE * (np.arange(cells + 1) / cells - 0.5)] * 3)
    parts = [np.empty((0, len(local)))]
    for first in range(0, len(middles), _CHUNK):
        parts.append(measure(middles[first : first + _CHUNK], local))
    return np.concatenate(parts).reshape(-1, cells + 1, cells + 1, cells + 1)


def _in_shell(depth: Array) -> Array:
    return depth.clip(SHELL[0], SHELL[1])


def _cells(exact: Array, eight: Array, room: int) -> np.ndarray:
    """Number of cells (n,) along the edge of each brick, 1 for no lattice.

    All lattices fit in `room` bytes. The depths, m, are given at the points `exact`
    (n, 5, 5, 5) and at the corners `eight` (n, 2, 2, 2).
    """
    shell = _in_shell(exact)
    plain = np.abs(_in_shell(_refined(eight, 4)) - shell).reshape(len(exact), -1)
    halves = np.abs(_in_shell(_refined(exact[:, ::2, ::2, ::2], 2)) - shell)
    # Only points in the shell count, and a brick may have few of them.
    within = (exact == shell).reshape(len(exact), -1)
    halves = np.sort(np.where(within, halves.reshape(within.shape), -1.0), axis=1)
    rank = within.shape[1] - 1 - (0.05 * within.sum(axis=1)).astype(int)
    error = halves[np.arange(len(exact)), rank].clip(0.0)
    plain = plain.max(axis=1, initial=0.0)
    tolerance = TOLERANCE
    while True:
        # The error grows with the square of the cells' size.
        cells = np.ceil(2.0 * np.sqrt(error / tolerance)).astype(int)
        cells = np.clip(cells, 2, MOST_CELLS)
        cells[plain <= max(_COARSE, tolerance)] = 1
        if 2 * ((cells[cells > 1] + 1) ** 3 + 1).sum() < room or cells.max() <= 2:
            return cells
        tolerance *= 1.1


def _refined(values: Array, times: int) -> Array:
    """Lattices (n, ...) interpolated to `times` as many cells along each axis."""
    for axis in (1, 2, 3):
        count = values.shape[axis] - 1
        at = np.arange(times * count + 1) / times
        low = np.minimum(at.astype(int), count - 1)
        share = np.expand_dims(at - low, [k for k in range(4) if k != axis])
        first, second = values.take(low, axis), values.take(low + 1, axis)
        values = first + share * (second - first)
    return values


def _whole(depth: Array) -> np.ndarray:
    return np.clip(np.rint(depth / QUANTUM), -_LARGEST, _LARGEST).astype(np.int16)
