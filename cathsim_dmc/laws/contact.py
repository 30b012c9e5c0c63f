"""Contact of a capsule or a sphere with a wall at rest.

A contact is a row of `out`: unit normal (3) away from the wall, clearance of the
capsule's axis (m), place along the axis (m), and 1 where the contact shares the spring
of its place with another one, else 0. `world_contact` turns it into what an engine of
rigid bodies takes.
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
# First impedance that marks a link beside a compliant wall, and the largest one of a
# contact that starts soft enough for a single plane.
COMPLIANT, _SOFT_START = 0.7, 0.1
# One plane suffices in a compliant wall up to a depth times slope, m, of so much, m/s²,
# over |`solref`|: less than half a rigid wall's load.
_LIGHT = 15.0
# Contact activation distance, m: between contacts under load, one physics step without
# any lets the light tip jump by most of a millimetre.
_ACTIVATION = 1e-4
_TOUCHING = -1e-9  # m, the distance of a contact that is only activated
# Depth, m, at the end of the physics step from which a link hits.
IMPACT = 1e-4
_JOINED = 1e-6  # m, between the end of a capsule and the joint of its body


class Law(NamedTuple):
    """How a link and a wall meet; see `contact_law`.

    Attributes:
        radius: Of the capsule, m.
        margin: m, within which a contact may be asked for without a force.
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
        turn: (3) of places along the capsule, per metre from the centre.
        reach: Clearance below which it may hit the wall, m; -inf where none is asked.
    """

    travel: Any
    turn: Any
    reach: Any


class Scratch(NamedTuple):
    """Memory of a law, for one capsule at a time.

    Attributes:
        samples: (capsule.SAMPLES,) float64.
        planes: (planes.PLANES, 4) float64.
    """

    samples: Any
    planes: Any


class _Place(NamedTuple):
    """A place of a capsule that touches, and its share of the contacts."""

    t: Any  # m along the axis
    clearance: Any  # m
    lowest: Any  # whether it is the one with the least clearance
    most: Any  # contacts that it may have, with those before it


@inlined
def contact_law(wall, radius, margin, impedance, reference):
    """The law of a link.

    Args:
        wall: `wall.Wall`.
        radius: Of the link, m.
        margin: m, of the pair.
        impedance: First number of the link's `solimp`.
        reference: First number of its `solref`; -stiffness in a compliant wall.
    """
    # A straight sheath holds the shaft without any load.
    near = 0.0 if margin > 0.0 or is_straight_bore(wall) else _ACTIVATION
    compliant = impedance == COMPLIANT and not wall.is_bore
    light = _LIGHT / abs(reference) if compliant else 0.0
    single = impedance < _SOFT_START or compliant
    return Law(radius, margin, near, compliant, single, light)


@inlined
def end_caps(centre, axis, half_length, joint):
    """Which end caps collide: one at the joint of its body is another link's."""
    low, high = 0.0, 0.0
    for k in range(3):
        low += (centre[k] - half_length * axis[k] - joint[k]) ** 2
        high += (centre[k] + half_length * axis[k] - joint[k]) ** 2
    return (low > _JOINED * _JOINED, high > _JOINED * _JOINED)


@inlined
def looks_ahead(law):
    """Whether contacts are made for impacts in the physics step to come."""
    return law.activation > 0.0 and not law.compliant


@inlined
def sweep_of(capsule, law, travel, turn):
    """`Sweep` of a capsule.

    Args:
        capsule: `places.Capsule`.
        law: `Law`.
        travel: (3) m, of its centre in a physics step, in the frame of the wall.
        turn: (3) rad, of the capsule.
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
        clearance: m.
    """
    ahead = dot(normal, along(sweep.travel, sweep.turn, t))
    return clearance + ahead <= law.radius - IMPACT


@inlined
def nth(places, n, compliant):
    """Place n of a capsule, and how many contacts the capsule may have with it.

    None where it lies so close to a lower place that both are one, and fewer than all
    where another place follows.
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
    """How far `planes.tangent_planes` looks; a sphere may have one contact."""
    if capsule.half_length == 0.0:
        return 0
    return 1 + int(place.lowest and abs(place.t) >= half_length)


@inlined
def append(law, planes, count, bounds, t, written, out):
    """Appends planes to the contacts and returns how many there are.

    Args:
        law: `Law`.
        planes: (planes.PLANES, 4).
        count: Number of planes.
        bounds: Most contacts in all, and the clearance, m, past which a plane is none.
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
    """Contacts of a capsule with a wall at rest.

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
