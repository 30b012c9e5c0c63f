"""Places of a scan's tree: its inlet, its goals and its ends."""

from __future__ import annotations

import numpy as np

from cathsim_dmc.anatomy.centreline import Vessel, VesselTree
from cathsim_dmc.anatomy.parts import End, Goal, Inlet
from cathsim_dmc.anatomy.scan.extract import DEVICE_RADIUS

GOAL_PAST_OSTIUM = 30e-3  # m along a branch, its first goal
GOAL_DISTAL = 0.8  # of the passable part of a branch, its second goal
INLET_WIDTH = 0.8  # of the lumen near the inlet; the rest of the blind end is cut off
INLET_SEARCH = 40e-3  # m of the root in which that width is looked for


def passable_length(vessel: Vessel, radius: float = DEVICE_RADIUS) -> float:
    """Arc length (m) up to which a sphere of ``radius`` (m) fits a vessel."""
    line = vessel.centreline
    narrow = (line.radii < radius) & (line.arc_length > vessel.ostium)
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
    root = tree.root
    line = root.centreline
    start = 0.0
    if at_end:
        near = line.arc_length <= min(INLET_SEARCH, 0.3 * line.length)
        wide = INLET_WIDTH * np.median(line.radii[near])
        first = int((line.radii >= wide).argmax())
        # Further by that width, because a vessel's end may be cut off at a slant.
        start = float(line.arc_length[first] + INLET_WIDTH * line.radii[first])
        start *= share
    if start > 0.0:
        line = line.slice(start, line.length)
    place = line.at(0.0)
    ahead = line.at(min(3.0 * float(place.radius), 0.5 * line.length)).position
    opening = Inlet(
        root.name, place.position, ahead - place.position, float(place.radius)
    )
    vessels = dict(tree.vessels)
    vessels[root.name] = Vessel(root.name, line)
    return VesselTree(vessels), opening


def place_goals(tree: VesselTree, root: str) -> dict[str, Goal]:
    """One goal past the ostium of each branch and one far along it, by name."""
    goals = {}
    for key, vessel in tree.vessels.items():
        if key == root:
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
