"""The collider, compiled: capsules and spheres against a field; see `fields`.

`moving` has the collider of walls that move, which takes a second more to compile.
"""

from __future__ import annotations

import math

import numpy as np

from cathsim_dmc.anatomy.field_loops import FREE
from cathsim_dmc.collision.native import (
    address_of,
    call_collision,
    call_error,
    callback,
    data_field,
    model_field,
    numbers,
    wholes,
    word,
)
from cathsim_dmc.collision.places import (
    EVERY,
    across,
    along,
    away,
    clearance,
    length,
    straight,
    touches,
)
from cathsim_dmc.collision.table import (
    ERROR,
    LUMEN,
    MESSAGE,
    OF_CAPSULE,
    OF_SPHERE,
    SYMBOL,
    ends,
    entry_of,
    into,
    key_of,
    posed,
    swept,
)
from cathsim_dmc.compiled import compiled

_ASIDE = 0.4e-3  # m, to both sides, from where the planes of a hollow wall are taken
_MOST = 4  # contacts of a capsule and a box; more are fatal
_HEAD_ON = 0.1  # sine between a capsule and the normal
_HOLLOW = 5e-6  # m, least distance of their edge from the wall
# One plane does as long as its load, which grows with the cube of the depth, times the
# slope of the wall beside it is a stiffness that the time step stands: to this depth,
# m, at this slope. With steps of 4 ms some light tips vibrate even so (docs/limits.md).
# Two planes bear what one does at a depth less by a share; from there to twice the
# depth they come up to the wall.
_DEEP, _SLOPED, _SHARED = 1e-4, 0.06, 0.18
_SLACK = 0.1  # first impedance of a law that starts soft enough for that
_CORNER = -0.3  # slope of the clearance beside a place in a corner
_STEEP = 0.5  # cosine between a wall of a corner and the normal, least to share a load
_ROOM = 1e-4  # m, a link that touches one wall of a corner is held by others so close
# First impedance of a link whose wall gives. Two planes share the spring of a place, as
# the last bit of their depth says (`carrying`). One plane does up to a depth times
# slope, m, of so much, m/s², over |`solref`|: less than half a rigid wall's load.
SOFT, _LIGHT = 0.7, 15.0
# A link this close, m, is held: between contacts under load, one physics step without
# any lets the light tip jump by most of a millimetre.
_TOUCH = 1e-4
_AT_WALL = -1e-9  # m, the depth of a link so close
# So is a link that would be so deep, m, at the end of the physics step: it hits.
IMPACT = 1e-4


@compiled
def finite(pose):
    """Whether a place (3) and an axis (3) are numbers."""
    local, axis = pose
    return math.isfinite(local[0] + local[1] + local[2] + axis[0] + axis[1] + axis[2])


@compiled
def sideways(axis, normal, turn):
    """Unit vector (3) along the wall: across a capsule, or along it at turn 1."""
    b = across(axis, normal)
    if length(b) < _HEAD_ON:
        # An end that stands on the wall: any direction along the wall will do.
        b = across((1.0, 0.0, 0.0), normal)
        if abs(normal[0]) > 0.7:
            b = across((0.0, 1.0, 0.0), normal)
    if turn:
        b = across(normal, b)
    norm = length(b)
    return (b[0] / norm, b[1] / norm, b[2] / norm)


@compiled
def _depth_of_one(slope, light):
    """Depth, m, up to which one plane does for a hollow wall, see `tangents`."""
    if light > 0.0:
        return light / -slope
    return _DEEP * (_SLOPED / -slope) ** (1.0 / 3.0)


