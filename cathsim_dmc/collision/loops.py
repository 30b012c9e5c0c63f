"""The collider, compiled: capsules and spheres against a field; see `contact`."""

from __future__ import annotations

import math

import numpy as np

from cathsim_dmc.anatomy.field_loops import FREE, clearance_at, gradient_at
from cathsim_dmc.anatomy.motion_loops import MARK as MOTION
from cathsim_dmc.anatomy.motion_loops import VALUES, WARP, in_space, warp
from cathsim_dmc.collision.native import (
    address_of,
    call_collision,
    call_error,
    callback,
    numbers,
    shorts,
    symbol,
    wholes,
    word,
)
from cathsim_dmc.compiled import compiled

# Words in the head of the table: offsets in mjModel and mjData, the functions that
# stood in MuJoCo's collision table, and how an error is raised.
(
    NUSER_GEOM,
    GEOM_USER,
    GEOM_SIZE,
    GEOM_BODYID,
    BODY_PARENTID,
    GEOM_XPOS,
    GEOM_XMAT,
    XPOS,
    OF_CAPSULE,
    OF_SPHERE,
    ERROR,
    MESSAGE,
    GEOM_SOLIMP,
    NUSERDATA,
    USERDATA,
    TIME,
    BODY_DOFADR,
    BODY_DOFNUM,
    BODY_ROOTID,
    DOF_PARENTID,
    TIMESTEP,
    QVEL,
    CDOF,
    SUBTREE_COM,
) = range(0, 192, 8)
HEAD = 24  # words
# An entry: key, kind, addresses of the place of the carrier's middle in the field's
# frame, of head, coarse lattice, index and samples, and of the lattice of its motion.
ENTRY, CAPACITY = 8, 1 << 14
LUMEN, BORE = 0, 1
# Numbers of a carrier geom: the mark, then the key of its field in three parts, which
# any printing of a model file keeps.
USER, MARK, PART = 4, 730155.0, 1 << 20
SYMBOL = "cathsim_fields"
# Before anything that knows it by the symbol is loaded.
TABLE = np.zeros(HEAD + ENTRY * CAPACITY, np.int64)
symbol(SYMBOL, TABLE)

_EVERY = 1e-3  # m, apart are the places of a capsule that are looked at first
_PLACES = 65  # at most
# A dent of the clearance must be so deep, m, to be a contact of its own: a capsule
# that lies flat on a wall has many that are none.
_DENT = 5e-6
_FLAT = 2e-6
_BISECTIONS = 6
_ASIDE = 0.4e-3  # m, to both sides, from where the planes of a hollow wall are taken
_MOST = 4  # contacts of a capsule and a box; more are fatal
_HEAD_ON = 0.1  # sine between a capsule and the normal
_HOLLOW = 5e-6  # m, least distance of their edge from the wall
# One plane does as long as its load, which grows with the cube of the depth, times the
# slope of the wall beside it is a stiffness that the time step stands: to this depth,
# m, at this slope. Two planes bear what one does at a depth less by a share; from there
# to twice the depth they come up to the wall.
_DEEP, _SLOPED, _SHARED = 1e-4, 0.06, 0.18
_SLACK = 0.1  # first impedance of a law that starts soft enough for that
_CORNER = -0.3  # slope of the clearance beside a place in a corner
_STEEP = 0.5  # cosine between a wall of a corner and the normal, least to share a load
_ROOM = 1e-4  # m, a link that touches one wall of a corner is held by others so close
_STEP = 0.25e-3  # m, to both sides, over which the wall's normal is taken
_FAR = 1e-3  # m, by which the coarse lattice may be wrong far from the wall
_COUNT = 1 << 40  # more than any array has; nothing checks it
_JOINED = 1e-6  # m
NONE = (0, 0.0, FREE, 0.0, FREE)  # of `touches`
# First impedance of a link whose wall gives: two planes share the spring of a place,
# wherever the wall is not hollow the same one twice.
SOFT = 0.7
# A link this close, m, is held: between contacts under load, one physics step without
# any lets the light tip jump by most of a millimetre.
_TOUCH = 2e-5
_AT_WALL = -1e-9  # m, the depth of a link so close
# So is a link that would be so deep, m, at the end of the physics step: it hits.
_IMPACT = 1e-4
# In a moving vessel a capsule is looked for by its straight image at rest, which is off
# by so much, m, and by the strain of space; its contacts are looked up exactly.
_IMAGE, _STRAIN = 0.2e-3, 1.7
MOTION_ENTRY = 56  # bytes from an entry to the address of the lattice of its motion


