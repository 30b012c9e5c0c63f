"""Contact of a capsule or a sphere with a wall at rest.

A contact is a row of `out`: unit normal (3) away from the wall, clearance of the
capsule's axis (m), place along the axis (m), and 1 where the contact shares the spring
of its place with another one, else 0. `world_contact` converts it for an engine of
rigid bodies.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.compiled import inlined, law
from cathsim_dmc.laws.capsule import EVERY, nearest_places
from cathsim_dmc.laws.planes import (
    MOST,
    Touch,
    plane_normal,
    tangent_planes,
    write_plane,
)
from cathsim_dmc.laws.vectors import along, cross, dot, length, opposite
from cathsim_dmc.laws.wall import is_straight_bore, normal_at

CONTACT = 6  # numbers of a contact
# First number of `solimp` that marks a link at a compliant wall, and the largest one of
# a contact that starts soft enough for a single plane.
COMPLIANT, _SOFT_START = 0.7, 0.1
# In a compliant wall, one plane suffices up to a depth times slope, m, of this number,
# m/s², divided by |`solref`|: less than half a rigid wall's load.
_LIGHT = 15.0
# Contact activation distance, m: under load, a single physics step without a contact
# lets a light tip jump by most of a millimetre.
_ACTIVATION = 1e-4
_TOUCHING = -1e-9  # m, distance of a contact within the activation distance
# Depth at the end of the physics step, m, from which a motion is an impact.
IMPACT = 1e-4
_JOINED = 1e-6  # m, within which the end of a capsule is at the joint of its body


class Law(NamedTuple):
    """Contact parameters of a link and a wall; see `contact_law`.

    Attributes:
        radius: Of the capsule, m.
        margin: Margin of the pair, m, within which a contact without a force is made.
        activation: Contact activation distance, m; 0 where there is none.
        compliant: Whether the wall is compliant: the planes of a place share a spring.
        single: Whether one plane suffices under a light load.
        light: See `planes.Touch`.
    """

    radius: Any
    margin: Any
    activation: Any
    compliant: Any
    single: Any
    light: Any


class Sweep(NamedTuple):
    """Motion of a capsule in a physics step, in the frame of the wall; see `sweep_of`.

    Attributes:
        travel: (3) m, of the centre.
        turn: (3), further displacement per metre from the centre along the capsule.
        reach: Clearance below which it may hit the wall, m; -inf to ignore impacts.
    """

    travel: Any
    turn: Any
    reach: Any


class Scratch(NamedTuple):
    """Scratch arrays of a law, for one capsule at a time.

    Attributes:
        samples: (capsule.SAMPLES,) float64.
        planes: (planes.PLANES, 4) float64.
    """

    samples: Any
    planes: Any


class _Place(NamedTuple):
    """A place of a capsule at the wall, and its limit of contacts."""

    t: Any  # m along the axis
    clearance: Any  # m
    lowest: Any  # whether it is the one with the least clearance
    most: Any  # limit of contacts up to this place, those before it included


@inlined
def contact_law(wall, radius, margin, impedance, reference):
    """`Law` of a link and a wall.

    Args:
        wall: `wall.Wall`.
        radius: Of the link, m.
        margin: m, of the pair.
        impedance: First number of the link's `solimp`.
        reference: First number of its `solref`; -stiffness in a compliant wall.
    """
    # No activation in a straight sheath: the shaft is not loaded there.
    near = 0.0 if margin > 0.0 or is_straight_bore(wall) else _ACTIVATION
    compliant = impedance == COMPLIANT and not wall.is_bore
    light = _LIGHT / abs(reference) if compliant else 0.0
    single = impedance < _SOFT_START or compliant
    return Law(radius, margin, near, compliant, single, light)


@inlined
def end_caps(centre, axis, half_length, joint):
    """Which end caps (2) collide: a cap at the joint of its body is the neighbour's."""
    low, high = 0.0, 0.0
    for k in range(3):
        low += (centre[k] - half_length * axis[k] - joint[k]) ** 2
        high += (centre[k] + half_length * axis[k] - joint[k]) ** 2
    return (low > _JOINED * _JOINED, high > _JOINED * _JOINED)


@inlined
def looks_ahead(law):
    """Whether an impact in the coming physics step makes a contact in advance."""
    return law.activation > 0.0 and not law.compliant


@law
def swept(parents, motions, velocities, dof, centre, about, step):
    """Displacement (3) m of a point and rotation (3) rad of its body in a physics step.

    World frame, at the present velocity, which is summed over the degrees of freedom.

    Args:
        parents: Parent of each degree of freedom, -1 for none.
        motions: Axes (n, 6) of the degrees of freedom about `about`: rotation, then
            translation, as MuJoCo's `cdof`.
        velocities: Their velocities (n).
        dof: Last degree of freedom that moves the body, -1 for none.
        centre: The point (3) m.
        about: Centre of mass (3) m of the body's tree.
        step: Physics step, s.
    """
    a, b, c, x, y, z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    while dof >= 0:
        motion, velocity = motions[dof], float(velocities[dof])
        a, b = a + motion[0] * velocity, b + motion[1] * velocity
        c, x = c + motion[2] * velocity, x + motion[3] * velocity
        y, z = y + motion[4] * velocity, z + motion[5] * velocity
        dof = parents[dof]
    u, v, w = centre[0] - about[0], centre[1] - about[1], centre[2] - about[2]
    x, y, z = x + b * w - c * v, y + c * u - a * w, z + a * v - b * u
    return (step * x, step * y, step * z), (step * a, step * b, step * c)


