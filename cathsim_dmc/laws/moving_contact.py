"""Contact of a capsule or a sphere with a wall that moves.

The clearance at a point in space is that of the wall at rest, at the point's place at
rest (`motion`). Places that may touch are found on a straight image of the capsule at
rest, whose error is `_IMAGE` plus the strain of space. At each of these places, the
wall is evaluated exactly and its planes are mapped back into space.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.compiled import law
from cathsim_dmc.laws.capsule import nearest_places
from cathsim_dmc.laws.contact import append, hits, nth, turns_of
from cathsim_dmc.laws.field import FREE
from cathsim_dmc.laws.motion import planes_in_space, rest_place, warp
from cathsim_dmc.laws.places import Capsule
from cathsim_dmc.laws.planes import Touch, plane_normal, tangent_planes, write_plane
from cathsim_dmc.laws.vectors import along
from cathsim_dmc.laws.wall import clearance, normal_at

_IMAGE = 0.2e-3  # m, error of the straight image of a capsule


class MovingScratch(NamedTuple):
    """Scratch arrays of the law, for one capsule at a time.

    Attributes:
        samples: (capsule.SAMPLES,) float64.
        planes: (planes.PLANES, 4) float64.
        values: (motion.VALUES, 4) float64.
        there: (motion.WARP,) float64.
    """

    samples: Any
    planes: Any
    values: Any
    there: Any


@law
def _image(capsule, there):
    """Image of a capsule at rest, its stretch, and the squared strain of space."""
    strain = 0.0
    for k in range(3, 12):
        strain += (there[k] - (1.0 if k % 4 == 3 else 0.0)) ** 2
    axis = capsule.axis
    x = there[3] * axis[0] + there[4] * axis[1] + there[5] * axis[2]
    y = there[6] * axis[0] + there[7] * axis[1] + there[8] * axis[2]
    z = there[9] * axis[0] + there[10] * axis[1] + there[11] * axis[2]
    stretch = math.sqrt(x * x + y * y + z * z)
    way, half = (x / stretch, y / stretch, z / stretch), capsule.half_length * stretch
    return Capsule(rest_place(there), way, half, capsule.caps), stretch, strain


@law
def moving_contacts(wall, capsule, law, sweep, motion, scratch, out):
    """Writes the contacts of a capsule with a wall that moves.

    Args:
        wall: `wall.Wall` at rest.
        capsule: `places.Capsule` in space, in the frame of the wall.
        law: `contact.Law`.
        sweep: `contact.Sweep`.
        motion: Lattice and `motion.Course`.
        scratch: `MovingScratch`.
        out: (MOST, CONTACT) float64, gets contacts as `contact.contacts` writes them.

    Returns:
        Number of contacts.
    """
    (lattice, course), there, planes = motion, scratch.there, scratch.planes
    limit, margin = law.radius + law.margin + law.activation, law.radius + law.margin
    warp(lattice, course, capsule.centre, scratch.values, there)
    image, stretch, strain = _image(capsule, there)
    reach = (1.0 + math.sqrt(strain)) * (max(limit, sweep.reach) - there[12]) + _IMAGE
    places, written = nearest_places(wall, image, reach, scratch.samples), 0
    for n in range(places.found):
        place = nth(places, n, law.compliant)
        if place.most == 0:
            continue
        turns = turns_of(image, place, image.half_length)
        t = place.t / stretch
        warp(
            lattice,
            course,
            along(capsule.centre, capsule.axis, t),
            scratch.values,
            there,
        )
        point = rest_place(there)
        depth = clearance(wall, point)
        if depth >= FREE:
            continue
        normal = normal_at(wall, point)
        if normal == (0.0, 0.0, 0.0):
            continue
        write_plane(planes, 0, normal, depth)
        planes_in_space(there, planes, 1)
        bound, count = limit if place.lowest else margin, 1
        if planes[0, 3] <= bound:
            # The surfaces meet at the grown lumen, not at the lumen at rest.
            touching = max(law.radius - there[12], 1e-9) if law.single else 0.0
            touch = Touch(point, image.axis, normal, depth, touching, law.light)
            count = tangent_planes(wall, touch, reach, turns, planes)
            planes_in_space(there, planes, count)
        else:
            bound = np.inf
            if not hits(law, sweep, t, plane_normal(planes, 0), planes[0, 3]):
                continue
        bounds = place.most, bound
        written = append(law, planes, count, bounds, t, written, out)
    return written
