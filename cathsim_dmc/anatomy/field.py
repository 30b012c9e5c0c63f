"""The lumen as a field: signed depth on sparse bricks, looked up by all that ask."""

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
# Depths, m, between which a device touches the wall: from as deep as an impact takes
# its axis into the wall to somewhat more than the radius of the thickest.
SHELL = (-1e-3, 1.3e-3)
# m that linear interpolation may miss there: at 95 % of the points of a brick, and at
# any of a brick that keeps the coarse lattice.
TOLERANCE, _COARSE = 8e-6, 3e-5
LARGEST = 5_000_000  # bytes; where tolerance asks for more, it grows
MOST_CELLS = 12  # along the edge of a brick
QUANTUM = 1e-6  # m, of the depths kept in 16 bits, which reach to 32.767 mm
_LARGEST = 32767
_STEP = 0.25e-3  # m, to both sides, over which a gradient is taken
_CHUNK = 2048  # bricks measured at once
_FAR = -25e-3  # m; nothing asks for the depth farther outside of the lumen
_TOGETHER = 4  # corners along each axis that are measured at once

# Depths (n, m) m at blocks (n, 3) + points (m, 3) m.
Measure = Callable[[Array, Array], Array]


@dataclass(frozen=True, eq=False, repr=False)
class Field:
    """Signed depth in a lumen: distance to its wall, m, > 0 inside.

    Space is divided into bricks of `EDGE`. A brick next to the wall holds a lattice as
    fine as the curvature of the depth asks for; between its points the depth is
    linear. All other bricks have the depths at their eight corners.

    Attributes:
        head: float64; origin (3) m, edge m, bricks along x, y and z (3), m a unit,
            number of open ends, and of each: position (3) m, direction out of the
            lumen (3), radii of the lumen and of the hole in its cap, m.
        coarse: ((a + 1)(b + 1)(c + 1),) int16, depths at the corners of the bricks.
        index: (a b c,) int32, first place of a brick in `samples`, -1 for none.
        samples: int16; of each brick the cells n along its edge and (n + 1)^3 depths.
        pages: the mapped file that the arrays lie in, if there is one.
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
            free: what lies behind an open end, in the straight continuation of the
                lumen, is `laws.field.FREE` deep; otherwise it is outside, by its
                distance from the plane of the end.
        """
        flat, out = as_rows(points), np.empty(np.shape(points)[:-1])
        depths(self.arrays, flat, free, out.reshape(-1))
        return out

    def gradient(self, points: ArrayLike) -> Array:
        """Gradients (..., 3) of the depth at points (..., 3) m; open ends do not count.

        They point away from the wall and change without jumps from cell to cell; NaN
        at points that are not finite.
        """
        flat = as_rows(points)
        out = np.empty_like(flat)
        gradients(self.arrays, flat, _STEP, out)
        return out.reshape(np.shape(points))

    @property
    def arrays(self) -> FieldArrays:
        """The arrays, as the laws take them."""
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
        """SHA-256 of the arrays but for the head."""
        joined = hashlib.sha256()
        for array in self.arrays[1:]:
            joined.update(np.ascontiguousarray(array).data)
        return joined.digest()

    @property
    def digest(self) -> bytes:
        """SHA-256 of the arrays."""
        return hashlib.sha256(self.head.tobytes() + self.body).digest()

    def with_hole(self, radius: float) -> Field:
        """The same lumen with flat caps over its open ends, but for a hole (m) each."""
        head = self.head.copy()
        head[FIRST_END + END - 1 :: END] = radius
        field = replace(self, head=head)
        vars(field)["body"] = self.body
        return field

    def release(self) -> None:
        """Gives back memory that can be read again from the file it is mapped from."""
        if self.pages is not None:
            file_maps.release(self.pages)

    def __getstate__(self) -> dict[str, object]:
        """What copies hold: arrays in memory of their own."""
        return {**vars(self), "pages": None}

    @classmethod
    def of(cls, lumen: VesselTree | Surface, ends: Sequence[End] = ()) -> Field:
        """Field of the union of a tree's tubes, or of what a surface encloses.

        Args:
            lumen: a surface is closed, with normals outwards, and flat over the ends.
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
        """Field of a measured depth.

        Args:
            measure: exact depths; open ends do not limit them.
            low: (3,) m, least corner of a box around the lumen.
            high: (3,) m, largest corner.
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
        # Behind an open end the depth jumps from one corner to the other.
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
    """Depths m at all corners of bricks; far outside, those of a block's middle."""
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
    """Points (n, 3) of a lattice by their places along the three axes."""
    return np.stack(np.meshgrid(*along, indexing="ij"), -1).reshape(-1, 3)


def _near_wall(low: Array, high: Array) -> np.ndarray:
    """Which bricks may come into the shell, from depths at their corners or middles."""
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
    """Cells (n,) along the edges of bricks, 1 for no lattice, that fit `room` bytes.

    Their depths are known at points (n, 5, 5, 5) and at the corners (n, 2, 2, 2), m.
    """
    shell = _in_shell(exact)
    plain = np.abs(_in_shell(_refined(eight, 4)) - shell).reshape(len(exact), -1)
    halves = np.abs(_in_shell(_refined(exact[:, ::2, ::2, ::2], 2)) - shell)
    # Of the points in the shell, of which a brick may have few.
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
