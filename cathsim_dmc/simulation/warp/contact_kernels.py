"""Contacts of links with walls, as functions of one thread of a GPU.

The law is `laws.contact`, as in `collision.loops`. A thread takes one link and one
carrier of one world, or writes the contacts of one world.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.capsule import SAMPLES
from cathsim_dmc.laws.compliance import share
from cathsim_dmc.laws.contact import (
    COMPLIANT,
    CONTACT,
    contact_law,
    contacts,
    end_caps,
    looks_ahead,
    sweep_of,
    swept,
    world_contact,
)
from cathsim_dmc.laws.contact import Scratch as Memory
from cathsim_dmc.laws.device import Contact
from cathsim_dmc.laws.field import FieldArrays
from cathsim_dmc.laws.places import Capsule
from cathsim_dmc.laws.planes import MOST, PLANES
from cathsim_dmc.laws.vectors import into
from cathsim_dmc.laws.wall import Wall
from cathsim_dmc.simulation.warp.contact_arrays import (
    Contacts,
    Fields,
    Found,
    Links,
    Motion,
    Walls,
)
from cathsim_dmc.simulation.warp.devices import Scratch

SCRATCH: Scratch = ((SAMPLES,), (PLANES, 4), (MOST, CONTACT))
_ROUNDED = 1e-6  # of a number in single precision
_LEAST_FRICTION = 1e-5  # MuJoCo's mjMINMU
_OVERFLOW = 1 << 3  # mujoco_warp's OverflowType.NARROWPHASE


@compiled
def _wall(walls, number):
    """The wall of a number, as `laws.wall.Wall`."""
    # A device function of numba-cuda can return arrays only inside a tuple.
    first, last = walls.starts[number, :, 0], walls.starts[number, :, 1]
    field = FieldArrays(
        walls.head[first[0] : last[0]],
        walls.coarse[first[1] : last[1]],
        walls.bricks[first[2] : last[2]],
        walls.samples[first[3] : last[3]],
    )
    line = walls.line[first[4] : last[4]]
    return Wall(walls.is_bore[number], field, line)


@compiled
def matrix(turns, world, geom):
    """The nine numbers of a matrix, row by row, float64."""
    m = turns[world, geom]
    return (
        float(m[0, 0]), float(m[0, 1]), float(m[0, 2]),
        float(m[1, 0]), float(m[1, 1]), float(m[1, 2]),
        float(m[2, 0]), float(m[2, 1]), float(m[2, 2]),
    )  # fmt: skip


@compiled
def vector(places, world, number):
    """A place (3), float64."""
    place = places[world, number]
    return float(place[0]), float(place[1]), float(place[2])


@compiled
def _swept(links, motion, world, link, step):
    """Motion of a link in a physics step; see `laws.contact.swept`."""
    return swept(
        links.parents,
        motion.cdof[world],
        motion.qvel[world],
        links.last_dof[link],
        motion.geom_xpos[world, links.geoms[link]],
        motion.subtree_com[world, links.roots[link]],
        step,
    )


class Pair(NamedTuple):
    """A link and a wall in one world.

    Attributes:
        world: Number of the world.
        number: Number of the wall in `Walls`.
        wall: `laws.wall.Wall`.
        capsule: The link in the frame of the wall.
        law: `laws.contact.Law`.
        sweep: `laws.contact.Sweep`.
        centre: (3) m, centre of the link, world frame.
        axis: (3) unit vector of the link, world frame.
        frame: (9) matrix whose columns are the axes of the wall's frame.
    """

    world: Any
    number: Any
    wall: Any
    capsule: Any
    law: Any
    sweep: Any
    centre: Any
    axis: Any
    frame: Any


@compiled
def _whose(thread, links, worlds):
    """Link, world and carrier of a thread, (carrier · N + world) · L + link."""
    count = len(links.geoms)
    return thread % count, thread // count % worlds, thread // (count * worlds)


@compiled
def pair_of(thread, scene):
    """`Pair` of a thread of a `Scene`."""
    links, walls, fields, motion = scene.links, scene.walls, scene.fields, scene.motion
    link, world, which = _whose(thread, links, len(walls.of_world))
    geom, number = links.geoms[link], walls.of_world[world, which]
    wall, middle = _wall(walls, number), walls.middle[number]
    frame = matrix(walls.turns, world, which)
    turned = matrix(motion.geom_xmat, world, geom)
    centre = vector(motion.geom_xpos, world, geom)
    origin = vector(walls.places, world, which)
    axis = (turned[2], turned[5], turned[8])
    apart = (centre[0] - origin[0], centre[1] - origin[1], centre[2] - origin[2])
    seen = into(frame, apart)
    local = (middle[0] + seen[0], middle[1] + seen[1], middle[2] + seen[2])
    size = fields.geom_size[world % len(fields.geom_size), geom]
    radius, half_length = float(size[0]), float(size[1])
    caps = (True, True)
    if links.joints[link] >= 0:
        joint = vector(motion.xpos, world, links.joints[link])
        caps = end_caps(centre, axis, half_length, joint)
    capsule = Capsule(local, into(frame, axis), half_length, caps)
    impedance = float(fields.geom_solimp[world % len(fields.geom_solimp), geom, 0])
    if abs(impedance - COMPLIANT) < _ROUNDED:
        impedance = COMPLIANT
    reference = float(fields.geom_solref[world % len(fields.geom_solref), geom, 0])
    law = contact_law(wall, radius, 0.0, impedance, reference)
    travel, turn = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if looks_ahead(law):
        step = float(fields.timestep[world % len(fields.timestep)])
        travel, turn = _swept(links, motion, world, link, step)
        travel, turn = into(frame, travel), into(frame, turn)
    sweep = sweep_of(capsule, law, travel, turn)
    return Pair(world, number, wall, capsule, law, sweep, centre, axis, frame)


class Scene(NamedTuple):
    """Inputs of `find`, and the array that it writes, `found`."""

    links: Links
    walls: Walls
    fields: Fields
    motion: Motion
    found: Found


class Written(NamedTuple):
    """Inputs of `count` and `place`, and the arrays that they write.

    Attributes:
        links: See `Links`.
        fields: See `Fields`.
        found: See `Found`.
        out: Warp's contacts, world by world, without a gap between two worlds.
        counts: (N,) number of contacts of a world.
        starts: (N,) index of the first contact of a world.
        overflow: (N,) Warp's bits of what a world has too much of.
    """

    links: Links
    fields: Fields
    found: Found
    out: Contacts
    counts: Any
    starts: Any
    overflow: Any


@compiled
def find(thread, scratch, scene):
    """Finds the contacts of a link with a wall of a `Scene`; threads as of `_whose`."""
    scene.found.number[thread] = 0
    pair = pair_of(thread, scene)
    if not is_finite(pair):
        return
    samples, planes, out = scratch
    memory = Memory(samples, planes)
    count = contacts(pair.wall, pair.capsule, pair.law, pair.sweep, memory, out)
    keep(scene.found, thread, pair, out, count)


@compiled
def is_finite(pair):
    """Whether position and axis of a link are finite."""
    centre = pair.capsule.centre
    return math.isfinite(centre[0] + centre[1] + centre[2] + pair.axis[0])


@compiled
def keep(found, thread, pair, given, count):
    """Writes the contacts (count, CONTACT) of a thread in the frame of the world."""
    for n in range(count):
        distance, place, towards = world_contact(
            given[n], pair.law, pair.centre, pair.axis, pair.frame
        )
        row = found.rows[thread, n]
        row[0], row[7] = distance, given[n, 5]
        for k in range(3):
            row[1 + k], row[4 + k] = place[k], towards[k]
    found.number[thread] = count


@compiled
def _tangent(normal):
    """A unit vector (3) orthogonal to a unit vector, as MuJoCo's `mju_makeFrame`."""
    x, y, z = normal
    a, b = (0.0, 1.0) if abs(y) < 0.5 else (1.0, 0.0)
    along = a * z + b * y
    u, v, w = -along * x, b - along * y, a - along * z
    norm = math.sqrt(u * u + v * v + w * w)
    return u / norm, v / norm, w / norm