@inlined
def sweep_of(capsule, law, travel, turn):
    """`Sweep` of a capsule.

    Args:
        capsule: `places.Capsule`.
        law: `Law`.
        travel: (3) m, of its centre in a physics step, in the frame of the wall.
        turn: (3) rad, rotation of the capsule in that step.
    """
    if not looks_ahead(law):
        still = (0.0, 0.0, 0.0)
        return Sweep(still, still, -np.inf)
    aside = cross(turn, capsule.axis)
    ahead = length(travel) + capsule.half_length * length(aside)
    return Sweep(travel, aside, law.radius + ahead - IMPACT)


@inlined
def hits(law, sweep, t, normal, clearance):
    """Whether a place hits the wall in this physics step.

    Args:
        law: `Law`.
        sweep: `Sweep`.
        t: m along the capsule.
        normal: (3) unit vector away from the wall.
        clearance: Clearance of the place, m.
    """
    ahead = dot(normal, along(sweep.travel, sweep.turn, t))
    return clearance + ahead <= law.radius - IMPACT


@inlined
def nth(places, n, compliant):
    """`_Place` n of a capsule, with the limit of the contacts up to it.

    The limit is 0 at a rigid wall where a place with less clearance is within `EVERY`.
    It leaves one contact for a second place, or two if that has less clearance.
    """
    t, clearance = places.first, places.first_clearance
    other = places.second_clearance
    if n:
        t, clearance, other = places.second, places.second_clearance, clearance
    lowest = clearance <= other
    if not lowest and places.second - places.first < EVERY and not compliant:
        return _Place(t, clearance, lowest, 0)
    left = 1 + int(not lowest) if places.found - n == 2 else 0
    return _Place(t, clearance, lowest, MOST - left)


@inlined
def turns_of(capsule, place, half_length):
    """`turns` of `planes.tangent_planes`; a sphere has one contact at most."""
    if capsule.half_length == 0.0:
        return 0
    return 1 + int(place.lowest and abs(place.t) >= half_length)


@inlined
def append(law, planes, count, bounds, t, written, out):
    """Appends planes to the contacts; returns the number of contacts.

    Args:
        law: `Law`.
        planes: (planes.PLANES, 4).
        count: Number of planes.
        bounds: Limit of contacts in all, and largest clearance of a plane, m.
        t: m along the capsule.
        written: Number of contacts so far.
        out: (MOST, CONTACT).
    """
    most, limit = bounds
    for plane in range(count):
        if written == most or planes[plane, 3] > limit:
            continue
        write_plane(out, written, plane_normal(planes, plane), planes[plane, 3])
        out[written, 4] = t
        out[written, 5] = 1.0 if law.compliant and count > 1 else 0.0
        written += 1
    return written


@law
def contacts(wall, capsule, law, sweep, scratch, out):
    """Writes the contacts of a capsule with a wall at rest.

    Args:
        wall: `wall.Wall`.
        capsule: `places.Capsule`, in the frame of the wall.
        law: `Law`.
        sweep: `Sweep`.
        scratch: `Scratch`.
        out: (MOST, CONTACT) float64, gets the contacts.

    Returns:
        Number of contacts.
    """
    limit = law.radius + law.margin + law.activation
    places = nearest_places(wall, capsule, max(limit, sweep.reach), scratch.samples)
    written, planes = 0, scratch.planes
    for n in range(places.found):
        place = nth(places, n, law.compliant)
        if place.most == 0:
            continue
        point = along(capsule.centre, capsule.axis, place.t)
        normal = normal_at(wall, point)
        if normal == (0.0, 0.0, 0.0):
            continue
        if place.clearance <= (limit if place.lowest else law.radius + law.margin):
            turns = turns_of(capsule, place, capsule.half_length)
            touching = law.radius if law.single else 0.0
            touch = Touch(
                point, capsule.axis, normal, place.clearance, touching, law.light
            )
            count = tangent_planes(wall, touch, limit, turns, planes)
        else:
            if not hits(law, sweep, place.t, normal, place.clearance):
                continue
            write_plane(planes, 0, normal, place.clearance)
            count = 1
        bounds = place.most, np.inf
        written = append(law, planes, count, bounds, place.t, written, out)
    return written


@inlined
def world_contact(contact, law, centre, axis, frame):
    """Distance, position and direction of a contact in the world.

    Args:
        contact: (CONTACT,) a row of `out`.
        law: `Law`.
        centre: (3) m, of the capsule, in the world.
        axis: (3) unit vector of the capsule, in the world.
        frame: (9) matrix whose columns are the axes of the wall's frame.

    Returns:
        Distance of the surfaces, m, < 0 where they overlap; the point (3) m half way
        between them; the unit vector (3) from the capsule into the wall.
    """
    distance = contact[3] - law.radius
    reached = law.radius + 0.5 * distance
    if law.activation > 0.0:
        distance = min(distance, _TOUCHING)
    towards = opposite(frame, contact)
    place = along(along(centre, axis, contact[4]), towards, reached)
    return distance, place, towards