@compiled
def entry_of(table, key):
    """Address of the entry with a key, 0 for none."""
    slot = key % CAPACITY
    for _ in range(CAPACITY):
        at = table + 8 * (HEAD + ENTRY * slot)
        found = word(at)
        if found == key:
            return at
        if found == 0:
            return 0
        slot = (slot + 1) % CAPACITY
    return 0


@compiled
def bore_at(head, x, y, z):
    """Clearance in a bore around a line, m, and the way (3) m to the nearest place."""
    count = int(head[0])
    best, value, way = np.inf, FREE, (0.0, 0.0, 0.0)
    for k in range(count - 1):
        a, b = 1 + 4 * k, 5 + 4 * k
        dx, dy, dz = (
            head[b] - head[a],
            head[b + 1] - head[a + 1],
            head[b + 2] - head[a + 2],
        )
        px, py, pz = x - head[a], y - head[a + 1], z - head[a + 2]
        u = (px * dx + py * dy + pz * dz) / (dx * dx + dy * dy + dz * dz)
        beyond = (k == 0 and u < 0.0) or (k == count - 2 and u > 1.0)
        u = min(max(u, 0.0), 1.0)
        qx, qy, qz = px - u * dx, py - u * dy, pz - u * dz
        square = qx * qx + qy * qy + qz * qz
        if square < best:
            best = square
            value = FREE
            if not beyond:
                value = (1.0 - u) * head[a + 3] + u * head[b + 3] - math.sqrt(square)
            way = (-qx, -qy, -qz)
    return value, way


@compiled
def clearance(entry, x, y, z):
    """Distance (m) from the wall of an entry's field, `FREE` past its open ends."""
    head = numbers(word(entry + 24), _COUNT)
    if word(entry + 8) == BORE:
        return bore_at(head, x, y, z)[0]
    return clearance_at(
        head,
        shorts(word(entry + 32), _COUNT),
        wholes(word(entry + 40), _COUNT),
        shorts(word(entry + 48), _COUNT),
        x,
        y,
        z,
    )


@compiled
def length(way):
    """Length of a vector (3)."""
    return math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)


@compiled
def across(one, other):
    """Cross product (3) of two vectors."""
    return (
        one[1] * other[2] - one[2] * other[1],
        one[2] * other[0] - one[0] * other[2],
        one[0] * other[1] - one[1] * other[0],
    )


@compiled
def away(entry, x, y, z):
    """Unit vector (3) away from the wall; zeros where there is none."""
    head = numbers(word(entry + 24), _COUNT)
    if word(entry + 8) == BORE:
        way = bore_at(head, x, y, z)[1]
    else:
        coarse = shorts(word(entry + 32), _COUNT)
        index = wholes(word(entry + 40), _COUNT)
        samples = shorts(word(entry + 48), _COUNT)
        way = gradient_at(head, coarse, index, samples, x, y, z, _STEP)
    norm = length(way)
    if norm < 1e-12:
        return (0.0, 0.0, 0.0)
    return (way[0] / norm, way[1] / norm, way[2] / norm)


@compiled
def along(centre, axis, t):
    """Place (3) m along a capsule's axis."""
    return (
        centre[0] + t * axis[0],
        centre[1] + t * axis[1],
        centre[2] + t * axis[2],
    )


@compiled
def clearance_along(entry, centre, axis, t):
    """Clearance (m) of a place along a capsule's axis."""
    x, y, z = along(centre, axis, t)
    return clearance(entry, x, y, z)


