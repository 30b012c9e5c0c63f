"""Places of a scan's tree: its inlet, its goals and its ends; and their figures."""

from typing import Any

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import Vessel, VesselTree
from cathsim_dmc.anatomy.parts import End, Goal, Inlet
from cathsim_dmc.anatomy.scan.extract import DEVICE_RADIUS

GOAL_PAST_OSTIUM = 30e-3  # m along a branch, its first goal
GOAL_DISTAL = 0.8  # of the passable part of a branch, its second goal
INLET_WIDTH = 0.8  # of the lumen near the inlet; the rest of the blind end is cut off
INLET_SEARCH = 40e-3  # m of the root in which that width is looked for


def passable_length(vessel: Vessel) -> float:
    """Arc length (m) up to which a 5 Fr catheter fits a vessel."""
    line = vessel.centreline
    narrow = (line.radii < DEVICE_RADIUS) & (line.arc_length > vessel.ostium)
    return float(line.arc_length[narrow.argmax()] if narrow.any() else line.length)


def place_inlet(
    tree: VesselTree, at_end: bool, share: float = 1.0
) -> tuple[VesselTree, Inlet]:
    """Start the root where the lumen has its width, and look along it there.

    Args:
        tree: as it was grown.
        at_end: whether it starts at a blind end, of which a piece is cut off.
        share: of that piece which is cut off.
    """
    name, line = tree.root.name, tree.root.centreline
    if at_end:
        near = line.arc_length <= min(INLET_SEARCH, 0.3 * line.length)
        wide = INLET_WIDTH * np.median(line.radii[near])
        first = int((line.radii >= wide).argmax())
        # Further by that width, because a vessel's end may be cut off at a slant.
        start = float(line.arc_length[first] + INLET_WIDTH * line.radii[first])
        line = line.slice(start * share, line.length)
    place = line.at(0.0)
    ahead = line.at(min(3.0 * float(place.radius), 0.5 * line.length)).position
    opening = Inlet(name, place.position, ahead - place.position, float(place.radius))
    return VesselTree({**tree.vessels, name: Vessel(name, line)}), opening


def place_goals(tree: VesselTree) -> dict[str, Goal]:
    """One goal past the ostium of each branch and one far along it, by name."""
    goals = {}
    for key, vessel in tree.vessels.items():
        if vessel.parent is None:
            continue
        reach = passable_length(vessel) - vessel.ostium
        first = vessel.ostium + min(GOAL_PAST_OSTIUM, 0.5 * reach)
        places = {key: first}
        if GOAL_DISTAL * reach > 1.3 * (first - vessel.ostium):
            places[f"{key}_distal"] = vessel.ostium + GOAL_DISTAL * reach
        for name, s in places.items():
            goals[name] = Goal(name, key, vessel.centreline.at(s).position, float(s))
    return goals


def flat_ends(tree: VesselTree, opening: Inlet) -> tuple[End, ...]:
    """The inlet, open, and the capped ends of all vessels that do not go on."""
    ends = [
        End(opening.vessel, opening.position, -opening.direction, opening.radius, True)
    ]
    for key, vessel in tree.vessels.items():
        length = vessel.centreline.length
        branches = [k for k, v in tree.vessels.items() if v.parent == key]
        if any(tree.origin(k) > length - 1e-6 for k in branches):
            continue  # goes on in its branches
        place = vessel.centreline.at(length)
        ends.append(End(key, place.position, place.tangent, float(place.radius), False))
    return tuple(ends)


def describe(anatomy: Anatomy) -> dict[str, Any]:
    """Figures of an imported anatomy, JSON values in millimetres."""
    vessels, goals, inlet = {}, {}, anatomy.inlet
    for key, vessel in anatomy.tree.vessels.items():
        line = vessel.centreline
        own = line.radii[line.arc_length >= vessel.ostium]
        vessels[key] = {
            "parent": vessel.parent,
            "length_mm": round(line.length * 1e3, 1),
            "ostium_mm": round(vessel.ostium * 1e3, 1),
            "median_radius_mm": round(float(np.median(own)) * 1e3, 2),
            "passable_mm": round(passable_length(vessel) * 1e3, 1),
        }
    for key, goal in anatomy.goals.items():
        route = anatomy.route(key)
        goals[key] = {
            "vessel": goal.vessel,
            "route_mm": round(route.length * 1e3, 1),
            "narrowest_radius_mm": round(float(route.radii.min()) * 1e3, 2),
        }
    return {
        "name": anatomy.name,
        "surface_triangles": len(anatomy.surface.faces),
        "volume_ml": round(anatomy.surface.volume * 1e6, 1),
        "inlet": {
            "vessel": inlet.vessel,
            "position_mm": np.round(inlet.position * 1e3, 1).tolist(),
            "radius_mm": round(inlet.radius * 1e3, 2),
        },
        "vessels": vessels,
        "goals": goals,
    }