@compiled
def _of_one(priority, link, carrier, of_both):
    """The parameter of the geom with the higher priority, or that of both."""
    if priority:
        return carrier if priority > 0 else link
    return of_both


@compiled
def _write_law(links, fields, out, at, pair):
    """Writes a contact's parameters from two geoms, as MuJoCo's `mj_contactParam`."""
    world, link, which = pair
    own, other = links.geoms[link], links.carriers[which]
    priority, mix = links.priorities[link, which], links.mix[link, which]
    row = fields.geom_friction[world % len(fields.geom_friction)]
    for k, kind in enumerate((0, 0, 1, 2, 2)):  # sliding, spinning, rolling
        a, b = float(row[own, kind]), float(row[other, kind])
        friction = _of_one(priority, a, b, max(a, b))
        out.friction[at, k] = max(friction, _LEAST_FRICTION)
    row = fields.geom_solref[world % len(fields.geom_solref)]
    direct = row[own, 0] <= 0 or row[other, 0] <= 0
    for k in range(2):
        a, b = float(row[own, k]), float(row[other, k])
        both = min(a, b) if direct else mix * a + (1.0 - mix) * b
        out.solref[at, k] = _of_one(priority, a, b, both)
    row = fields.geom_solimp[world % len(fields.geom_solimp)]
    for k in range(5):
        a, b = float(row[own, k]), float(row[other, k])
        out.solimp[at, k] = _of_one(priority, a, b, mix * a + (1.0 - mix) * b)
    out.dim[at] = links.dims[link, which]
    out.geom[at, 0], out.geom[at, 1] = own, other


