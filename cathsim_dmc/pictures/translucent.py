"""A vessel as translucent glass, drawn by numpy: no OpenGL, no window.

All hits of a pixel are sorted by depth, because translucent triangles painted one over
the other would show their seams. Glass is more opaque at the outline, where the line of
sight runs along the wall.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.parts import Surface

# Colour of the wall, RGB in [0, 1], as lit from the left above the viewer's eye.
WALL_COLOUR = np.array([0.80, 0.36, 0.33])
LIGHT = np.array([-0.35, 0.55, 0.76])
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
    rows, columns = (_SAMPLES * n for n in projection.shape)
    pixel, depth, normal = _hits(surface, fine, (rows, columns))
    order = np.lexsort((depth, pixel))  # within a pixel, the farthest first
    pixel, normal = pixel[order], normal[order]
    slant = 1.0 - np.abs(normal[:, 2:])
    opacity = FACING + (GRAZING - FACING) * slant**2.5
    # Colours are premultiplied with opacity until the end.
    hits = np.hstack([_lit(normal) * opacity, opacity])
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    count = np.diff(np.append(first, len(pixel)))
    behind, glaze = np.zeros((2, rows * columns, 4))
    drawn = np.minimum(count, _LAYERS)
    farthest = first + count - drawn
    for layer in range(int(drawn.max(initial=0))):
        deep = drawn > layer
        where, over = pixel[first[deep]], hits[farthest[deep] + layer]
        behind[where] = over + (1.0 - over[:, 3:]) * behind[where]
    glaze[pixel[first]] = GLAZE * hits[first + count - 1]
    shape = projection.shape
    return Glass(_smaller(behind, shape), _smaller(glaze, shape))


def _hits(surface: Surface, projection: ParallelProjection, shape: tuple[int, int]):
    """Pixels (H,), depths (H,) towards the viewer and unit normals (H, 3) of hits."""
    vertices, faces = surface.vertices, surface.faces
    frame = np.stack([projection.right, projection.up, projection.towards], axis=1)
    normals = surface.normals @ frame
    flat = projection.pixel(vertices)[faces]  # (F, 3, 2)
    depth = (vertices @ projection.towards)[faces]
    # Pixels of the boxes around the triangles.
    low = np.maximum(np.ceil(flat.min(1) - 0.5).astype(int), 0)
    high = np.floor(flat.max(1) - 0.5).astype(int)
    size = np.maximum(np.minimum(high, np.array(shape)[::-1] - 1) - low + 1, 0)
    boxes = size.prod(1)
    face = np.repeat(np.arange(len(faces)), boxes)
    number = np.arange(len(face)) - np.repeat(np.cumsum(boxes) - boxes, boxes)
    pixel = low[face] + np.stack(np.divmod(number, size[face, 0])[::-1], axis=1)
    a, b, c = flat.transpose(1, 0, 2)
    area = _cross(b - a, c - a)
    # Triangles seen edge on cover nothing.
    area = np.where(np.abs(area) > 1e-12, area, np.nan)[face]
    point = pixel + 0.5 - a[face]
    second = _cross(point, (c - a)[face]) / area
    third = _cross((b - a)[face], point) / area
    inside = (second >= 0) & (third >= 0) & (second + third <= 1)
    face, second, third = face[inside], second[inside], third[inside]
    share = np.stack([1 - second - third, second, third], axis=1)
    normal = np.einsum("hi,hij->hj", share, normals[faces[face]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    return pixel[inside] @ [1, shape[1]], np.vecdot(share, depth[face]), normal


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _lit(normal: np.ndarray) -> np.ndarray:
    """Colours (H, 3) of glass lit from both sides."""
    facing = np.where(normal[:, 2:] < 0, -normal, normal)
    light = np.clip(facing @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)[:, None]
    return np.clip(WALL_COLOUR * (0.55 + 0.55 * light) + 0.5 * light**24, 0, 1)


def _smaller(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Means over the samples of every pixel, colours not premultiplied."""
    rows, columns = shape
    image = image.reshape(rows, _SAMPLES, columns, _SAMPLES, 4).mean((1, 3))
    image[..., :3] /= np.maximum(image[..., 3:], 1e-9)
    return np.clip(image, 0, 1)