@compiled
def dented(values, count, i, closed):
    """Whether the clearance rises to both sides of a place: it is a contact by itself.

    It rises by `_DENT`, or up to an end that is no contact.
    """
    for side, way in enumerate((-1, 1)):
        rise, k = 0.0, i + way
        while 0 <= k < count and values[k] >= values[i] and rise < _DENT:
            rise = max(rise, values[k] - values[i])
            k += way
        if rise >= _DENT:
            continue
        if 0 <= k < count or not closed[side]:
            return False
        if values[k - way] <= values[k - 2 * way] + _FLAT:
            return False
    return True


@compiled
def lowest(entry, centre, axis, half, t, value, step):
    """Place (m along a capsule) of the least clearance within a step of t, and it.

    Bisected, because the clearance has a kink at an edge of the wall; then a parabola.
    """
    left, right = max(t - step, -half), min(t + step, half)
    before = clearance_along(entry, centre, axis, left)
    after = clearance_along(entry, centre, axis, right)
    for _ in range(_BISECTIONS):
        upper = right - t > t - left
        place = 0.5 * (t + (right if upper else left))
        there = clearance_along(entry, centre, axis, place)
        if there < value:
            if upper:
                left, before = t, value
            else:
                right, after = t, value
            t, value = place, there
        elif upper:
            right, after = place, there
        else:
            left, before = place, there
    one, other = (after - value) * (t - left), (before - value) * (right - t)
    if one > 0.0 and other > 0.0:
        place = t + 0.5 * (other * (right - t) - one * (t - left)) / (one + other)
        there = clearance_along(entry, centre, axis, place)
        if there < value:
            t, value = place, there
    return t, value


@compiled
def straight(entry):
    """Whether an entry is a bore with one piece."""
    return word(entry + 8) == BORE and numbers(word(entry + 24), 1)[0] == 2.0


@compiled
def in_straight_bore(head, centre, axis, half, closed, limit):
    """As `touches`, in a bore with one piece: nearest to it are ends, or its rim.

    Within, the clearance is a concave function of the place along the capsule.
    """
    dx, dy, dz = head[5] - head[1], head[6] - head[2], head[7] - head[3]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / length, dy / length, dz / length
    level = (
        (centre[0] - head[1]) * dx
        + (centre[1] - head[2]) * dy
        + (centre[2] - head[3]) * dz
    )
    rate = axis[0] * dx + axis[1] * dy + axis[2] * dz
    low, high, first, second = -half, half, closed[0], closed[1]
    if abs(rate) > 1e-9:
        near, far = -level / rate, (length - level) / rate
        near, far = min(near, far), max(near, far)
        if near > low:
            low, first = near, True
        if far < high:
            high, second = far, True
    elif not 0.0 <= level <= length:
        return NONE
    if low > high:
        return NONE
    lower, higher = FREE, FREE
    for end in range(1 if half == 0.0 else 2):
        if not (second if end else first):
            continue
        x, y, z = along(centre, axis, high if end else low)
        px, py, pz = x - head[1], y - head[2], z - head[3]
        way = px * dx + py * dy + pz * dz
        qx, qy, qz = px - way * dx, py - way * dy, pz - way * dz
        radius = head[4] + (head[8] - head[4]) * way / length
        value = radius - math.sqrt(qx * qx + qy * qy + qz * qz)
        if end:
            higher = value
        else:
            lower = value
    if lower > limit:
        return (int(higher <= limit), high, higher, 0.0, FREE)
    return (1 + int(higher <= limit), low, lower, high, higher)


