"""Path length of X-rays through a closed surface: once per anatomy and view.

The length of a ray inside a closed surface is the sum of the distances at which it
leaves minus the sum of those at which it enters. Triangles are rasterised with
integer edge functions and a fill rule that gives a ray through a shared edge to
exactly one of the two triangles; so entries and exits always match, and the sum is
the exact chord of the triangle mesh for every ray.
"""

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging import kernel
from cathsim_dmc.imaging.carm import NEAREST, CArm


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
    # From pixel to ray index: ray i sits at (i + 0.5) / supersample - 0.5.
    grid = (pixels + 0.5) * supersample - 0.5
    corners = np.rint(grid * kernel.SUBDIVISIONS).astype(np.int64)
    rows, columns = carm.resolution
    total = np.zeros((rows * supersample, columns * supersample))
    kernel.add_surface(total, corners, 1.0 / depth, faces)
    total *= carm.slant(supersample)
    # Rounding leaves +-1e-16 where entries and exits cancel.
    total[np.abs(total) < 1e-12] = 0.0
    return total.reshape(rows, supersample, columns, supersample).mean(axis=(1, 3))
