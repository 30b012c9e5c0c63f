"""Adapters of the laws to MuJoCo: they read its structs, call a law, and write them.

An adapter gets the addresses of `mjModel`, of `mjData` and of the layout of the
simulation (`collision.own`), and the offset of its parameters in `userdata`. Compiled
adapters of the package are kept on disk; `made` compiles the adapter of a user's law.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from cathsim_dmc.collision import native
from cathsim_dmc.collision.law_checks import WRITTEN, finite, nothing
from cathsim_dmc.collision.native import (
    address_of,
    contact_at,
    contact_field,
    data_field,
    model_field,
    numbers,
    word,
)
from cathsim_dmc.collision.own import (
    CLOCK,
    FAULT,
    JOINTS,
    LINK,
    LINKS,
    PLACES,
    WALL,
    sharing_of,
)
from cathsim_dmc.collision.parameters import unpacked
from cathsim_dmc.collision.table import MOTION_ENTRY, SYMBOL, entry_of, key_of
from cathsim_dmc.compiled import compiled
from cathsim_dmc.entities.robot import pose
from cathsim_dmc.laws import sliding
from cathsim_dmc.laws.blood import Blood, drag
from cathsim_dmc.laws.compliance import Material, share, write_contacts
from cathsim_dmc.laws.contact import COMPLIANT
from cathsim_dmc.laws.device import Contact, Device, Links
from cathsim_dmc.laws.drive import follow
from cathsim_dmc.laws.hinges import Bends, steered
from cathsim_dmc.laws.motion import (
    VALUES,
    WARP,
    MotionParameters,
    course_at,
    wall_velocity,
    warp,
)
from cathsim_dmc.laws.sheath import Hinges, hold
from cathsim_dmc.laws.springs import Scratch, Springs, shape_torques
from cathsim_dmc.physics import chain_fields
from cathsim_dmc.physics.chain_fields import Fields

_adapter = native.callback("void(int64, int64, int64, int64)")


@compiled
def _parameters(kind, data, layout, start):
    """Parameters of a simulation, from an offset in `userdata` on."""
    last = data_field(data, "userdata")[start:]
    return unpacked(kind, last, word(layout + LINKS), word(layout + JOINTS))


@compiled
def links_of(model, data, layout):
    """`Links` of a simulation's device."""
    first = word(layout + LINK)
    last = first + word(layout + LINKS)
    return Links(
        data_field(data, "xipos")[first:last],
        data_field(data, "ximat")[first:last],
        data_field(data, "xmat")[first:last],
        data_field(data, "cvel")[first:last],
        data_field(data, "subtree_com")[first:last],
        data_field(data, "xfrc_applied")[first:last],
    )


@compiled
def device_of(model, data, layout):
    """`Device` of a simulation."""
    first, links = word(layout + LINK), word(layout + LINKS)
    hinges, last = 2 * word(layout + JOINTS), first + links
    places, nv = native.longs(word(layout + PLACES)), model_field(model, "nv")
    return Device(
        data_field(data, "xipos")[first:last],
        data_field(data, "xmat")[first:last],
        data_field(data, "cvel")[first:last],
        data_field(data, "subtree_com")[first:last],
        model_field(model, "geom_size")[: model_field(model, "ngeom")],
        places[:links],
        model_field(model, "body_dofadr")[first:last],
        model_field(model, "body_dofnum")[first:last],
        data_field(data, "cdof")[:nv],
        data_field(data, "qpos")[: model_field(model, "nq")],
        data_field(data, "qfrc_passive")[:nv],
        model_field(model, "jnt_stiffness")[: model_field(model, "njnt")],
        model_field(model, "qpos_spring")[: model_field(model, "nq")],
        places[links : links + hinges],
        places[links + hinges : links + 2 * hinges],
        places[links + 2 * hinges : links + 3 * hinges],
    )


@compiled
def _contact(contact):
    """`Contact` of the MuJoCo contact at an address."""
    return Contact(
        contact_field(contact, "pos"),
        contact_field(contact, "frame"),
        contact_field(contact, "solimp"),
        contact_field(contact, "solref"),
    )


@_adapter
def blood(model, data, layout, start):
    """Drag of blood, see `laws.blood`."""
    device = device_of(model, data, layout)
    given = _parameters(Blood, data, layout, start)
    drag(given, data_field(data, "time"), device)


@_adapter
def springs(model, data, layout, start):
    """Springs of a device with a shape, see `laws.springs`."""
    joints = word(layout + JOINTS)
    bends = Bends(np.empty(joints, np.complex128), np.empty(joints))
    scratch = Scratch(np.empty(2 * joints), bends, np.empty((joints, 2)))
    given = _parameters(Springs, data, layout, start)
    shape_torques(given, device_of(model, data, layout), scratch)


