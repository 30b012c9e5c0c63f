"""Path length of X-rays through a closed surface: once per anatomy and view.

The length of a ray inside a closed surface is the sum of the distances at which it
leaves minus the sum of those at which it enters. Integer edge functions and a fill rule
give a ray through a shared edge to exactly one triangle, so the sum is exact.
"""

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.compiled import compiled
from cathsim_dmc.imaging.carm import NEAREST, CArm

# Sub-divisions of the ray spacing to which projected vertices are rounded; edge
# functions are then exact in int64 for images up to 2**18 rays wide.
_SUBDIVISIONS = 4096


def surface_thickness(carm: CArm, surface: Surface, supersample: int = 3) -> np.ndarray:
    """Path length through the inside of a closed surface, averaged over each pixel.

    Parts of a self-overlapping surface count as often as they are enclosed.

    Args:
        surface: in the world frame, m, without open ends.
        supersample: rays along each side of a pixel, evenly spaced; 1 gives the
            chord of the ray through the pixel's centre.

    Returns:
        (rows, columns) float64, m.

    Raises:
        ValueError: if normals point inwards, `supersample` < 1, or the surface
            reaches the X-ray source.
    """
    if surface.volume <= 0.0:
        raise ValueError(
            f"the surface encloses {surface.volume:g} m³; it must be closed and its "
            "normals must point outwards."
        )
    bounds.whole("supersample", supersample, 1)
    pixels, depth = carm.project(surface.vertices)
    if depth[surface.faces].min() <= NEAREST:
        raise ValueError(
            f"the surface comes within {NEAREST:g} m of the X-ray source; move the "
            "isocentre onto the anatomy (CArm.centred_on)."
        )
    # From pixel to ray index: ray i sits at (i + 0.5) / supersample - 0.5.
    grid = (pixels + 0.5) * supersample - 0.5
    corners = np.rint(grid * _SUBDIVISIONS).astype(np.int64)
    rows, columns = carm.resolution
    total = np.zeros((rows * supersample, columns * supersample))
    _add_surface(total, corners, 1.0 / depth, surface.faces)
    total *= carm.slant(supersample)
    # Rounding leaves +-1e-16 where entries and exits cancel.
    total[np.abs(total) < 1e-12] = 0.0
    return total.reshape(rows, supersample, columns, supersample).mean(axis=(1, 3))


@compiled
def _add_surface(image, corners, inverse, faces):
    """Adds depths (m) at which rays leave a surface, minus those where they enter."""
    rows, columns = image.shape
    for face in range(len(faces)):
        i, j, k = faces[face]
        ax, ay, bx, by = corners[i, 0], corners[i, 1], corners[j, 0], corners[j, 1]
        cx, cy = corners[k, 0], corners[k, 1]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0:
            continue
        # Rows run downwards: a face turned to the detector, where rays leave, is
        # clockwise in its coordinates and so has a negative area.
        sign = -1.0 if area > 0 else 1.0
        if area < 0:
            bx, by, cx, cy, j, k = cx, cy, bx, by, k, j
        left = max(-(-min(ax, bx, cx) // _SUBDIVISIONS), 0)
        right = min(max(ax, bx, cx) // _SUBDIVISIONS, columns - 1)
        top = max(-(-min(ay, by, cy) // _SUBDIVISIONS), 0)
        bottom = min(max(ay, by, cy) // _SUBDIVISIONS, rows - 1)
        for row in range(top, bottom + 1):
            y = row * _SUBDIVISIONS
            for column in range(left, right + 1):
                x = column * _SUBDIVISIONS
                u = _edge(x, y, bx, by, cx, cy)
                v = _edge(x, y, cx, cy, ax, ay)
                w = _edge(x, y, ax, ay, bx, by)
                if u >= 0 and v >= 0 and w >= 0:
                    # One over depth, not depth, is linear across the image of a plane.
                    over = u * inverse[i] + v * inverse[j] + w * inverse[k]
                    image[row, column] += sign * (float(u + v + w) / over)


@compiled
def _edge(x, y, ax, ay, bx, by):
    """Edge function of a ray, -1 on an edge that points neither up nor level right."""
    dx, dy = bx - ax, by - ay
    value = dx * (y - ay) - dy * (x - ax)
    if value == 0 and not (dy < 0 or (dy == 0 and dx > 0)):
        return -1
    return value
