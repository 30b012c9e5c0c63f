"""Contacts with a wall that gives, compiled; see `wall`."""

import math

from cathsim_dmc.compiled import compiled

POISSON = 0.5
# Thickness of an artery over its radius, and the least: 1.4 and 1.0 mm at the ascending
# and descending aorta (PMC3154923), 0.6 mm at a carotid.
_RELATIVE, _THINNEST = 0.1, 0.6e-3


@compiled
def stiffness(radius, modulus, thickness, support):
    """Stiffness of a tube under a point load, N/m; a NaN thickness is an artery's."""
    if math.isnan(thickness):
        thickness = max(_RELATIVE * radius, _THINNEST)
    plane = 1.0 - POISSON**2
    held = 4.0 * modulus * thickness**2 / (math.sqrt(3.0 * plane) * radius)
    free = modulus / plane * thickness**3 / (12.0 * 0.149 * radius**3)
    free *= radius * math.sqrt(radius / thickness)
    return free ** (1.0 - support) * held**support


@compiled
def reference(stiffness, weight, first, last, relaxation):
    """`solref` (2) of a spring, N/m, on a link of an inverse weight, 1/kg.

    Args:
        stiffness: N/m.
        weight: 1/kg.
        first: impedance at no depth.
        last: impedance at the largest.
        relaxation: s.
    """
    scale = stiffness * last * (1.0 - first) * weight / first
    return -scale * last / first, -scale * relaxation


@compiled
def contacts(geoms, radius, material, weight, rigid, laws, relaxation, solref, solimp):
    """Writes the contacts of the links of one simulation.

    Args:
        geoms: (n,) numbers of the links' geoms.
        radius: (n,) of the lumen around them, m, 0 for none.
        material: (3,) modulus, thickness and support.
        weight: (n,) inverse weights, 1/kg.
        rigid: (n,) stiffness of the rigid wall's contact, N/m.
        laws: (2, 7) of the rigid wall and of one that gives: `solimp`, then `solref`,
            that of the latter not used.
        relaxation: of a wall that gives, s.
        solref: (ngeom, 2), written.
        solimp: (ngeom, 5), written.
    """
    first, last = laws[1, 0], laws[1, 1]
    for n in range(len(geoms)):
        geom, found = geoms[n], rigid[n]
        if radius[n] > 0.0:
            found = stiffness(radius[n], material[0], material[1], material[2])
        soft = found < rigid[n]
        for k in range(5):
            solimp[geom, k] = laws[1 if soft else 0, k]
        solref[geom, 0], solref[geom, 1] = laws[0, 5], laws[0, 6]
        if soft:
            solref[geom, 0], solref[geom, 1] = reference(
                found, weight[n], first, last, relaxation
            )