@_adapter
def compliance(model, data, layout, start):
    """Halves the springs of contacts that share one, see `laws.compliance`."""
    last, number, wall = np.int32(-1), 0, word(layout + WALL)
    for n in range(data_field(data, "ncon")):
        contact = contact_at(data, n)
        if contact_field(contact, "geom2")[0] != wall:
            continue
        # Contacts of a link with the wall follow each other.
        link = contact_field(contact, "geom1")[0]
        last, number = link, number + 1 if link == last else 0
        if contact_field(contact, "solimp")[0] != COMPLIANT:
            continue
        first = sharing_of(model, data, link)
        if first >= 0 and data_field(data, "userdata")[first + number] != 0.0:
            share(_contact(contact))


@_adapter
def motion(model, data, layout, start):
    """Writes the wall's velocity into the Jacobian of its contacts.

    MuJoCo computes the velocity of a contact as J qvel. One degree of freedom, that of
    `motion.add_clock`, has a velocity of 1 m/s in every physics step; its column of J
    gets the velocity of the wall in the frame of each contact.
    """
    nv, wall = model_field(model, "nv"), word(layout + WALL)
    clock = word(layout + CLOCK)
    data_field(data, "qvel")[clock] = 1.0
    count, jacobian = data_field(data, "ncon"), data_field(data, "efc_J")
    if count == 0:
        return
    # In the middle of the step, so that a sticking device follows the wall.
    time = data_field(data, "time") + 0.5 * model_field(model, "opt.timestep")
    course = course_at(_parameters(MotionParameters, data, layout, start), time)
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
        warp(lattice, course, (place[0], place[1], place[2]), values, there)
        # The frame's first axis points from the device into the wall.
        u, v, w = wall_velocity(there, (-frame[0], -frame[1], -frame[2]))
        for row in range(min(contact_field(contact, "dim")[0], 3)):
            speed = frame[3 * row] * u + frame[3 * row + 1] * v + frame[3 * row + 2] * w
            jacobian[(first + row) * nv + clock] = speed


@compiled
def hold_links(sheathed, first, stop):
    """Holds the links in the sheaths of some of N simulations, see `laws.sheath.hold`.

    Args:
        sheathed: `held.Sheathed`.
        first: Index of the first simulation.
        stop: Index after that of the last one.
    """
    for i in range(first, stop):
        free, (stiffness, damping, rest) = sheathed.free[i], sheathed.places[i]
        if stiffness != 0:
            own = Hinges(free[0], free[1], free[2])
            model = Hinges(numbers(stiffness), numbers(damping), numbers(rest))
            depths, insertion = sheathed.depths[i], sheathed.insertion[i]
            hold(sheathed.joints, depths, insertion, own, model, sheathed.out[i])


@compiled
def act(drives, sheathed, steering, robot, load, control):
    """Moves N single devices: drives, the sheath, the motors of the tip, the robot.

    Args:
        drives: `drives.Bound`.
        sheathed: `held.Sheathed`; None where a bore holds the links.
        steering: `single_device.Steering`; None without motors.
        robot: Indices of insertion and rotation, and of the joints of the robot, see
            `entities.robot.pose`.
        load: (N, D), see `laws.drive.follow`.
        control: (N, A), action of the motors, then of the drives; overwritten with the
            control.
    """
    base, joints = robot
    pose(drives.state.qpos, base, joints)
    way = np.empty_like(load)
    count, motors = len(control), control.shape[1] - load.shape[1]
    follow(drives.servos, drives.state, control[:, motors:], load, drives.told, way)
    if sheathed is not None:
        hold_links(sheathed, 0, count)
    if steering is not None:
        angles = np.empty((count, len(steering.places)))
        for i in range(count):
            for k in range(len(steering.places)):
                angles[i, k] = drives.state.qpos[i, steering.places[k]]
        commands = control[:, :motors]
        steered(commands, angles, steering.bends, commands)


@compiled
def _rows(address, count, width):
    """An array (count, width) of float64 at an address."""
    return numbers(address)[: count * width].reshape((count, width))


@compiled
def press(places, radius, material, links, laws):
    """Writes contact parameters of N simulations, see `compliance.write_contacts`.

    Args:
        places: (N, 2) int64, addresses of `geom_solref` and `geom_solimp`; 0 before the
            first episode.
        radius: (N, L), radius of the lumen around each link, m; 0 for none.
        material: (N, 3), the numbers of `laws.compliance.Material`.
        links: `laws.compliance.Links`.
        laws: `laws.compliance.Law` of the rigid wall, and of the compliant one.
    """
    count = links.geoms.max() + 1
    for i in range(len(places)):
        if places[i, 0] != 0:
            own = Material(material[i, 0], material[i, 1], material[i, 2])
            solref = _rows(places[i, 0], count, 2)
            solimp = _rows(places[i, 1], count, 5)
            write_contacts(radius[i], own, links, laws, solref, solimp)


