"""Figures of an imported anatomy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.scan.compiled_field import compiled
from cathsim_dmc.anatomy.scan.places import passable_length
from cathsim_dmc.anatomy.scan.wall import DEVICE_RADIUS
from cathsim_dmc.anatomy.wall import fidelity

SAMPLING = 1e-3  # m, between the places at which the passage is tried
SURFACE_SAMPLING = 1.5e-3  # m, between the places at which intrusion is measured
RAYS = 20_000  # shot at the wall to find leaks


def describe(anatomy: Anatomy) -> dict[str, Any]:
    """Figures of an imported anatomy, JSON values in millimetres.

    The wall is measured: how far it protrudes into the lumen, rays that escape through
    it, and vessels that it closes to a 5 Fr catheter.
    """
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
        "wall_pieces": len(anatomy.wall),
        "wall": measure_wall(anatomy),
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


def measure_wall(anatomy: Anatomy) -> dict[str, Any]:
    """Figures of the wall, JSON values in millimetres; see ``fidelity``."""

    def summary(values: fidelity.Distribution) -> dict[str, float]:
        return {
            key: round(getattr(values, key) * 1e3, 3) for key in ("mean", "p95", "max")
        }

    if anatomy.field is not None:
        anatomy = replace(anatomy, field=compiled(anatomy.field))
    found = fidelity.intrusion(anatomy, SURFACE_SAMPLING)
    rays = fidelity.coverage(anatomy, RAYS)
    passage = fidelity.patency(anatomy, DEVICE_RADIUS, spacing=SAMPLING)
    return {
        "intrusion_mm": summary(found.inside),
        "recession_mm": summary(found.recession),
        "rays": rays.rays,
        "leaks": rays.leaks,
        "closed_to_5fr": list(passage.blocked),
    }