@compiled
def touches(entry, centre, axis, half, closed, limit):
    """Places of a capsule's axis that are nearest to the wall, two at most.

    Args:
        entry: address of the field's entry.
        centre: (3) m, of the capsule.
        axis: (3) unit vector along it.
        half: m, half its length without the round ends.
        closed: (2) whether the ends at -half and half are looked at.
        limit: m; what is farther from the wall does not count.

    Returns:
        Number of places; of each, m along the axis and the clearance there, m.
    """
    if straight(entry):
        head = numbers(word(entry + 24), _COUNT)
        return in_straight_bore(head, centre, axis, half, closed, limit)
    middle = clearance(entry, centre[0], centre[1], centre[2])
    if middle < FREE and middle - half > limit + _FAR:
        return NONE
    if (
        middle >= FREE
        and half > 0.0
        and clearance_along(entry, centre, axis, -half) >= FREE
        and clearance_along(entry, centre, axis, half) >= FREE
    ):
        return NONE
    count = 1
    if half > 0.0:
        count += min(max(int(math.ceil(2.0 * half / _EVERY)), 2), _PLACES - 1)
    values = np.empty(count)
    step = 2.0 * half / max(count - 1, 1)
    least, i = np.inf, 0
    while i < count:
        value = values[i] = clearance_along(entry, centre, axis, -half + i * step)
        least = min(least, value)
        i += 1
        # The clearance changes by at most the way, but where an open end begins.
        while i < count and value < FREE and value - step > limit + _FAR:
            value -= step
            values[i] = value
            i += 1
    if least > limit + step:
        return NONE
    found, first, low, second, lower = NONE
    deepest = np.argmin(values)
    for i in range(count):
        value, t = values[i], -half + i * step
        at_end, open_end = i == 0 or i == count - 1, False
        if at_end:
            beside = values[min(1, count - 1)] if i == 0 else values[i - 1]
            if value > beside + _FLAT:
                continue
            open_end = not closed[0 if i == 0 else 1]
        elif not (value <= values[i - 1] and value < values[i + 1]):
            continue
        elif i != deepest and not dented(values, count, i, closed):
            continue
        if value > limit + step:
            continue
        if half > 0.0:
            t, value = lowest(entry, centre, axis, half, t, value, step)
            if open_end and values[i] - value < _DENT:
                continue
        if value > limit:
            continue
        # The two that are nearest to the wall, in the order of the axis.
        if found == 2:
            if value >= max(low, lower):
                continue
            if low > lower:
                first, low = second, lower
            found = 1
        if found:
            second, lower = t, value
        else:
            first, low = t, value
        found += 1
    return (found, first, low, second, lower)


@compiled
def tangents(entry, place, axis, normal, depth, limit, held, turns, rows):
    """Planes (1 or 2 rows of unit normal and clearance) that stand for the wall.

    Where the wall is hollow across the device, one plane turns with the device as it
    rolls there, from step to step: a force f at a radius r of its way is a stiffness
    f / r that no implicit step knows of, and throws light links to and fro. The wall
    is then two planes that touch it to both sides: the field made linear there. Under
    a light load one plane does; it stands there where `held`, m, is the radius, and not
    where `held` is 0. The last two of 6 rows are scratch.
    """
    found, least, shift = 0, np.inf, 0.0
    for turn in range(turns):
        bx, by, bz = across(axis, normal)
        if length((bx, by, bz)) < _HEAD_ON:
            # An end that stands on the wall: any direction along the wall will do.
            bx, by, bz = across((1.0, 0.0, 0.0), normal)
            if abs(normal[0]) > 0.7:
                bx, by, bz = across((0.0, 1.0, 0.0), normal)
        if turn:
            bx, by, bz = across(normal, (bx, by, bz))
        norm = length((bx, by, bz))
        bx, by, bz = bx / norm, by / norm, bz / norm
        dx, dy, dz = _ASIDE * bx, _ASIDE * by, _ASIDE * bz
        low = clearance(entry, place[0] - dx, place[1] - dy, place[2] - dz)
        high = clearance(entry, place[0] + dx, place[1] + dy, place[2] + dz)
        if low >= FREE or high >= FREE:
            continue
        # To both sides the clearance slopes by its bend, times the way there.
        rise = 0.5 * (low + high) - depth
        slope = 2.0 * rise / _ASIDE
        if rise >= -_HOLLOW:
            continue
        corner = slope < _CORNER
        if held > 0.0:
            one = _DEEP * (_SLOPED / -slope) ** (1.0 / 3.0)
            if held - depth < one:
                continue
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
def ends(table, model, data, geom, half):
    """Which ends (2) of a capsule count: one at its body's joint is another link's."""
    body = wholes(word(model + word(table + GEOM_BODYID)) + 4 * geom, 1)[0]
    parent = wholes(word(model + word(table + BODY_PARENTID)) + 4 * body, 1)[0]
    if parent == 0 or half == 0.0:
        return (True, True)
    centre = numbers(word(data + word(table + GEOM_XPOS)) + 24 * geom, 3)
    turned = numbers(word(data + word(table + GEOM_XMAT)) + 72 * geom, 9)
    joint = numbers(word(data + word(table + XPOS)) + 24 * body, 3)
    low, high = 0.0, 0.0
    for k in range(3):
        low += (centre[k] - half * turned[3 * k + 2] - joint[k]) ** 2
        high += (centre[k] + half * turned[3 * k + 2] - joint[k]) ** 2
    return (low > _JOINED * _JOINED, high > _JOINED * _JOINED)


