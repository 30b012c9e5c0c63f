"""Contacts of links with walls that move, as functions of one thread of a GPU.

The laws are `laws.moving_contact` and `laws.motion`, as in `collision.moving` and
`physics.adapters.motion`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.capsule import SAMPLES
from cathsim_dmc.laws.contact import CONTACT, contacts
from cathsim_dmc.laws.contact import Scratch as Memory
from cathsim_dmc.laws.field import FREE
from cathsim_dmc.laws.motion import (
    VALUES,
    WARP,
    nth_course,
    wall_velocity,
    warp,
)
from cathsim_dmc.laws.moving_contact import MovingScratch, moving_contacts
from cathsim_dmc.laws.planes import MOST, PLANES
from cathsim_dmc.laws.vectors import into
from cathsim_dmc.laws.wall import clearance_along
from cathsim_dmc.simulation.warp.contact_arrays import Contacts, Links, Walls
from cathsim_dmc.simulation.warp.contact_kernels import (
    Scene,
    is_finite,
    keep,
    matrix,
    pair_of,
    vector,
)
from cathsim_dmc.simulation.warp.devices import Scratch

SCRATCH: Scratch = ((SAMPLES + WARP,), (PLANES + VALUES, 4), (MOST, CONTACT))
_LEAST, _MOST = 1e-4, 0.9999  # MuJoCo's mjMINIMP and mjMAXIMP


class Boxes(NamedTuple):
    """Boxes around the sheaths of N worlds; size 0 for none.

    Attributes:
        places: (N, 1, 3) m, centres.
        turns: (N, 1, 3, 3), axes in columns.
        sizes: (N, 3) m, half lengths.
    """

    places: Any
    turns: Any
    sizes: Any


class Vessels(NamedTuple):
    """Motion of the walls of N worlds, and their sheaths, which do not move.

    Attributes:
        time: (N,) s, Warp's.
        parameters: `laws.motion.MotionParameters` of arrays (N,).
        boxes: See `Boxes`.
    """

    time: Any
    parameters: Any
    boxes: Boxes


class MovingScene(NamedTuple):
    """Inputs of `find_moving`."""

    scene: Scene
    vessels: Vessels


class Carried(NamedTuple):
    """Inputs of `carry`, and the arrays that it changes, the last two.

    Attributes:
        links: See `Links`.
        walls: See `Walls`.
        vessels: See `Vessels`.
        contacts: Warp's.
        counts, starts: (N,), see `WallContacts`.
        timestep: (1 or N,) s, Warp's.
        velocity: (N, R) velocities of the rows of constraints, Warp's `efc.vel`.
        reference: (N, R) their reference accelerations, Warp's `efc.aref`.
    """

    links: Links
    walls: Walls
    vessels: Vessels
    contacts: Contacts
    counts: Any
    starts: Any
    timestep: Any
    velocity: Any
    reference: Any


@compiled
def _is_inside(boxes, world, place):
    """Whether a place (3) m is in the box around the sheath."""
    origin, size = vector(boxes.places, world, 0), boxes.sizes[world]
    apart = (place[0] - origin[0], place[1] - origin[1], place[2] - origin[2])
    x, y, z = into(matrix(boxes.turns, world, 0), apart)
    return abs(x) < size[0] and abs(y) < size[1] and abs(z) < size[2]


@compiled
def _lattice(walls, number):
    """Lattice of the motion of a wall; empty for a wall at rest."""
    return (walls.lattice[walls.starts[number, 5, 0] : walls.starts[number, 5, 1]],)


@compiled
def find_moving(thread, scratch, given):
    """Finds the contacts of a link with a wall of a `MovingScene` that may move."""
    scene, vessels = given.scene, given.vessels
    scene.found.number[thread] = 0
    pair = pair_of(thread, scene)
    if not is_finite(pair):
        return
    wall, capsule, law, sweep = pair.wall, pair.capsule, pair.law, pair.sweep
    first, planes, out = scratch
    samples, own = first[:SAMPLES], planes[:PLANES]
    (lattice,) = _lattice(scene.walls, pair.number)
    if len(lattice) == 0:
        made = contacts(wall, capsule, law, sweep, Memory(samples, own), out)
    else:
        # In the sheath, which does not move, only the wall at rest counts.
        if _is_inside(vessels.boxes, pair.world, pair.centre):
            if clearance_along(wall, capsule, 0.0) >= FREE:
                return
        time = float(vessels.time[pair.world])
        motion = lattice, nth_course(vessels.parameters, pair.world, time)
        memory = MovingScratch(samples, own, planes[PLANES:], first[SAMPLES:])
        made = moving_contacts(wall, capsule, law, sweep, motion, memory, out)
    keep(scene.found, thread, pair, out, made)


@compiled
def _impedance(solimp, depth):
    """Impedance of a contact (5 numbers) at a depth, m, as MuJoCo's `getimpedance`."""
    low = min(max(float(solimp[0]), _LEAST), _MOST)
    high = min(max(float(solimp[1]), _LEAST), _MOST)
    middle, power = float(solimp[3]), float(solimp[4])
    share = abs(depth) / float(solimp[2])
    if share >= 1.0:
        return high
    if share <= middle:
        return low + (high - low) * share**power / middle ** (power - 1.0)
    rest = (1.0 - share) ** power / (1.0 - middle) ** (power - 1.0)
    return low + (high - low) * (1.0 - rest)


@compiled
def _damping(contacts, at, row, step):
    """Change of a row's reference with its velocity, 1/s, with a direct `solref`.

    As in MuJoCo Warp's `constraint._efc_row` with the integrator `discrete`.
    """
    solimp, solref = contacts.solimp[at], contacts.solref[at]
    high = min(max(float(solimp[1]), _LEAST), _MOST)
    damping, spring = -float(solref[1]) / high, 0.0
    if row == 0:
        depth = float(contacts.dist[at])
        spring = -float(solref[0]) / high**2 * _impedance(solimp, depth)
    return (damping + step * spring) / (1.0 + step * (damping + step * spring))


@compiled
def carry(world, scratch, given):
    """Adds the velocity of the wall to the contacts of a world of `Carried`.

    Warp computes the references of constraints from the velocities of links alone.
    """
    walls, out, rows = given.walls, given.contacts, given.velocity.shape[1]
    there, values = scratch[0][SAMPLES:], scratch[1][PLANES:]
    step = float(given.timestep[world % len(given.timestep)])
    time = float(given.vessels.time[world]) + 0.5 * step
    course = nth_course(given.vessels.parameters, world, time)
    for which in range(len(given.links.carriers)):
        (lattice,) = _lattice(walls, walls.of_world[world, which])
        if len(lattice) == 0:
            continue
        first = given.starts[world]
        for at in range(first, first + given.counts[world]):
            if out.geom[at, 1] != given.links.carriers[which]:
                continue
            place, frame = out.pos[at], out.frame[at]
            where = (float(place[0]), float(place[1]), float(place[2]))
            warp(lattice, course, where, values, there)
            # The frame's first axis points from the device into the wall.
            normal = (-frame[0, 0], -frame[0, 1], -frame[0, 2])
            u, v, w = wall_velocity(there, normal)
            for row in range(min(out.dim[at], 3)):
                number = out.efc_address[at, row]
                if not 0 <= number < rows:
                    continue
                speed = frame[row, 0] * u + frame[row, 1] * v + frame[row, 2] * w
                given.velocity[world, number] += speed
                speed *= _damping(out, at, row, step)
                given.reference[world, number] -= speed
