"""Compliant wall: the contact of a link as a spring of the vessel's stiffness.

A tube of radius r, modulus E, thickness h and Poisson's ratio ν under a point load has
the stiffness 4 E h² / (√(3 (1 - ν²)) r) when what surrounds it holds it round, and
E/(1 - ν²) h³ / (12 · 0.149 r³) · r √(r/h) when it is free to become oval
(docs/vessel_model.md has the sources); `support` weighs them geometrically.
"""

import math
from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.parameters import Array
from cathsim_dmc.laws.planes import MOST

POISSON = 0.5
# Thickness of an artery over its radius, and the least: 1.4 and 1.0 mm at the ascending
# and descending aorta (PMC3154923), 0.6 mm at a carotid.
_RELATIVE, _THINNEST = 0.1, 0.6e-3


class Material(NamedTuple):
    """What the wall is made of.

    Attributes:
        modulus: Young's modulus, Pa.
        thickness: m; NaN for an artery's, a tenth of the radius, 0.6 mm at least.
        support: 1 for a vessel held by what surrounds it, 0 for one free to become
            oval, or between.
    """

    modulus: Any
    thickness: Any
    support: Any


class Law(NamedTuple):
    """Contact of MuJoCo with a wall.

    Attributes:
        solref: (2,).
        solimp: (5,).
        relaxation: Of a compliant wall, s; 0 for `solref` as it is.
    """

    solref: Any
    solimp: Any
    relaxation: Any


class Sharing(NamedTuple):
    """Which contacts of a physics step share a spring, written with the contacts.

    Attributes:
        shared: (L, MOST), 1 where contact n of a link shares the spring of its place
            with another one, else 0; what is beyond the last contact means nothing.
    """

    shared: Any = Array("links", MOST)


class Links(NamedTuple):
    """The links of a device, arrays (L,).

    Attributes:
        geoms: Their geoms.
        weight: Inverse weights, 1/kg.
        rigid: Stiffness of their contact with a rigid wall, N/m.
    """

    geoms: Any
    weight: Any
    rigid: Any


@compiled
def stiffness(radius, material):
    """Stiffness of a tube of a radius (m) and `Material` under a point load, N/m."""
    thickness = material.thickness
    if math.isnan(thickness):
        thickness = max(_RELATIVE * radius, _THINNEST)
    plane = 1.0 - POISSON**2
    held = 4.0 * material.modulus * thickness**2 / (math.sqrt(3.0 * plane) * radius)
    free = material.modulus / plane * thickness**3 / (12.0 * 0.149 * radius**3)
    free *= radius * math.sqrt(radius / thickness)
    return free ** (1.0 - material.support) * held**material.support


@compiled
def reference(stiffness, weight, law):
    """`solref` (2) of a spring, N/m, on a link of an inverse weight, 1/kg."""
    first, last = law.solimp[0], law.solimp[1]
    scale = stiffness * last * (1.0 - first) * weight / first
    return -scale * last / first, -scale * law.relaxation


@compiled
def write_contacts(radius, material, links, laws, solref, solimp):
    """Writes the contacts of the links of a simulation.

    Args:
        radius: (L,), of the lumen around each link, m; 0 where it is in none.
        material: `Material`.
        links: `Links`; what is stiffer than the rigid wall has its contact.
        laws: `Law` of the rigid wall, and of the compliant one.
        solref: (ngeom, 2), of the geoms, written.
        solimp: (ngeom, 5), likewise.
    """
    rigid, compliant = laws
    for n in range(len(links.geoms)):
        geom, found = links.geoms[n], links.rigid[n]
        if radius[n] > 0.0:
            found = stiffness(radius[n], material)
        soft = found < links.rigid[n]
        law = compliant if soft else rigid
        for k in range(5):
            solimp[geom, k] = law.solimp[k]
        reached = rigid.solref[0], rigid.solref[1]
        if soft:
            reached = reference(found, links.weight[n], compliant)
        solref[geom, 0], solref[geom, 1] = reached


@compiled
def share(contact):
    """Halves stiffness and damping of a contact that shares its place's spring."""
    solref = contact.solref
    solref[0], solref[1] = 0.5 * solref[0], 0.5 * solref[1]
