"""Compliant wall: the contact of a link as a spring of the vessel's stiffness.

A tube of radius r, modulus E, thickness h and Poisson's ratio ν under a point load has
the stiffness 4 E h² / (√(3 (1 - ν²)) r) where its surroundings keep it round, and
E/(1 - ν²) h³ / (12 · 0.149 r³) · r √(r/h) where it may become oval (sources in
docs/vessel_model.md). The stiffness is their geometric mean with the weight `support`.
"""

import math
from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.parameters import Array
from cathsim_dmc.laws.planes import MOST

POISSON = 0.5
# Thickness relative to the radius of an artery, and least thickness, m: 1.4 and 1.0 mm
# at the ascending and descending aorta (PMC3154923), 0.6 mm at a carotid.
_RELATIVE, _THINNEST = 0.1, 0.6e-3


class Material(NamedTuple):
    """Material of the wall.

    Attributes:
        modulus: Young's modulus, Pa.
        thickness: m; NaN for that of an artery, a tenth of the radius and at least
            0.6 mm.
        support: Weight from 0 to 1: 1 for a vessel that its surroundings keep round, 0
            for one that may become oval.
    """

    modulus: Any
    thickness: Any
    support: Any


class Law(NamedTuple):
    """MuJoCo's contact parameters of a wall.

    Attributes:
        solref: (2,).
        solimp: (5,).
        relaxation: Relaxation time of a compliant wall, s; 0 to use `solref`.
    """

    solref: Any
    solimp: Any
    relaxation: Any


class Sharing(NamedTuple):
    """Which contacts of a physics step share a spring, written with the contacts.

    Attributes:
        shared: (L, MOST), 1 where contact n of a link shares the spring of its place
            with another one, else 0; undefined beyond the last contact.
    """

    shared: Any = Array("links", MOST)


class Links(NamedTuple):
    """The links of a device, arrays (L,).

    Attributes:
        geoms: Geoms of the links.
        weight: Inverse weights (`body_invweight0`), 1/kg.
        rigid: Stiffness of the links' contact with a rigid wall, N/m.
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
    """`solref` (2) of a contact of a stiffness (N/m) and an inverse weight (1/kg)."""
    first, last = law.solimp[0], law.solimp[1]
    scale = stiffness * last * (1.0 - first) * weight / first
    return -scale * last / first, -scale * law.relaxation


@compiled
def write_contacts(radius, material, links, laws, solref, solimp):
    """Writes the contact parameters of the links of a simulation.

    Args:
        radius: (L,), radius of the lumen around each link, m; 0 for none.
        material: `Material`.
        links: `Links`; where the vessel is stiffer than `rigid`, the rigid law applies.
        laws: `Law` of the rigid wall, and of the compliant one.
        solref: (ngeom, 2), `geom_solref`, written.
        solimp: (ngeom, 5), `geom_solimp`, written.
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
    """Halves stiffness and damping of a contact that shares the spring of its place."""
    solref = contact.solref
    solref[0], solref[1] = 0.5 * solref[0], 0.5 * solref[1]
