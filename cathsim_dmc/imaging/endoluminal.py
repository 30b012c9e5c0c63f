"""View of a camera in the head of a device, without OpenGL.

Sphere tracing: each ray steps forward by the depth of the lumen's field until it meets
the wall. The camera looks along +z of the head, with +x to the right and +y down.
"""

import math
from collections.abc import Sequence

import numpy as np

from cathsim_dmc.anatomy import motion_loops
from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.field_loops import behind, depth_at
from cathsim_dmc.anatomy.motion import STEEPEST
from cathsim_dmc.compiled import compiled
from cathsim_dmc.imaging.options import FARTHEST_WALL, VIEW_ANGLE

# Distance at which a wall that is met straight on is white, m.
WHITE = 8e-3
_CLOSE = 5e-6  # m, from the wall, where a ray ends
_MOST_STEPS = 100
# Nearer to the wall than this, m, the depth along a ray is taken as linear: the next
# place is where it vanishes, at most so many depths on, before any other wall.
_NEAR, _LONGEST = 1e-3, 8.0
_STEP = 0.25e-3  # m, to both sides, over which a gradient is taken

# Lattice, parameters and time (s) of a vessel that moves, see `motion_loops.warp`.
Warp = tuple[np.ndarray, np.ndarray, float]
AT_REST: Warp = (np.zeros(0), np.zeros(motion_loops.PARAMETERS), 0.0)


def views(
    lumens: Sequence[Field],
    warps: Sequence[Warp],
    heads: np.ndarray,
    frames: np.ndarray,
    resolution: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Views from N heads. The device itself and the sheath are not seen.

    Args:
        lumens: N fields.
        warps: N motions of the vessels, `AT_REST` for none.
        heads: (N, 3), world frame, m.
        frames: (N, 3, 3), orientations of the heads, axes in columns.
        resolution: (rows, columns).

    Returns:
        grey: (N, rows, columns, 1) uint8, 255 sqrt(cos) `WHITE` / distance at most,
            cos that of the angle between ray and normal of the wall.
        distance: (N, rows, columns, 1) float32, m, along the ray of the pixel's
            centre; `FARTHEST_WALL` where that meets no wall. An open end is closed.
    """
    shape = (len(heads), *resolution)
    grey, distance = np.empty(shape, np.uint8), np.empty(shape, np.float32)
    focal = 0.5 * resolution[0] / math.tan(math.radians(VIEW_ANGLE) / 2)
    rows = zip(lumens, warps, heads, frames, grey, distance, strict=True)
    for lumen, warp, head, frame, levels, lengths in rows:
        axes = np.ascontiguousarray(frame)
        _trace(lumen.arrays, *warp, head, axes, focal, levels, lengths)
    return grey[..., None], distance[..., None]


@compiled
def _clear(lumen, lattice, course, x, y, z, values):
    """Depth (m) of a place in space; in a vessel that moves, within its stretch."""
    growth = 0.0
    if len(lattice):
        there = values[8:].reshape(-1)
        motion_loops.warp(lattice, course, x, y, z, values, there)
        x, y, z, growth = there[0], there[1], there[2], there[12]
    level = behind(lumen[0], x, y, z)
    return -level if level > 0.0 else depth_at(*lumen, x, y, z) + growth


@compiled
def _met(lumen, lattice, course, eye, x, y, z, values):
    """Way (m) of a ray from an eye (3) along a unit vector to the wall."""
    # A displacement that stretches space makes distances in it shorter.
    stride = 1.0 / (1.0 + STEEPEST) if len(lattice) else 1.0
    t, step, before = 0.0, 0.0, 0.0
    for _ in range(_MOST_STEPS):
        a, b, c = eye[0] + t * x, eye[1] + t * y, eye[2] + t * z
        depth = _clear(lumen, lattice, course, a, b, c, values)
        if abs(depth) < _CLOSE or t == FARTHEST_WALL:
            break
        ahead = stride * depth
        if abs(depth) < _NEAR and (before - depth) * step > 0.0:
            longest = _LONGEST * abs(depth)
            ahead = min(max(depth * step / (before - depth), -longest), longest)
        step, before = ahead, depth
        t = min(max(t + step, 0.0), FARTHEST_WALL)
    return t


@compiled
def _trace(lumen, lattice, parameters, time, eye, axes, focal, grey, far):
    """Writes grey levels and distances (rows, columns) of the view of one camera."""
    values = np.empty((8 + motion_loops.WARP // 4, 4))
    slope, place = np.empty(3), np.empty(3)
    course = motion_loops.courses(parameters, time)
    rows, columns = far.shape
    for i in range(rows):
        v = (i + 0.5 - 0.5 * rows) / focal
        for j in range(columns):
            u = (j + 0.5 - 0.5 * columns) / focal
            norm = math.sqrt(1.0 + u * u + v * v)
            x = (axes[0, 0] * u + axes[0, 1] * v + axes[0, 2]) / norm
            y = (axes[1, 0] * u + axes[1, 1] * v + axes[1, 2]) / norm
            z = (axes[2, 0] * u + axes[2, 1] * v + axes[2, 2]) / norm
            t = _met(lumen, lattice, course, eye, x, y, z, values)
            far[i, j] = t
            for k in range(3):
                slope[k] = 0.0
                for side in (-_STEP, _STEP):
                    place[0], place[1] = eye[0] + t * x, eye[1] + t * y
                    place[2] = eye[2] + t * z
                    place[k] += side
                    a, b, c = place
                    slope[k] += side * _clear(lumen, lattice, course, a, b, c, values)
            size = math.sqrt(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2)
            facing = -(slope[0] * x + slope[1] * y + slope[2] * z)
            cosine = facing / size if size > 0.0 else 0.0
            level = 255.0 * math.sqrt(max(cosine, 0.0)) * WHITE / max(t, 1e-9)
            grey[i, j] = int(min(level, 255.0))