@compiled
def tangents(entry, place, axis, normal, depth, limit, held, light, turns, rows):
    """Planes (1 or 2 rows of unit normal and clearance) that stand for the wall.

    Where the wall is hollow across the device, one plane turns with the device as it
    rolls there, from step to step: a force f at a radius r of its way is a stiffness
    f / r that no implicit step knows of, and throws light links to and fro. The wall
    is then two planes that touch it to both sides: the field made linear there. Under
    a light load one plane does; it stands there where `held`, m, is the radius, and not
    where `held` is 0. In a wall that gives, one plane does up to a depth times slope of
    `light`, m, which is 0 for another wall. The last two of 6 rows are scratch.
    """
    found, least, shift = 0, np.inf, 0.0
    for turn in range(turns):
        bx, by, bz = sideways(axis, normal, turn)
        dx, dy, dz = _ASIDE * bx, _ASIDE * by, _ASIDE * bz
        low = clearance(entry, place[0] - dx, place[1] - dy, place[2] - dz)
        high = clearance(entry, place[0] + dx, place[1] + dy, place[2] + dz)
        # To both sides the clearance slopes by its bend, times the way there.
        rise = 0.5 * (low + high) - depth
        slope = 2.0 * rise / _ASIDE
        if low >= FREE or high >= FREE or rise >= -_HOLLOW:
            continue
        corner = slope < _CORNER
        if held > 0.0:
            one = _depth_of_one(slope, light)
            if held - depth < one:
                continue
            if light == 0.0:
                shift = _SHARED * max(2.0 * one - (held - depth), 0.0)
        for row in range(2):
            way = 2.0 * row - 1.0
            there = high if row else low
            if corner:
                x, y, z = place[0] + way * dx, place[1] + way * dy, place[2] + way * dz
                nx, ny, nz = away(entry, x, y, z)
                if nx == 0.0 and ny == 0.0 and nz == 0.0:
                    return 0
                there -= way * (nx * dx + ny * dy + nz * dz)
            else:
                size = math.sqrt(1.0 + slope * slope)
                nx = (normal[0] + way * slope * bx) / size
                ny = (normal[1] + way * slope * by) / size
                nz = (normal[2] + way * slope * bz) / size
                there -= slope / size * _ASIDE
            side = rows[4 + row]
            side[0], side[1], side[2], side[3] = nx, ny, nz, there
        # Planes are moved so that their edge lies at the true depth: a corner is round.
        excess = 0.5 * (rows[4, 3] + rows[5, 3]) - depth
        if corner:
            excess = max(min(rows[4, 3], rows[5, 3]) - depth, 0.0)
        excess -= shift
        for row in range(4, 6):
            steep = 0.0
            for k in range(3):
                steep += rows[row, k] * normal[k]
            least = min(least, rows[row, 3] - (0.0 if corner else excess))
            moved = excess if steep > _STEEP else 0.0
            if rows[row, 3] - moved <= limit + (_ROOM if corner else 0.0):
                for k in range(4):  # copying a slice takes seconds to compile
                    rows[found, k] = rows[row, k]
                rows[found, 3] -= moved
                found += 1
    # Planes of a corner may all be farther away than the wall is.
    if least > depth + _HOLLOW + shift:
        found = min(found, _MOST - 1)
        rows[found, 0], rows[found, 1], rows[found, 2] = normal
        rows[found, 3] = depth
        found += 1
    return found


@compiled
def put(data, contacts, geoms, written, most, rows, planes, t, limit, law):
    """Writes planes as contacts after those written, and returns how many there are."""
    radius, near, soft, _, _ = law
    turns = data_field(data, "geom_xmat")
    centre = data_field(data, "geom_xpos")[geoms[0]]
    turned, frame = turns[geoms[0]], turns[geoms[1]]
    for plane in range(planes):
        if written == most or rows[plane, 3] > limit:
            continue
        contact = numbers(contacts + 80 * written)
        distance = rows[plane, 3] - radius
        reached = radius + 0.5 * distance
        contact[0] = min(distance, _AT_WALL) if near > 0.0 else distance
        if soft:
            bits = wholes(contacts + 80 * written)
            bits[0] = (bits[0] & -2) | int(planes > 1)
        for k in range(3):
            towards = 0.0
            for i in range(3):
                towards -= frame[3 * k + i] * rows[plane, i]
            contact[1 + k] = centre[k] + t * turned[3 * k + 2] + reached * towards
            contact[4 + k] = towards
            contact[7 + k] = 0.0
        written += 1
    return written


@compiled
def nth(seen, n, soft):
    """Place n of a link: where, its clearance, whether it is the lowest, and its room.

    The room is how many contacts the link may have with it: 0 where it lies so close
    to a lower place that both are one, and fewer than all where another place follows.
    What is held at the lowest place is not at the other.
    """
    t, depth = (seen[3], seen[4]) if n else (seen[1], seen[2])
    lowest = depth <= (seen[2] if n else seen[4])
    if not lowest and seen[3] - seen[1] < EVERY and not soft:
        return t, depth, lowest, 0
    left = 1 + int(not lowest) if seen[0] - n == 2 else 0
    return t, depth, lowest, _MOST - left