@compiled
def count(world, scratch, given):
    """Counts the contacts of a world of `Written`."""
    links, found, worlds = given.links, given.found, len(given.overflow)
    threads, total = len(links.geoms), 0
    for which in range(len(links.carriers)):
        first = (which * worlds + world) * threads
        for thread in range(first, first + threads):
            total += found.number[thread]
    most = len(given.out.dist) // worlds
    if total > most:
        given.overflow[world] |= _OVERFLOW
    given.counts[world] = min(total, most)


@compiled
def place(thread, scratch, given):
    """Writes contacts of `Written` into Warp's arrays; threads as of `_whose`."""
    links, found, out = given.links, given.found, given.out
    threads, worlds = len(links.geoms), len(given.overflow)
    link, world, which = _whose(thread, links, worlds)
    last = given.starts[world] + given.counts[world]
    if thread == 0:
        out.nacon[0] = given.starts[worlds - 1] + given.counts[worlds - 1]
    at = given.starts[world]
    for own in range(which * threads + link):  # contacts that other threads write
        carrier, before = own // threads, own % threads
        at += found.number[(carrier * worlds + world) * threads + before]
    for n in range(min(found.number[thread], last - at)):
        _write(given, at + n, (world, link, which), found.rows[thread, n])
        out.geomcollisionid[at + n] = n


@compiled
def _write(given, at, own, row):
    """Writes a contact to index `at` of Warp's arrays."""
    out, normal = given.out, (row[4], row[5], row[6])
    side = _tangent(normal)
    other = (
        normal[1] * side[2] - normal[2] * side[1],
        normal[2] * side[0] - normal[0] * side[2],
        normal[0] * side[1] - normal[1] * side[0],
    )
    out.dist[at] = row[0]
    for k in range(3):
        out.pos[at, k] = row[1 + k]
        out.frame[at, 0, k] = normal[k]
        out.frame[at, 1, k] = side[k]
        out.frame[at, 2, k] = other[k]
    _write_law(given.links, given.fields, out, at, own)
    if row[7] != 0.0:
        share(Contact(out.pos[at], out.frame[at], out.solimp[at], out.solref[at]))
    out.worldid[at] = own[0]
    for k in range(out.efc_address.shape[1]):
        out.efc_address[at, k] = -1