@compiled
def _fields(places, sizes):
    """The `chain_fields.Fields` at addresses (11,)."""
    joints, dofs, positions, geoms, bodies = sizes
    return Fields(
        numbers(places[0])[:joints],
        numbers(places[1])[:dofs],
        numbers(places[2])[:positions],
        _rows(places[3], geoms, 3),
        numbers(places[4])[:geoms],
        _rows(places[5], geoms, 6),
        _rows(places[6], geoms, 3),
        numbers(places[7])[:bodies],
        _rows(places[8], bodies, 3),
        numbers(places[9])[:bodies],
        numbers(places[10])[:bodies],
    )


@compiled
def _in_sheath(sheathed, fields, i):
    """Copies the hinges of a simulation as free ones, and holds those in the sheath.

    numba removes a branch on None only if it tests an argument.
    """
    if sheathed is not None:
        joints, free = sheathed.joints, sheathed.free[i]
        for j in range(free.shape[1]):
            for axis in range(2):
                free[0, j, axis] = fields.jnt_stiffness[joints.joint[j, axis]]
                free[1, j, axis] = fields.dof_damping[joints.dof[j, axis]]
                free[2, j, axis] = fields.qpos_spring[joints.qpos[j, axis]]
        hold_links(sheathed, i, i + 1)


@compiled
def settle(live, loads, state, rows, lays):
    """Settles coaxial devices, writes their chains, and holds the links in the sheath.

    Args:
        live: `chain_fields.Live`.
        loads: `laws.sliding.Loads` of N simulations, arrays with the leading axis N.
        state: `laws.sliding.State` of them, likewise, but `slipped` (N, 2 K) holds the
            slips of both clamps of each device, m and rad.
        rows: Index of the first simulation, and the index after that of the last.
        lays: Whether an episode begins, see `laws.sliding.lay`.
    """
    devices, scratch, chain = live.devices, live.scratch, live.chain
    for i in range(rows[0], rows[1]):
        if live.fields[i, 0] == 0:
            continue
        own = sliding.State(
            state.gaps[i], state.hinges[i], state.angles[i], state.ways[i],
            state.drag[i], state.slipped[i, 1::2], state.axial[i],
        )  # fmt: skip
        stiffness, loss = loads.stiffness[i], loads.loss[i]
        if lays:
            sliding.lay(devices, own, loads.friction[i], scratch, chain)
        else:
            turned, force = loads.turned[i], loads.force[i]
            each = sliding.Loads(
                turned, force, loads.axial[i], loads.friction[i], stiffness, loss
            )
            sliding.settle(devices, each, own, scratch, chain)
        fields = _fields(live.fields[i], live.sizes)
        chain_fields.write(fields, live.places, chain, stiffness, loss)
        _in_sheath(live.sheathed, fields, i)


@functools.cache
def made(law: Callable, kind: Any, acts_in: str) -> Any:
    """Adapter of a user's law, with checked indices.

    Args:
        law: See `effects.Effect.law`.
        kind: Class of its parameters.
        acts_in: "passive", "control" or "contact".
    """
    # It is not kept on disk, because the law may differ between processes.
    apply = compiled(law, cache=False, checked=True)
    state_of = links_of if acts_in == "control" else device_of
    written = compiled(WRITTEN[acts_in], cache=False)

    def guarded(given, time, state, layout, start):
        sound = finite(written(state))
        try:
            nothing(apply(given, time, state))
        except Exception:  # noqa: BLE001  C has no exceptions
            native.longs(layout + FAULT)[0] = start + 1
        if sound and not finite(written(state)):
            native.longs(layout + FAULT)[0] = -1 - start

    guarded = compiled(guarded, cache=False)

    def once(model, data, layout, start):
        given, time = _parameters(kind, data, layout, start), data_field(data, "time")
        guarded(given, time, state_of(model, data, layout), layout, start)

    def in_contact(model, data, layout, start):
        given, time = _parameters(kind, data, layout, start), data_field(data, "time")
        wall = word(layout + WALL)
        for n in range(data_field(data, "ncon")):
            contact = contact_at(data, n)
            if contact_field(contact, "geom2")[0] == wall:
                guarded(given, time, _contact(contact), layout, start)

    callback = native.callback("void(int64, int64, int64, int64)", cache=False)
    return callback(in_contact if acts_in == "contact" else once)
