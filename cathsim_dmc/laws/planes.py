"""Tangent planes of the wall at a place of a capsule.

Where the wall is hollow across the device, one tangent plane turns with the device as
it rolls there, from step to step: a force f at a distance r from the axis about which
it turns is a stiffness f / r that no implicit step contains, and throws light links to
and fro. The wall is then two planes, tangent to it at `_ASIDE` to both sides: the
clearance linearised there. A wall that bends by more than 17° is a corner: two planes
of the walls beside it.

Under a light load one plane suffices. The force of a contact whose impedance starts
soft grows with the cube of the depth, so that its load times the slope s of the wall
beside it is a stiffness that the time step resolves up to a depth of
`_DEEP` (`_SLOPED` / s)^(1/3). In a compliant wall the force is linear in the depth, and
the bound is `light` / s. docs/physics.md derives both.
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
MOST = 4  # planes, so contacts, of a place
_ASIDE = 0.4e-3  # m, to both sides, from where tangent planes are taken
_HEAD_ON = 0.1  # sine between a capsule and the normal
_HOLLOW = 5e-6  # m, least distance of the planes' edge from the wall
# One plane suffices to this depth, m, at this slope; with 0.1 mm, tips swing at steps
# of 4 ms where they should rest. Two planes bear what one does at a depth less by the
# share `_SHARED`; from there to twice the depth they approach the wall.
_DEEP, _SLOPED, _SHARED = 0.4e-4, 0.06, 0.18
_CORNER = -0.3  # slope of the clearance beside a place in a corner
_STEEP = 0.5  # cosine between a wall of a corner and the normal, least to share a load
_ROOM = 1e-4  # m, activation distance of the second wall of a corner


class Touch(NamedTuple):
    """A place of a capsule at the wall, in the frame of the wall.

    Attributes:
        point: (3) m, on the axis of the capsule.
        axis: (3) unit vector of the capsule.
        normal: (3) unit vector away from the wall.
        clearance: Distance of the point from the wall, m.
        touching: Clearance at which the surfaces meet, m, where one plane suffices
            under a light load; 0 where it never does.
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
    """Unit vector (3) along the wall: across a capsule, or along it at turn 1."""
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
    """Writes the plane tangent to the wall beside a place; False where it has none.

    Args:
        wall: `wall.Wall`.
        touch: The place.
        side: (3) unit vector along the wall.
        slope: Of the clearance, over the way from the place to there.
        there: Clearance at `_ASIDE` along `side`, m.
        planes: Gets the plane.
        row: Where.
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
    """Writes the planes that stand for a wall that is hollow at a place.

    Args:
        wall: `wall.Wall`.
        touch: `Touch`.
        limit: m; planes farther away are left out.
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
        # To both sides the clearance slopes by its bend, times the way there.
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
