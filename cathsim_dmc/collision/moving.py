"""Links against walls that move, in MuJoCo's collision table."""

import numpy as np

from cathsim_dmc.collision.links import (
    capsule_of,
    is_finite,
    is_in_box,
    law_of,
    sweep,
)
from cathsim_dmc.collision.loops import collide, write
from cathsim_dmc.collision.native import (
    address_of,
    callback,
    data_field,
    numbers,
    stacked,
    word,
)
from cathsim_dmc.collision.own import BORE, MOTION, motion_of
from cathsim_dmc.collision.parameters import unpacked
from cathsim_dmc.collision.table import (
    MOTION_ENTRY,
    SYMBOL,
    entry_of,
    key_of,
    wall_of,
)
from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.capsule import SAMPLES
from cathsim_dmc.laws.contact import CONTACT
from cathsim_dmc.laws.field import FREE
from cathsim_dmc.laws.motion import VALUES, WARP, MotionParameters, course_at
from cathsim_dmc.laws.moving_contact import MovingScratch, moving_contacts
from cathsim_dmc.laws.planes import MOST, PLANES
from cathsim_dmc.laws.wall import clearance_along


@compiled
def in_motion(model, data, raw, geoms, margin, entry):
    """Writes the contacts of a link with a wall that moves; returns their number."""
    wall = wall_of(entry)
    capsule = capsule_of(model, data, entry, geoms)
    if not is_finite(capsule):
        return np.int32(0)
    layout = motion_of(model, data)
    # The sheath does not move: a link in it that is past the open end is free.
    centre = data_field(data, "geom_xpos")[geoms[0]]
    if is_in_box(model, data, word(layout + BORE), centre):
        if clearance_along(wall, capsule, 0.0) >= FREE:
            return np.int32(0)
    row = data_field(data, "userdata")[word(layout + MOTION) :]
    parameters = unpacked(MotionParameters, row, 0, 0)
    course = course_at(parameters, data_field(data, "time"))
    motion = numbers(word(entry + MOTION_ENTRY)), course
    law = law_of(model, wall, geoms[0], margin)
    step = sweep(model, data, geoms, capsule, law)
    samples, planes = stacked(1, SAMPLES)[0], stacked(PLANES, 4)
    scratch = MovingScratch(samples, planes, stacked(VALUES, 4), stacked(1, WARP)[0])
    found = stacked(MOST, CONTACT)
    count = moving_contacts(wall, capsule, law, step, motion, scratch, found)
    return write(model, data, geoms, law, found, count, raw)


@compiled
def collide_moving(model, data, raw, geoms, margin):
    """As `loops.collide`, also for fields that move in this simulation."""
    key = key_of(model, geoms[1])
    entry = entry_of(address_of(SYMBOL), key) if key != 0 else 0
    if entry == 0 or word(entry + MOTION_ENTRY) == 0 or motion_of(model, data) == 0:
        return collide(model, data, raw, geoms, margin)
    return in_motion(model, data, raw, geoms, margin, entry)


@callback("int32(int64, int64, int64, int32, int32, float64)")
def of_link(model, data, contacts, geom1, geom2, margin):
    """Entry of MuJoCo's collision table for a capsule or a sphere and a box."""
    return collide_moving(model, data, contacts, (geom1, geom2), margin)