@compiled
def sweep(model, data, geoms, axis, half, law):
    """How a capsule moves in a physics step, in the frame of the field.

    Returns:
        Ways (3) m of the middle and, a metre along the capsule, of its places; and the
        clearance below which they may hit, m.
    """
    still = (0.0, 0.0, 0.0)
    if law[1] == 0.0 or law[2]:
        return still, still, -np.inf
    travel, turn = swept(model, data, geoms[0])
    frame = data_field(data, "geom_xmat")[geoms[1]]
    travel, turn = into(frame, travel), into(frame, turn)
    aside = across(turn, axis)
    ahead = length(travel) + half * length(aside)
    return travel, aside, law[0] + ahead - IMPACT


@compiled
def at_rest(model, data, contacts, geoms, entry, pose, half, closed, margin, law):
    """Number of contacts, written, with a field that does not move."""
    radius, near, soft, held, light = law
    local, axis = pose
    limit = radius + margin + near
    travel, aside, far = sweep(model, data, geoms, axis, half, law)
    far = max(limit, far)
    seen = touches(entry, local, axis, half, closed, far)
    if seen[0] == 0:  # most links; rows take as long to make as all before
        return 0
    rows, written = np.empty((6, 4)), 0
    for n in range(seen[0]):
        t, depth, lowest, most = nth(seen, n, soft)
        if not most:
            continue
        place = along(local, axis, t)
        normal = away(entry, place[0], place[1], place[2])
        if normal == (0.0, 0.0, 0.0):
            continue
        if depth <= (limit if lowest else radius + margin):
            # A sphere may have one contact, so one plane.
            turns = 0 if half == 0.0 else 1 + int(lowest and abs(t) >= half)
            seen_at = place, axis, normal, depth, limit
            planes = tangents(entry, *seen_at, held, light, turns, rows)
        else:
            hits = along(travel, aside, t)
            ahead = normal[0] * hits[0] + normal[1] * hits[1] + normal[2] * hits[2]
            if depth + ahead > radius - IMPACT:
                continue
            rows[0, 0], rows[0, 1], rows[0, 2] = normal
            rows[0, 3], planes = depth, 1
        found = rows, planes, t, np.inf, law
        written = put(data, contacts, geoms, written, most, *found)
    return written


@compiled
def given(model, data, contacts, geom1, geom2, half, margin, entry):
    """What `at_rest` takes of a capsule, or a sphere, and the geom of an entry."""
    radius = model_field(model, "geom_size")[geom1, 0]
    closed = ends(model, data, geom1, half)
    pose = posed(data, entry, geom1, geom2)
    # A straight sheath holds the shaft without any load.
    near = 0.0 if margin > 0.0 or straight(entry) else _TOUCH
    impedance = model_field(model, "geom_solimp")[geom1, 0]
    soft = impedance == SOFT and word(entry + 8) == LUMEN
    light = 0.0
    if soft:
        light = _LIGHT / abs(model_field(model, "geom_solref")[geom1, 0])
    law = (radius, near, soft, radius if impedance < _SLACK or soft else 0.0, light)
    geoms = geom1, geom2
    return model, data, contacts, geoms, entry, pose, half, closed, margin, law


@compiled
def collide(model, data, contacts, geom1, geom2, margin, before):
    """Contacts of a capsule or a sphere with a box, which may carry a field.

    `before` is the place in the table of the function for boxes that do not; a constant
    would be compiled once for each.
    """
    table = address_of(SYMBOL)
    key = key_of(model, geom2)
    if key == 0:
        old = word(table + before)
        return call_collision(old, model, data, contacts, geom1, geom2, margin)
    entry = entry_of(table, key)
    if entry == 0:
        call_error(word(table + ERROR), word(table + MESSAGE), geom2)
        return np.int32(0)
    half = model_field(model, "geom_size")[geom1, 1] if before == OF_CAPSULE else 0.0
    taken = given(model, data, contacts, geom1, geom2, half, margin, entry)
    # What is no number has no place in a lattice; MuJoCo's checks of the state tell.
    return np.int32(at_rest(*taken) if finite(taken[5]) else 0)


@callback("int32(int64, int64, int64, int32, int32, float64)")
def of_capsule(model, data, contacts, geom1, geom2, margin):
    """Entry of MuJoCo's collision table for a capsule and a box."""
    return collide(model, data, contacts, geom1, geom2, margin, np.int64(OF_CAPSULE))


@callback("int32(int64, int64, int64, int32, int32, float64)")
def of_sphere(model, data, contacts, geom1, geom2, margin):
    """Entry of MuJoCo's collision table for a sphere and a box."""
    return collide(model, data, contacts, geom1, geom2, margin, np.int64(OF_SPHERE))
