"""Figures of an imported anatomy."""

from __future__ import annotations

from typing import Any

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.scan.places import passable_length


def describe(anatomy: Anatomy) -> dict[str, Any]:
    """Figures of an imported anatomy, JSON values in millimetres."""
    vessels = {}
    for key, vessel in anatomy.tree.vessels.items():
        line = vessel.centreline
        own = line.arc_length >= vessel.ostium
        vessels[key] = {
            "parent": vessel.parent,
            "length_mm": round(line.length * 1e3, 1),
            "ostium_mm": round(vessel.ostium * 1e3, 1),
            "median_radius_mm": round(float(np.median(line.radii[own])) * 1e3, 2),
            "passable_mm": round(passable_length(vessel) * 1e3, 1),
        }
    goals = {}
    for key in anatomy.goals:
        route = anatomy.route(key)
        goals[key] = {
            "vessel": anatomy.goals[key].vessel,
            "route_mm": round(route.length * 1e3, 1),
            "narrowest_radius_mm": round(float(route.radii.min()) * 1e3, 2),
        }
    return {
        "name": anatomy.name,
        "surface_triangles": len(anatomy.surface.faces),
        "volume_ml": round(anatomy.surface.volume * 1e6, 1),
        "inlet": {
            "vessel": anatomy.inlet.vessel,
            "position_mm": np.round(anatomy.inlet.position * 1e3, 1).tolist(),
            "radius_mm": round(float(anatomy.inlet.radius) * 1e3, 2),
        },
        "vessels": vessels,
        "goals": goals,
    }
