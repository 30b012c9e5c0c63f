"""The collider where walls move, compiled: it stands in for that of `loops`."""

from __future__ import annotations

import math

import numpy as np

from cathsim_dmc.anatomy.field_loops import FREE
from cathsim_dmc.anatomy.motion_loops import VALUES, WARP, courses, in_space, warp
from cathsim_dmc.collision.loops import (
    IMPACT,
    collide,
    finite,
    given,
    nth,
    put,
    sweep,
    tangents,
)
from cathsim_dmc.collision.native import (
    address_of,
    callback,
    data_field,
    model_field,
    numbers,
    word,
)
from cathsim_dmc.collision.own import BORE, MOTION, motion_of
from cathsim_dmc.collision.places import along, away, clearance, touches
from cathsim_dmc.collision.table import (
    MOTION_ENTRY,
    OF_CAPSULE,
    OF_SPHERE,
    SYMBOL,
    entry_of,
    key_of,
    sheathed,
)
from cathsim_dmc.compiled import compiled

# A capsule is looked for by its straight image at rest, which is off by so much, m, and
# by the strain of space; its contacts are looked up exactly.
_IMAGE = 0.2e-3


@compiled
def in_motion(model, data, contacts, geoms, entry, pose, half, closed, margin, law):
    """Number of contacts, written, with a field that moves."""
    radius, near, soft, held, light = law
    local, axis = pose
    limit = radius + margin + near
    time, lattice = data_field(data, "time"), numbers(word(entry + MOTION_ENTRY))
    layout = motion_of(model, data)
    # `courses` has its first parameter at 1.
    parameters = data_field(data, "userdata")[word(layout + MOTION) - 1 :]
    # The sheath lies where it does, whatever moves past it.
    centre = data_field(data, "geom_xpos")[geoms[0]]
    if sheathed(model, data, word(layout + BORE), centre):
        if clearance(entry, local[0], local[1], local[2]) >= FREE:
            return 0
    scratch = np.empty(WARP + 4 * VALUES)
    there, values = scratch[:WARP], scratch[WARP:].reshape(VALUES, 4)
    course = courses(parameters, time)
    warp(lattice, course, local[0], local[1], local[2], values, there)
    strain = 0.0
    for k in range(3, 12):
        strain += (there[k] - (1.0 if k % 4 == 3 else 0.0)) ** 2
    x = there[3] * axis[0] + there[4] * axis[1] + there[5] * axis[2]
    y = there[6] * axis[0] + there[7] * axis[1] + there[8] * axis[2]
    z = there[9] * axis[0] + there[10] * axis[1] + there[11] * axis[2]
    stretch = math.sqrt(x * x + y * y + z * z)
    way, image = (x / stretch, y / stretch, z / stretch), (there[0], there[1], there[2])
    travel, aside, far = sweep(model, data, geoms, axis, half, law)
    reach = (1.0 + math.sqrt(strain)) * (max(limit, far) - there[12]) + _IMAGE
    seen = touches(entry, image, way, half * stretch, closed, reach)
    if seen[0] == 0:
        return 0
    rows, written = np.empty((6, 4)), 0
    for n in range(seen[0]):
        t, depth, lowest, most = nth(seen, n, soft)
        if not most:
            continue
        turns = 0 if half == 0.0 else 1 + int(lowest and abs(t) >= half * stretch)
        t /= stretch
        x, y, z = along(local, axis, t)
        warp(lattice, course, x, y, z, values, there)
        place = (there[0], there[1], there[2])
        depth = clearance(entry, place[0], place[1], place[2])
        if depth >= FREE:
            continue
        normal = away(entry, place[0], place[1], place[2])
        if normal == (0.0, 0.0, 0.0):
            continue
        rows[0, 0], rows[0, 1], rows[0, 2] = normal
        rows[0, 3], planes = depth, 1
        in_space(there, rows, planes)
        bound = limit if lowest else radius + margin
        if rows[0, 3] <= bound:
            # A lumen that has grown is held where it is, not where it was at rest.
            grown = max(held - there[12], 1e-9) if held > 0.0 else 0.0
            seen_at = place, way, normal, depth, reach
            planes = tangents(entry, *seen_at, grown, light, turns, rows)
            in_space(there, rows, planes)
        else:
            bound, hits = np.inf, along(travel, aside, t)
            ahead = rows[0, 0] * hits[0] + rows[0, 1] * hits[1] + rows[0, 2] * hits[2]
            if rows[0, 3] + ahead > radius - IMPACT:
                continue
        written = put(data, contacts, geoms, written, most, rows, planes, t, bound, law)
    return written


@compiled
def collide_moving(model, data, contacts, geom1, geom2, margin, before):
    """As `loops.collide`, of fields that move in this simulation, too."""
    key = key_of(model, geom2)
    entry = entry_of(address_of(SYMBOL), key) if key != 0 else 0
    if entry == 0 or word(entry + MOTION_ENTRY) == 0 or motion_of(model, data) == 0:
        return collide(model, data, contacts, geom1, geom2, margin, before)
    half = model_field(model, "geom_size")[geom1, 1] if before == OF_CAPSULE else 0.0
    taken = given(model, data, contacts, geom1, geom2, half, margin, entry)
    return np.int32(in_motion(*taken) if finite(taken[5]) else 0)


@callback("int32(int64, int64, int64, int32, int32, float64)")
def of_capsule(model, data, contacts, geom1, geom2, margin):
    """Entry of MuJoCo's collision table for a capsule and a box."""
    place = np.int64(OF_CAPSULE)
    return collide_moving(model, data, contacts, geom1, geom2, margin, place)


@callback("int32(int64, int64, int64, int32, int32, float64)")
def of_sphere(model, data, contacts, geom1, geom2, margin):
    """Entry of MuJoCo's collision table for a sphere and a box."""
    place = np.int64(OF_SPHERE)
    return collide_moving(model, data, contacts, geom1, geom2, margin, place)
