"""Tangent planes of the wall at a place of a capsule.

Where the wall is concave across the device, the normal of a single tangent plane turns
as the device moves sideways. A force f at a radius r then acts as a stiffness f / r
outside the implicit step, and light links oscillate. The contact is therefore two
planes, the clearance linearised at `_ASIDE` to both sides. Where the wall bends by more
than 17° (a corner), they are the tangent planes of the walls to both sides.

Under a light load one plane suffices. The force of a contact whose impedance starts
soft grows with the cube of the depth, so load times slope s of the clearance is a
stiffness that the time step resolves up to a depth of `_DEEP` (`_SLOPED` / s)^(1/3)
(docs/physics.md). In a compliant wall the force is linear in the depth, and the bound
is `light` / s.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.compiled import inlined, law
from cathsim_dmc.laws.field import FREE
from cathsim_dmc.laws.vectors import along, cross, dot, length, unit
from cathsim_dmc.laws.wall import clearance, normal_at

PLANES = 6  # rows of scratch: four planes at most, and the two beside the place
MOST = 4  # largest number of planes of a place, and of contacts of a capsule
_ASIDE = 0.4e-3  # m, to both sides, where tangent planes are taken
_HEAD_ON = 0.1  # sine of capsule and normal below which the capsule is head-on
_HOLLOW = 5e-6  # m, least fall of the clearance to both sides in a hollow
# One plane suffices up to the depth `_DEEP`, m, at the slope `_SLOPED`; with 0.1 mm,
# tips oscillate at steps of 4 ms instead of resting. Two planes bear more than one, so
# they start off the wall by the fraction `_SHARED` of that depth and reach the wall at
# twice the depth.
_DEEP, _SLOPED, _SHARED = 0.4e-4, 0.06, 0.18
_CORNER = -0.3  # slope of the clearance below which a place is in a corner
_STEEP = 0.5  # cosine to the normal above which a plane is moved to the true depth
_ROOM = 1e-4  # m, additional activation distance of the walls of a corner


class Touch(NamedTuple):
    """A place of a capsule at the wall, in the frame of the wall.

    Attributes:
        point: (3) m, on the axis of the capsule.
        axis: (3) unit vector of the capsule.
        normal: (3) unit vector away from the wall.
        clearance: Distance of the point from the wall, m.
        touching: Clearance at which the surfaces meet, m, if one plane suffices under
            a light load; 0 if it never does.
        light: Depth times slope up to which one plane suffices in a compliant wall,
            m; 0 in a rigid one.
    """

    point: Any
    axis: Any
    normal: Any
    clearance: Any
    touching: Any
    light: Any


@inlined
def _sideways(axis, normal, turn):
    """Unit tangent (3) of the wall: across a capsule at turn 0, along it at turn 1."""
    b = cross(axis, normal)
    if length(b) < _HEAD_ON:
        # An end that stands on the wall: any direction along the wall will do.
        b = cross((1.0, 0.0, 0.0), normal)
        if abs(normal[0]) > 0.7:
            b = cross((0.0, 1.0, 0.0), normal)
    if turn:
        b = cross(normal, b)
    return unit(b)


@inlined
def _depth_of_one(slope, light):
    """Depth (m) up to which one plane suffices at a negative slope."""
    if light > 0.0:
        return light / -slope
    return _DEEP * (_SLOPED / -slope) ** (1.0 / 3.0)


@inlined
def write_plane(planes, row, normal, value):
    """Writes a plane: its unit normal (3) away from the wall, and the clearance, m."""
    # Copying a slice takes seconds to compile.
    planes[row, 0], planes[row, 1], planes[row, 2] = normal
    planes[row, 3] = value


@inlined
def plane_normal(planes, row):
    """Unit normal (3) of a plane."""
    return (planes[row, 0], planes[row, 1], planes[row, 2])


@inlined
def _beside(wall, touch, side, slope, there, planes, row):
    """Writes the plane tangent to the wall beside a place; False if it has no normal.

    Args:
        wall: `wall.Wall`.
        touch: The place.
        side: (3) unit vector along the wall.
        slope: Slope of the clearance along `side` at `_ASIDE`.
        there: Clearance at `_ASIDE` along `side`, m.
        planes: (`PLANES`, 4), gets the plane.
        row: Row of the plane.
    """
    if slope < _CORNER:
        offset = (_ASIDE * side[0], _ASIDE * side[1], _ASIDE * side[2])
        normal = normal_at(wall, along(touch.point, offset, 1.0))
        if normal == (0.0, 0.0, 0.0):
            return False
        write_plane(planes, row, normal, there - dot(normal, offset))
        return True
    size = math.sqrt(1.0 + slope * slope)
    x, y, z = along(touch.normal, side, slope)
    normal = (x / size, y / size, z / size)
    write_plane(planes, row, normal, there - slope / size * _ASIDE)
    return True


@inlined
def _clearances_beside(wall, point, side):
    """Clearances (m) at `_ASIDE` from a point to both sides of a unit vector (3)."""
    low, high = 0.0, 0.0
    for way in range(2):
        reach = _ASIDE if way else -_ASIDE
        low, high = high, clearance(wall, along(point, side, reach))
    return low, high


@law
def tangent_planes(wall, touch, limit, turns, planes):
    """Writes the planes that represent the wall at a place.

    Args:
        wall: `wall.Wall`.
        touch: `Touch`.
        limit: Largest clearance of a plane, m.
        turns: 0 for one plane at most, 1 to look across the capsule, 2 along it too.
        planes: (`PLANES`, 4), gets unit normals away from the wall and clearances, m.

    Returns:
        Number of planes.
    """
    found, least, shift, depth = 0, np.inf, 0.0, touch.clearance
    held = touch.touching - depth
    for turn in range(turns):
        side = _sideways(touch.axis, touch.normal, turn)
        low, high = _clearances_beside(wall, touch.point, side)
        # Slope at `_ASIDE` of a parabola; the mean of both sides removes its tilt.
        rise = 0.5 * (low + high) - depth
        slope = 2.0 * rise / _ASIDE
        if low >= FREE or high >= FREE or rise >= -_HOLLOW:
            continue
        corner = slope < _CORNER
        if touch.touching > 0.0:
            one = _depth_of_one(slope, touch.light)
            if held < one:
                continue
            if touch.light == 0.0:
                shift = _SHARED * max(2.0 * one - held, 0.0)
        for row in range(2):
            way = 2.0 * row - 1.0
            beside = (way * side[0], way * side[1], way * side[2])
            there = high if row else low
            if not _beside(wall, touch, beside, slope, there, planes, 4 + row):
                return 0
        # Planes are moved so that their edge lies at the true depth: a corner is round.
        excess = 0.5 * (planes[4, 3] + planes[5, 3]) - depth
        if corner:
            excess = max(min(planes[4, 3], planes[5, 3]) - depth, 0.0)
        excess -= shift
        for row in range(4, 6):
            normal = plane_normal(planes, row)
            least = min(least, planes[row, 3] - (0.0 if corner else excess))
            moved = excess if dot(normal, touch.normal) > _STEEP else 0.0
            if planes[row, 3] - moved <= limit + (_ROOM if corner else 0.0):
                write_plane(planes, found, normal, planes[row, 3] - moved)
                found += 1
    # Planes of a corner may all be farther away than the wall is.
    if least > depth + _HOLLOW + shift:
        found = min(found, MOST - 1)
        write_plane(planes, found, touch.normal, depth)
        found += 1
    return found