@compiled
def swept(table, model, data, geom):
    """Ways of a geom's middle (3) and turn (3) in a physics step at its velocity, m."""
    body = wholes(word(model + word(table + GEOM_BODYID)) + 4 * geom, 1)[0]
    parents = wholes(word(model + word(table + BODY_PARENTID)), _COUNT)
    counts = wholes(word(model + word(table + BODY_DOFNUM)), _COUNT)
    while body > 0 and counts[body] == 0:
        body = parents[body]
    a, b, c, x, y, z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if body == 0:
        return (x, y, z), (a, b, c)
    ancestors = wholes(word(model + word(table + DOF_PARENTID)), _COUNT)
    velocities = numbers(word(data + word(table + QVEL)), _COUNT)
    motions = word(data + word(table + CDOF))
    first = wholes(word(model + word(table + BODY_DOFADR)) + 4 * body, 1)[0]
    dof = first + counts[body] - 1
    while dof >= 0:
        motion, velocity = numbers(motions + 48 * dof, 6), velocities[dof]
        a, b, c = (
            a + motion[0] * velocity,
            b + motion[1] * velocity,
            c + motion[2] * velocity,
        )
        x, y, z = (
            x + motion[3] * velocity,
            y + motion[4] * velocity,
            z + motion[5] * velocity,
        )
        dof = ancestors[dof]
    root = wholes(word(model + word(table + BODY_ROOTID)) + 4 * body, 1)[0]
    about = numbers(word(data + word(table + SUBTREE_COM)) + 24 * root, 3)
    centre = numbers(word(data + word(table + GEOM_XPOS)) + 24 * geom, 3)
    step = numbers(model + word(table + TIMESTEP), 1)[0]
    u, v, w = centre[0] - about[0], centre[1] - about[1], centre[2] - about[2]
    x, y, z = x + b * w - c * v, y + c * u - a * w, z + a * v - b * u
    return (step * x, step * y, step * z), (step * a, step * b, step * c)


@compiled
def into(frame, way):
    """A vector (3) in the frame of a matrix (9)."""
    return (
        frame[0] * way[0] + frame[3] * way[1] + frame[6] * way[2],
        frame[1] * way[0] + frame[4] * way[1] + frame[7] * way[2],
        frame[2] * way[0] + frame[5] * way[1] + frame[8] * way[2],
    )


@compiled
def key_of(table, model, geom):
    """Key of the field that a geom carries; 0 for none."""
    stride = word(model + word(table + NUSER_GEOM))
    if stride < USER:
        return np.int64(0)
    user = numbers(word(model + word(table + GEOM_USER)) + 8 * stride * geom, USER)
    if user[0] != MARK:
        return np.int64(0)
    key = (np.int64(user[1]) * PART + np.int64(user[2])) * PART
    return key + np.int64(user[3])


