"""Contacts with a moving wall see its velocity; see `physics.motion`.

MuJoCo knows the velocity of a contact as J qvel. The model has one more degree of
freedom, the last, whose velocity is 1 m/s in every physics step; its column of J gets
the velocity of the wall in the frame of each contact.
"""

import numpy as np

from cathsim_dmc.anatomy.motion_loops import VALUES, WARP, wall_velocity, warp
from cathsim_dmc.collision import native
from cathsim_dmc.collision.native import (
    address_of,
    call_callback,
    numbers,
    wholes,
    word,
)
from cathsim_dmc.collision.table import (
    COUNT,
    MOTION_ENTRY,
    SYMBOL,
    entry_of,
    key_of,
    motion_of,
)

_SYMBOL = "cathsim_carrying"
# `native.contact_places`; offsets of nv, qvel and time; the function before;
# offset of the time step.
_TABLE = np.zeros(15, np.int64)
native.symbol(_SYMBOL, _TABLE)


@native.callback("void(int64, int64)")
def _carry(model, data):
    """Writes the velocity of the wall into the Jacobian of its contacts."""
    table, fields = address_of(_SYMBOL), address_of(SYMBOL)
    before = word(table + 104)
    if before != 0:
        call_callback(before, model, data)
    space = motion_of(fields, model, data)
    if space == 0:
        return
    nv = word(model + word(table + 80))
    numbers(word(data + word(table + 88)), nv)[nv - 1] = 1.0
    count = wholes(data + word(table), 1)[0]
    if count == 0:
        return
    jacobian = numbers(word(data + word(table + 16)), COUNT)
    # In the middle of the step, so that a device that sticks goes the wall's way.
    time = numbers(data + word(table + 96), 1)[0]
    time += 0.5 * numbers(model + word(table + 112), 1)[0]
    course = numbers(space, COUNT)
    wall = int(course[9])
    key = key_of(fields, model, wall)
    lattice = numbers(word(entry_of(fields, key) + MOTION_ENTRY), COUNT)
    scratch = np.empty(WARP + 4 * VALUES)
    there, values = scratch[:WARP], scratch[WARP:].reshape(VALUES, 4)
    for n in range(count):
        contact = word(data + word(table + 8)) + n * word(table + 24)
        first = wholes(contact + word(table + 64), 1)[0]
        if first < 0 or wholes(contact + word(table + 56), 1)[0] != wall:
            continue
        place = numbers(contact + word(table + 32), 3)
        frame = numbers(contact + word(table + 40), 9)
        warp(lattice, course, time, place[0], place[1], place[2], values, there)
        # The frame's first axis points from the device into the wall.
        u, v, w = wall_velocity(there, (-frame[0], -frame[1], -frame[2]))
        for row in range(min(wholes(contact + word(table + 48), 1)[0], 3)):
            speed = frame[3 * row] * u + frame[3 * row + 1] * v + frame[3 * row + 2] * w
            jacobian[(first + row) * nv + nv - 1] = speed


def install() -> None:
    """Has MuJoCo call it in every physics step of models with a motion.

    Raises:
        RuntimeError: if a Python function stands in `mjcb_passive`.
    """
    if _TABLE[0]:
        return
    _TABLE[10] = native.offsets("mjModel", ("nv",))[0]
    _TABLE[11:13] = native.offsets("mjData", ("qvel", "time"))
    _TABLE[14] = native.offsets("mjModel", ("opt.timestep",))[0]
    _TABLE[:10] = native.contact_places()
    _TABLE[13] = native.follow(_carry)
