"""Contacts with walls that give or move, before MuJoCo works out their references.

Two contacts that share the spring of a wall that gives (`loops.SOFT`) get half each.

MuJoCo knows the velocity of a contact as J qvel. The model has one more degree of
freedom, the last, whose velocity is 1 m/s in every physics step; its column of J gets
the velocity of the wall in the frame of each contact.
"""

import numpy as np

from cathsim_dmc.anatomy.motion_loops import VALUES, WARP, courses, wall_velocity, warp
from cathsim_dmc.collision import native
from cathsim_dmc.collision.loops import SOFT
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
from cathsim_dmc.compiled import compiled

_SYMBOL = "cathsim_carrying"
# `native.contact_places`; offsets of nv, qvel and time; the function before;
# offset of the time step.
_TABLE = np.zeros(16, np.int64)
native.symbol(_SYMBOL, _TABLE)


@compiled
def _share(table, data):
    """Halves stiffness and damping of contacts that share a spring."""
    for n in range(wholes(data + word(table), 1)[0]):
        contact = word(data + word(table + 8)) + n * word(table + 24)
        soft = numbers(contact + word(table + 72), 1)[0] == SOFT
        if soft and wholes(contact, 1)[0] & 1:
            law = numbers(contact + word(table + 80), 2)
            law[0], law[1] = 0.5 * law[0], 0.5 * law[1]


@native.callback("void(int64, int64)")
def _carry(model, data):
    """Shares springs, and writes the wall's velocity into contacts' Jacobian."""
    table, fields = address_of(_SYMBOL), address_of(SYMBOL)
    before = word(table + 112)
    if before != 0:
        call_callback(before, model, data)
    _share(table, data)
    space = motion_of(fields, model, data)
    if space == 0:
        return
    nv = word(model + word(table + 88))
    numbers(word(data + word(table + 96)), nv)[nv - 1] = 1.0
    count = wholes(data + word(table), 1)[0]
    if count == 0:
        return
    jacobian = numbers(word(data + word(table + 16)), COUNT)
    # In the middle of the step, so that a device that sticks goes the wall's way.
    time = numbers(data + word(table + 104), 1)[0]
    time += 0.5 * numbers(model + word(table + 120), 1)[0]
    parameters = numbers(space, COUNT)
    wall, course = int(parameters[9]), courses(parameters, time)
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
        warp(lattice, course, place[0], place[1], place[2], values, there)
        # The frame's first axis points from the device into the wall.
        u, v, w = wall_velocity(there, (-frame[0], -frame[1], -frame[2]))
        for row in range(min(wholes(contact + word(table + 48), 1)[0], 3)):
            speed = frame[3 * row] * u + frame[3 * row + 1] * v + frame[3 * row + 2] * w
            jacobian[(first + row) * nv + nv - 1] = speed


def install() -> None:
    """Has MuJoCo call it in every physics step; RuntimeError as `native.follow`."""
    if _TABLE[0]:
        return
    _TABLE[[11, 15]] = native.offsets("mjModel", ("nv", "opt.timestep"))
    _TABLE[12:14] = native.offsets("mjData", ("qvel", "time"))
    _TABLE[:11] = native.contact_places()
    _TABLE[14] = native.follow(_carry)