@compiled
def motion_of(table, model, data):
    """Address of the parameters of a simulation's motion; 0 for none."""
    count = word(model + word(table + NUSERDATA))
    place = word(data + word(table + USERDATA))
    user, start = numbers(place, count), 0
    while start + 2 < count:
        if user[start + 2] == MOTION:
            return place + 8 * (start + 2)
        start += 2 + int(user[start + 1])
    return np.int64(0)


@compiled
def sheathed(table, model, data, geom, place):
    """Whether a place (3) is in the box of a geom, that of the sheath's bore."""
    if geom < 0:
        return False
    centre = numbers(word(data + word(table + GEOM_XPOS)) + 24 * geom, 3)
    frame = numbers(word(data + word(table + GEOM_XMAT)) + 72 * geom, 9)
    size = numbers(word(model + word(table + GEOM_SIZE)) + 24 * geom, 3)
    apart = (place[0] - centre[0], place[1] - centre[1], place[2] - centre[2])
    x, y, z = into(frame, apart)
    return abs(x) < size[0] and abs(y) < size[1] and abs(z) < size[2]


@compiled
def collide(model, data, contacts, geom1, geom2, margin, before):
    """Contacts of a capsule or a sphere with a box, which may carry a field.

    `before` is the place in the table of the function for boxes that do not; a constant
    would be compiled once for each.
    """
    table = address_of(SYMBOL)
    key = key_of(table, model, geom2)
    if key == 0:
        old = word(table + before)
        return call_collision(old, model, data, contacts, geom1, geom2, margin)
    entry = entry_of(table, key)
    if entry == 0:
        call_error(word(table + ERROR), word(table + MESSAGE), geom2)
        return np.int32(0)
    size = numbers(word(model + word(table + GEOM_SIZE)) + 24 * geom1, 3)
    radius, half = size[0], size[1] if before == OF_CAPSULE else 0.0
    closed = ends(table, model, data, geom1, half)
    # The capsule in the frame of the field.
    places = word(data + word(table + GEOM_XPOS))
    turns = word(data + word(table + GEOM_XMAT))
    centre, origin = numbers(places + 24 * geom1, 3), numbers(places + 24 * geom2, 3)
    turned, frame = numbers(turns + 72 * geom1, 9), numbers(turns + 72 * geom2, 9)
    middle = numbers(word(entry + 16), 3)
    apart = (centre[0] - origin[0], centre[1] - origin[1], centre[2] - origin[2])
    apart = into(frame, apart)
    local = (middle[0] + apart[0], middle[1] + apart[1], middle[2] + apart[2])
    axis = into(frame, (turned[2], turned[5], turned[8]))
    # What is no number has no place in a lattice; MuJoCo's checks of the state tell.
    if not math.isfinite(local[0] + local[1] + local[2] + axis[0] + axis[1] + axis[2]):
        return np.int32(0)
    # A straight sheath holds the shaft without any load.
    near = 0.0 if margin > 0.0 or straight(entry) else _TOUCH
    limit = far = radius + margin + near
    impedance = numbers(word(model + word(table + GEOM_SOLIMP)) + 40 * geom1, 1)[0]
    soft = impedance == SOFT and half > 0.0 and word(entry + 8) == LUMEN
    travel, aside = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    motion, space = word(entry + MOTION_ENTRY), np.int64(0)
    if motion != 0:
        space = motion_of(table, model, data)
    if space != 0:
        time = numbers(data + word(table + TIME), 1)[0]
        lattice, course = numbers(motion, _COUNT), numbers(space, _COUNT)
        # The sheath lies where it does, whatever moves past it.
        if sheathed(table, model, data, int(course[10]), centre):
            if clearance(entry, local[0], local[1], local[2]) >= FREE:
                return np.int32(0)
        scratch = np.empty(WARP + 4 * VALUES)
        there, values = scratch[:WARP], scratch[WARP:].reshape(VALUES, 4)
        warp(lattice, course, time, local[0], local[1], local[2], values, there)
        at_rest = (there[0], there[1], there[2])
        x, y, z = (
            there[3] * axis[0] + there[4] * axis[1] + there[5] * axis[2],
            there[6] * axis[0] + there[7] * axis[1] + there[8] * axis[2],
            there[9] * axis[0] + there[10] * axis[1] + there[11] * axis[2],
        )
        stretch = math.sqrt(x * x + y * y + z * z)
        way = (x / stretch, y / stretch, z / stretch)
        reach = _STRAIN * (limit - there[12]) + _IMAGE
        seen = touches(entry, at_rest, way, half * stretch, closed, reach)
    else:
        if near > 0.0 and not soft:
            travel, turn = swept(table, model, data, geom1)
            travel, turn = into(frame, travel), into(frame, turn)
            aside = across(turn, axis)
            ahead = length(travel) + half * length(aside)
            far = max(limit, radius + ahead - _IMPACT)
        time, stretch, reach, way = 0.0, 1.0, limit, axis
        lattice = course = there = np.empty(0)
        values = np.empty((0, 4))
        seen = touches(entry, local, axis, half, closed, far)
    if seen[0] == 0:
        return np.int32(0)
    rows, written = np.empty((6, 4)), 0
    held = radius if impedance < _SLACK else 0.0
    for n in range(seen[0]):
        t, depth = (seen[3], seen[4]) if n else (seen[1], seen[2])
        # Two places so close are one. What is held at one is not at another by `near`.
        lowest = depth <= (seen[2] if n else seen[4])
        if not lowest and seen[3] - seen[1] < _EVERY and not soft:
            continue
        at_end = abs(t) >= half * stretch
        t /= stretch
        place = along(local, axis, t)
        if space != 0:
            warp(lattice, course, time, place[0], place[1], place[2], values, there)
            place = (there[0], there[1], there[2])
            depth = clearance(entry, place[0], place[1], place[2])
            if depth >= FREE:
                continue
        normal = away(entry, place[0], place[1], place[2])
        if normal == (0.0, 0.0, 0.0):
            continue
        if space != 0 or depth <= (limit if lowest else radius + margin):
            # A sphere may have one contact, so one plane.
            around = 0 if half == 0.0 else 1 + int(at_end)
            planes = tangents(
                entry, place, way, normal, depth, reach, held, around, rows
            )
        else:
            hits = along(travel, aside, t)
            ahead = normal[0] * hits[0] + normal[1] * hits[1] + normal[2] * hits[2]
            if depth + ahead > radius - _IMPACT:
                continue
            rows[0, 0], rows[0, 1], rows[0, 2] = normal
            rows[0, 3], planes = depth, 1
        if space != 0:
            in_space(there, rows, planes)
        if soft and planes == 1:
            for k in range(4):
                rows[1, k] = rows[0, k]
            planes = 2
        for plane in range(planes):
            if written == _MOST or (space != 0 and rows[plane, 3] > limit):
                continue
            contact = numbers(contacts + 80 * written, 10)
            distance = rows[plane, 3] - radius
            reached = radius + 0.5 * distance
            contact[0] = min(distance, _AT_WALL) if near > 0.0 else distance
            for k in range(3):
                towards = 0.0
                for i in range(3):
                    towards -= frame[3 * k + i] * rows[plane, i]
                contact[1 + k] = centre[k] + t * turned[3 * k + 2] + reached * towards
                contact[4 + k] = towards
                contact[7 + k] = 0.0
            written += 1
    return np.int32(written)


@callback("int32(int64, int64, int64, int32, int32, float64)")
def of_capsule(model, data, contacts, geom1, geom2, margin):
    """Entry of MuJoCo's collision table for a capsule and a box."""
    return collide(model, data, contacts, geom1, geom2, margin, np.int64(OF_CAPSULE))


@callback("int32(int64, int64, int64, int32, int32, float64)")
def of_sphere(model, data, contacts, geom1, geom2, margin):
    """Entry of MuJoCo's collision table for a sphere and a box."""
    return collide(model, data, contacts, geom1, geom2, margin, np.int64(OF_SPHERE))
