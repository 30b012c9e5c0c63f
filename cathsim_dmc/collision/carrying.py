"""Contacts with walls that give or move, before MuJoCo works out their references.

Two contacts that share the spring of a wall that gives (`loops.SOFT`) get half each.

MuJoCo knows the velocity of a contact as J qvel. The model has one more degree of
freedom, the last, whose velocity is 1 m/s in every physics step; its column of J gets
the velocity of the wall in the frame of each contact.
"""

import functools

import numpy as np

from cathsim_dmc.anatomy.motion_loops import VALUES, WARP, courses, wall_velocity, warp
from cathsim_dmc.collision import callbacks, native
from cathsim_dmc.collision.loops import SOFT
from cathsim_dmc.collision.native import (
    address_of,
    call_before,
    contact_at,
    contact_field,
    data_field,
    model_field,
    numbers,
    word,
)
from cathsim_dmc.collision.own import owned
from cathsim_dmc.collision.table import (
    MOTION_ENTRY,
    SYMBOL,
    entry_of,
    key_of,
    motion_of,
)
from cathsim_dmc.compiled import compiled

_SYMBOL = "cathsim_carrying"
_before = native.symbol(_SYMBOL, 1)


@compiled
def _share(data):
    """Halves stiffness and damping of contacts that share a spring."""
    for n in range(data_field(data, "ncon")):
        contact = contact_at(data, n)
        soft = contact_field(contact, "solimp")[0] == SOFT
        if soft and native.wholes(contact)[0] & 1:
            law = contact_field(contact, "solref")
            law[0], law[1] = 0.5 * law[0], 0.5 * law[1]


@native.callback("void(int64, int64)")
def _carry(model, data):
    """Shares springs, and writes the wall's velocity into contacts' Jacobian."""
    call_before(address_of(_SYMBOL), model, data)
    if not owned(model, data):
        return
    _share(data)
    space, nv = motion_of(model, data), model_field(model, "nv")
    if space == 0:
        return
    data_field(data, "qvel")[nv - 1] = 1.0
    count, jacobian = data_field(data, "ncon"), data_field(data, "efc_J")
    if count == 0:
        return
    # In the middle of the step, so that a device that sticks goes the wall's way.
    time = data_field(data, "time") + 0.5 * model_field(model, "opt.timestep")
    parameters = data_field(data, "userdata")[space:]
    wall, course = int(parameters[9]), courses(parameters, time)
    entry = entry_of(address_of(SYMBOL), key_of(model, wall))
    lattice = numbers(word(entry + MOTION_ENTRY))
    scratch = np.empty(WARP + 4 * VALUES)
    there, values = scratch[:WARP], scratch[WARP:].reshape(VALUES, 4)
    for n in range(count):
        contact = contact_at(data, n)
        first = contact_field(contact, "efc_address")[0]
        if first < 0 or contact_field(contact, "geom2")[0] != wall:
            continue
        place, frame = contact_field(contact, "pos"), contact_field(contact, "frame")
        warp(lattice, course, place[0], place[1], place[2], values, there)
        # The frame's first axis points from the device into the wall.
        u, v, w = wall_velocity(there, (-frame[0], -frame[1], -frame[2]))
        for row in range(min(contact_field(contact, "dim")[0], 3)):
            speed = frame[3 * row] * u + frame[3 * row + 1] * v + frame[3 * row + 2] * w
            jacobian[(first + row) * nv + nv - 1] = speed


@functools.cache
def install() -> None:
    """Has MuJoCo call it in every physics step; RuntimeError as `follow`."""
    callbacks.follow("mjcb_passive", _carry, _before)
