"""View of a camera in the head of a device, without OpenGL.

Sphere tracing: each ray steps forward by the depth of the lumen's field until it meets
the wall. The camera looks along +z of the head, with +x to the right and +y down.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.motion import PARAMETERS, STEEPEST, course_of, scratch
from cathsim_dmc.compiled import compiled
from cathsim_dmc.imaging.options import FARTHEST_WALL, VIEW_ANGLE
from cathsim_dmc.laws.field import FieldArrays, behind, depth_at
from cathsim_dmc.laws.motion import VALUES, Course, rest_place, warp
from cathsim_dmc.laws.vectors import along

# Distance at which a wall that is met straight on is white, m.
WHITE = 8e-3
_CLOSE = 5e-6  # m, from the wall, where a ray ends
_MOST_STEPS = 100
# Nearer to the wall than this, m, the depth along a ray is taken as linear: the next
# step leads to its zero, and is at most `_LONGEST` depths long, to pass no other wall.
_NEAR, _LONGEST = 1e-3, 8.0
_STEP = 0.25e-3  # m, to both sides, over which a gradient is taken

# Lattice, parameters and time (s) of a vessel that moves, see `laws.motion.warp`.
Warp = tuple[np.ndarray, np.ndarray, float]
AT_REST: Warp = (np.zeros(0), np.zeros(PARAMETERS), 0.0)


class _Vessel(NamedTuple):
    """Field of a lumen and its motion: lattice, of no length at rest, and course."""

    field: FieldArrays
    lattice: np.ndarray
    course: Course


class _Camera(NamedTuple):
    """Place (3) m, axes (3, 3) in columns, and focal length in pixels."""

    eye: np.ndarray
    axes: np.ndarray
    focal: float


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
        grey: (N, rows, columns, 1) uint8, 255 sqrt(cos) `WHITE` / distance, at most
            255; cos is that of the angle between the ray and the normal of the wall.
        distance: (N, rows, columns, 1) float32, m, along the ray of the pixel's
            centre; `FARTHEST_WALL` where that meets no wall. An open end is closed.
    """
    shape = (len(heads), *resolution)
    grey, distance = np.empty(shape, np.uint8), np.empty(shape, np.float32)
    focal = 0.5 * resolution[0] / math.tan(math.radians(VIEW_ANGLE) / 2)
    rows = zip(lumens, warps, heads, frames, grey, distance, strict=True)
    for lumen, (lattice, parameters, time), head, frame, levels, lengths in rows:
        vessel = _Vessel(lumen.arrays, lattice, course_of(parameters, time))
        camera = _Camera(head, np.ascontiguousarray(frame), focal)
        _trace(vessel, camera, scratch(), levels, lengths)
    return grey[..., None], distance[..., None]


@compiled
def _depth(vessel, point, values):
    """Depth (m) of a point (3), in which the stretch of a motion is not counted."""
    growth = 0.0
    if len(vessel.lattice):
        there = values[VALUES:].reshape(-1)
        warp(vessel.lattice, vessel.course, point, values, there)
        point, growth = rest_place(there), there[12]
    level = behind(vessel.field.head, point)
    return -level if level > 0.0 else depth_at(vessel.field, point) + growth


@compiled
def _distance(vessel, eye, ray, values):
    """Distance (m) of the wall from an eye (3) along a ray, a unit vector (3)."""
    # The stretch of a motion makes distances shorter than depths, up to this factor.
    stride = 1.0 / (1.0 + STEEPEST) if len(vessel.lattice) else 1.0
    t, step, before = 0.0, 0.0, 0.0
    for _ in range(_MOST_STEPS):
        depth = _depth(vessel, along(eye, ray, t), values)
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
def _slope(vessel, point, axis, values):
    """Difference of the depth along an axis at a point (3), times the step, m²."""
    slope = 0.0
    for side in (-_STEP, _STEP):
        x, y, z = point
        x += side if axis == 0 else 0.0
        y += side if axis == 1 else 0.0
        z += side if axis == 2 else 0.0
        slope += side * _depth(vessel, (x, y, z), values)
    return slope


@compiled
def _trace(vessel, camera, values, grey, far):
    """Writes grey levels and distances (rows, columns) of the view of one camera.

    `values` is the scratch of `laws.motion.to_rest`.
    """
    axes, eye = camera.axes, camera.eye
    rows, columns = far.shape
    for i in range(rows):
        v = (i + 0.5 - 0.5 * rows) / camera.focal
        for j in range(columns):
            u = (j + 0.5 - 0.5 * columns) / camera.focal
            norm = math.sqrt(1.0 + u * u + v * v)
            x = (axes[0, 0] * u + axes[0, 1] * v + axes[0, 2]) / norm
            y = (axes[1, 0] * u + axes[1, 1] * v + axes[1, 2]) / norm
            z = (axes[2, 0] * u + axes[2, 1] * v + axes[2, 2]) / norm
            far[i, j] = t = _distance(vessel, eye, (x, y, z), values)
            point = along(eye, (x, y, z), t)
            a = _slope(vessel, point, 0, values)
            b = _slope(vessel, point, 1, values)
            c = _slope(vessel, point, 2, values)
            size = math.sqrt(a**2 + b**2 + c**2)
            facing = -(a * x + b * y + c * z)
            cosine = facing / size if size > 0.0 else 0.0
            level = 255.0 * math.sqrt(max(cosine, 0.0)) * WHITE / max(t, 1e-9)
            grey[i, j] = int(min(level, 255.0))
