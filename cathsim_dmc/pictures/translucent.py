"""A vessel as translucent glass, drawn by loops over triangles: no OpenGL, no window.

All hits of a pixel are sorted by depth, because translucent triangles painted one over
the other would show their seams. Glass is more opaque at the outline, where the line of
sight runs along the wall.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.compiled import compiled

# Colour of the wall, RGB in [0, 1], as lit from the left above the viewer's eye.
WALL_COLOUR = np.array([0.80, 0.36, 0.33])
LIGHT = np.array([-0.35, 0.55, 0.76])
LIGHT /= np.linalg.norm(LIGHT)
# Opacity of one layer of the wall: seen straight on, and along the surface.
FACING, GRAZING = 0.08, 0.70
# Opacity of the nearest wall over a device inside, as a share of the wall's opacity.
GLAZE = 0.45
_SAMPLES = 2  # samples along each side of a pixel
_LAYERS = 16  # largest number of walls that are drawn in a pixel, the nearest


@dataclass(frozen=True, eq=False)
class ParallelProjection:
    """A parallel projection of the world onto a picture."""

    right: np.ndarray  # unit vector (3,) of the picture's axis, world frame
    up: np.ndarray  # likewise
    low: np.ndarray  # corner (2,) of the picture along `right` and `up`, metres
    high: np.ndarray  # likewise
    pixels: float  # number of pixels along a metre

    @classmethod
    def of(
        cls,
        vertices: np.ndarray,
        right: Sequence[float] = (1.0, 0.0, 0.0),
        up: Sequence[float] = (0.0, 0.0, 1.0),
        *,
        margin: float = 6e-3,
        size: int = 900,
    ) -> "ParallelProjection":
        """A view that shows all vertices, from the front (AP) by default.

        Args:
            vertices: (V, 3), world frame, metres.
            margin: Space around the vertices, metres.
            size: Number of pixels along the longer side.
        """
        axes = np.array([right, up])
        flat = vertices @ axes.T
        low, high = flat.min(0) - margin, flat.max(0) + margin
        return cls(axes[0], axes[1], low, high, size / (high - low).max())

    def no_wider(self, ratio: float) -> "ParallelProjection":
        """Adds room above and below if the view is wider than `ratio` heights."""
        width, height = self.high - self.low
        room = np.array([0.0, max(width / ratio - height, 0.0) / 2])
        return replace(self, low=self.low - room, high=self.high + room)

    @property
    def towards(self) -> np.ndarray:
        """Unit vector (3,) from the scene towards the viewer."""
        return np.cross(self.right, self.up)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the picture."""
        width, height = np.round((self.high - self.low) * self.pixels).astype(int)
        return max(int(height), 1), max(int(width), 1)

    @property
    def extent_mm(self) -> tuple[float, ...]:
        """Left, right, bottom and top of the picture, mm, for matplotlib."""
        return tuple((1e3 * np.stack([self.low, self.high], axis=1)).ravel().tolist())

    def flat_mm(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) in metres as (..., 2) in the picture, mm."""
        return 1e3 * np.stack([points @ self.right, points @ self.up], axis=-1)

    def pixel(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) in metres as (..., 2): column and row, from the top left."""
        flat = self.flat_mm(points) / 1e3
        corner = np.array([self.low[0], self.high[1]])
        return (flat - corner) * [self.pixels, -self.pixels]


class Glass(NamedTuple):
    """Pictures (rows, columns, 4) of a vessel, float64 in [0, 1], not premultiplied."""

    behind: np.ndarray  # all walls, to be drawn first
    glaze: np.ndarray  # the nearest wall, to be drawn over the device


def glass(surface: Surface, projection: ParallelProjection) -> Glass:
    """Draw a closed surface as translucent glass."""
    fine = replace(projection, pixels=projection.pixels * _SAMPLES)
    rows, columns = projection.shape
    pixel, depth, normal = _hits(surface, fine, (_SAMPLES * rows, _SAMPLES * columns))
    order = np.lexsort((depth, pixel))  # within a sample, the farthest first
    pictures = np.zeros((2, rows, columns, 4))
    _blend(pixel[order], normal[order], pictures[0], pictures[1])
    pictures[..., :3] /= np.maximum(pictures[..., 3:], 1e-9)
    behind, glaze = np.clip(pictures, 0.0, 1.0)
    return Glass(behind, glaze)


