"""Path length of X-rays through a closed surface: once per anatomy and view.

The length of a ray inside a closed surface is the sum of the distances at which it
leaves minus the sum of those at which it enters. Triangles are rasterised with
integer edge functions and a fill rule that gives a ray through a shared edge to
exactly one of the two triangles; so entries and exits always match, and the sum is
the exact chord of the triangle mesh for every ray.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging.carm import NEAREST, CArm

# Sub-divisions of the ray spacing to which projected vertices are rounded; edge
# functions are then exact in int64 for images up to 2**18 rays wide.
_SUBDIVISIONS = 4096
# Triangle-ray pairs looked at together; bounds the working memory to some 100 MB.
_CHUNK = 1_000_000


def surface_thickness(
    carm: CArm, vertices: ArrayLike, faces: ArrayLike, supersample: int = 3
) -> np.ndarray:
    """Path length through the inside of a closed surface, averaged over each pixel.

    Parts of a self-overlapping surface count as often as they are enclosed.

    Args:
        vertices: (V, 3) world frame, m.
        faces: (F, 3) indices, counter-clockwise seen from outside, without open ends.
        supersample: rays along each side of a pixel, evenly spaced; 1 gives the
            chord of the ray through the pixel's centre.

    Returns:
        (rows, columns) float64, m.

    Raises:
        ValueError: if shapes are wrong, normals point inwards, `supersample` < 1, or
            the surface reaches the X-ray source.
    """
    surface = Surface(np.asarray(vertices), np.asarray(faces))
    if surface.volume <= 0.0:
        raise ValueError(
            f"the surface encloses {surface.volume:g} m³; it must be closed and its "
            "normals must point outwards."
        )
    vertices, faces = surface.vertices, surface.faces
    if int(supersample) != supersample or supersample < 1:
        raise ValueError(f"supersample is {supersample!r}; give a whole number >= 1.")
    supersample = int(supersample)
    pixels, depth = carm.project(vertices)
    if depth[faces].min() <= NEAREST:
        raise ValueError(
            f"the surface comes within {NEAREST:g} m of the X-ray source; move the "
            "isocentre onto the anatomy (CArm.centred_on)."
        )
    rows, columns = (n * supersample for n in carm.resolution)
    # From pixel to ray index: ray i sits at (i + 0.5) / supersample - 0.5.
    grid = (pixels + 0.5) * supersample - 0.5
    corners = np.rint(grid * _SUBDIVISIONS).astype(np.int64)[faces]
    inverse = (1.0 / depth)[faces]

    (x0, y0), (x1, y1), (x2, y2) = (corners[:, i].T for i in range(3))
    doubled_area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    # Rows run downwards: a face turned to the detector, where rays leave, is
    # clockwise in its coordinates and so has a negative area.
    sign = -np.sign(doubled_area)
    turned = doubled_area < 0
    corners[turned] = corners[turned][:, [0, 2, 1]]
    inverse[turned] = inverse[turned][:, [0, 2, 1]]

    low = np.maximum(-(-corners.min(axis=1) // _SUBDIVISIONS), 0)
    high = np.minimum(corners.max(axis=1) // _SUBDIVISIONS, [columns - 1, rows - 1])
    size = np.maximum(high - low + 1, 0)
    pairs = size[:, 0] * size[:, 1]
    pairs[doubled_area == 0] = 0

    total = np.zeros(rows * columns)
    keep = np.flatnonzero(pairs)
    ends = np.cumsum(pairs[keep])
    start = 0
    while start < len(keep):
        done = ends[start - 1] if start else 0
        stop = int(np.searchsorted(ends, done + _CHUNK, side="right"))
        stop = max(stop, start + 1)
        part = keep[start:stop]
        ray, face, value = _rasterised(
            corners[part],
            inverse[part],
            low[part],
            size[part, 0],
            pairs[part],
            columns,
        )
        total += np.bincount(
            ray, weights=sign[part][face] * value, minlength=rows * columns
        )
        start = stop
    total = total.reshape(rows, columns) * carm.slant(supersample)
    # Rounding leaves +-1e-16 where entries and exits cancel.
    total[np.abs(total) < 1e-12] = 0.0
    shape = (carm.resolution[0], supersample, carm.resolution[1], supersample)
    return total.reshape(shape).mean(axis=(1, 3))


def _rasterised(corners, inverse, low, width, pairs, columns):
    """Every meeting of ray and triangle: flat ray index, triangle index, depth (m)."""
    face = np.repeat(np.arange(len(pairs)), pairs)
    within = np.arange(len(face)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    step_y, step_x = np.divmod(within, width[face])
    column, row = low[face, 0] + step_x, low[face, 1] + step_y
    x, y = column * _SUBDIVISIONS, row * _SUBDIVISIONS

    weights = []
    inside = np.ones(len(face), dtype=bool)
    for i in range(3):
        ax, ay = corners[:, (i + 1) % 3].T
        bx, by = corners[:, (i + 2) % 3].T
        dx, dy = bx - ax, by - ay
        # A ray exactly on an edge belongs to the triangle for which the edge points
        # up, or is level and points right: each direction wins exactly once.
        owns = (dy < 0) | ((dy == 0) & (dx > 0))
        edge = dx[face] * (y - ay[face]) - dy[face] * (x - ax[face])
        inside &= edge >= np.where(owns, 0, 1)[face]
        weights.append(edge)
    face, column, row = face[inside], column[inside], row[inside]
    weights = np.stack([w[inside] for w in weights]).astype(np.float64)
    # One over depth, not depth, is linear across the image of a plane.
    depth = weights.sum(axis=0) / (weights * inverse[face].T).sum(axis=0)
    return row * columns + column, face, depth