def _hits(surface: Surface, projection: ParallelProjection, shape: tuple[int, int]):
    """Pixels (H,), depths (H,) towards the viewer and unit normals (H, 3) of hits."""
    frame = np.stack([projection.right, projection.up, projection.towards], axis=1)
    points = np.column_stack(
        [projection.pixel(surface.vertices), surface.vertices @ projection.towards]
    )
    normals = surface.normals @ frame
    cover = functools.partial(_cover, points, normals, surface.faces, shape)
    count = cover(np.empty(0, np.int64), np.empty(0), np.empty((0, 3)))
    pixel, depth = np.empty(count, np.int64), np.empty(count)
    normal = np.empty((count, 3))
    cover(pixel, depth, normal)
    return pixel, depth, normal


@compiled
def _cover(points, normals, faces, shape, pixel, depth, normal):
    """Write the hits of triangles, as far as there is room; return their number.

    Args:
        points: Vertices (V, 3): column, row and depth.
        normals: Their normals (V, 3).
        faces: Triangles (F, 3).
        shape: (rows, columns) of the picture.
        pixel: Written (H,): number of the pixel, row by row.
        depth: Written (H,).
        normal: Written (H, 3): unit normals.
    """
    count = 0
    for f in range(len(faces)):
        i, j, k = faces[f]
        a, b, c = points[i], points[j], points[k]
        ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
        area = ux * vy - uy * vx
        if abs(area) <= 1e-12:
            continue  # seen edge on, it covers nothing
        left = max(math.ceil(min(a[0], b[0], c[0]) - 0.5), 0)
        right = min(math.floor(max(a[0], b[0], c[0]) - 0.5), shape[1] - 1)
        top = max(math.ceil(min(a[1], b[1], c[1]) - 0.5), 0)
        bottom = min(math.floor(max(a[1], b[1], c[1]) - 0.5), shape[0] - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = column + 0.5 - a[0], row + 0.5 - a[1]
                second, third = (x * vy - y * vx) / area, (ux * y - uy * x) / area
                if second < 0.0 or third < 0.0 or second + third > 1.0:
                    continue
                if count < len(pixel):
                    first = 1.0 - second - third
                    pixel[count] = row * shape[1] + column
                    depth[count] = first * a[2] + second * b[2] + third * c[2]
                    n, total = normal[count], 0.0
                    for axis in range(3):
                        n[axis] = first * normals[i, axis] + second * normals[j, axis]
                        n[axis] += third * normals[k, axis]
                        total += n[axis] ** 2
                    n /= max(math.sqrt(total), 1e-9)
                count += 1
    return count


@compiled
def _blend(pixel, normal, behind, glaze):
    """Draw the hits of each sample, the farthest first; a pixel is their mean.

    Args:
        pixel: Number of the sample of each hit (H,), in order.
        normal: Unit normals (H, 3).
        behind: Added to (R, C, 4): all walls, colours premultiplied with opacity.
        glaze: Added to (R, C, 4): the nearest wall, likewise.
    """
    columns, share = _SAMPLES * behind.shape[1], 1.0 / _SAMPLES**2
    over, under, start = np.zeros(4), np.zeros(4), 0
    for end in range(1, len(pixel) + 1):
        if end < len(pixel) and pixel[end] == pixel[start]:
            continue
        under[:] = 0.0
        for hit in range(max(start, end - _LAYERS), end):
            n = normal[hit]
            opacity = FACING + (GRAZING - FACING) * (1.0 - abs(n[2])) ** 2.5
            # The wall is lit from both sides.
            light = n[0] * LIGHT[0] + n[1] * LIGHT[1] + n[2] * LIGHT[2]
            light = min(max(-light if n[2] < 0.0 else light, 0.0), 1.0)
            over[3] = opacity
            for k in range(3):
                colour = WALL_COLOUR[k] * (0.55 + 0.55 * light) + 0.5 * light**24
                over[k] = min(colour, 1.0) * opacity
            under[:] = over + (1.0 - opacity) * under
        row, column = divmod(pixel[start], columns)
        behind[row // _SAMPLES, column // _SAMPLES] += share * under
        glaze[row // _SAMPLES, column // _SAMPLES] += share * GLAZE * over
        start = end
