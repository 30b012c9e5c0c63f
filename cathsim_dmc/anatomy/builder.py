"""Ends, inlet and goals of a vessel tree."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.centreline import Array, VesselTree
from cathsim_dmc.anatomy.parts import End, Goal, Inlet

GOAL_DEPTH = 27e-3  # m, of a goal past its ostium
_GOAL_END = 5e-3  # m, at least, before the free end
ACCESSES = ("ascending", "descending")


@dataclass(frozen=True, eq=False)
class VesselPlace:
    """A place on a vessel, given by arc length or as the nearest to a position."""

    vessel: str
    arc_length: float = 0.0  # m from the centreline's first point; inf for its last
    past_ostium: bool = False  # whether the arc length counts from the ostium
    position: Array | None = None  # (3,) m, LPS; overrides the arc length

    def arc(self, tree: VesselTree) -> float:
        """Arc length (m) of the place; ValueError if it is not on the tree."""
        vessel = tree.vessel(self.vessel)
        line = vessel.centreline
        if self.position is not None:
            return line.locate(self.position)
        arc = line.length if self.arc_length == math.inf else self.arc_length
        if self.past_ostium:
            arc += vessel.ostium
        if not -1e-9 <= arc <= line.length + 1e-9:
            raise ValueError(
                f"place {arc * 1e3:.1f} mm along vessel {self.vessel!r} is not on it: "
                f"it is {line.length * 1e3:.1f} mm long, with its ostium at "
                f"{vessel.ostium * 1e3:.1f} mm."
            )
        return min(max(arc, 0.0), line.length)


def placed(
    tree: VesselTree, inlet: VesselPlace | None, goals: Mapping[str, VesselPlace] | None
) -> tuple[VesselTree, tuple[End, ...], Inlet, dict[str, Goal]]:
    """Tree cut at the inlet, flat ends, inlet and goals, for `Anatomy.from_tree`."""
    places = default_goals(tree) if goals is None else goals
    for key, place in bounds.instance("goals", places, Mapping).items():
        bounds.instance(f"goal {key!r}", place, VesselPlace)
    found = {key: _goal(key, place, tree) for key, place in places.items()}
    inlet = VesselPlace(tree.root.name) if inlet is None else inlet
    bounds.instance("inlet", inlet, VesselPlace)
    tree, at_first = _cut_at(tree, inlet, found)
    if inlet.vessel == tree.root.name:
        # Arc lengths count from the new first point.
        for key, goal in found.items():
            line = tree.vessel(goal.vessel).centreline
            found[key] = replace(goal, arc_length=line.locate(goal.position))

    ends = []
    for name, arc, side in (
        (tree.root.name, 0.0, -1.0),
        *((name, math.inf, 1.0) for name in tree.vessels),
    ):
        place = tree.vessel(name).centreline.at(arc)
        is_open = name == inlet.vessel and at_first == (side < 0.0)
        outward, radius = side * place.tangent, float(place.radius)
        ends.append(End(name, place.position, outward, radius, is_open))
    entry = next(end for end in ends if end.open)
    opening = Inlet(entry.vessel, entry.position, -entry.direction, entry.radius)
    return tree, tuple(ends), opening, found


def default_goals(tree: VesselTree) -> dict[str, VesselPlace]:
    """A goal in each branch of 10 mm or more: 27 mm past its ostium if there is room.

    The goal lies at least 5 mm before the free end and not past the first branch of
    its vessel.
    """
    goals = {}
    for name, vessel in tree.vessels.items():
        length = vessel.centreline.length - vessel.ostium
        if vessel.parent is None or length < 2.0 * _GOAL_END:
            continue
        deepest = min(vessel.ostium + GOAL_DEPTH, vessel.centreline.length - _GOAL_END)
        for fork in tree.vessels.values():
            if fork.parent == name:
                deepest = min(deepest, vessel.centreline.locate(fork.mouth.position))
        goals[name] = VesselPlace(name, deepest)
    return goals


def _goal(name: str, place: VesselPlace, tree: VesselTree) -> Goal:
    arc = place.arc(tree)
    centre = tree.vessel(place.vessel).centreline.at(arc)
    position = centre.position if place.position is None else place.position
    depth = float(tree.depths(position)[place.vessel])
    if not depth > 0.0:
        raise ValueError(
            f"goal {name!r} at {np.round(np.multiply(position, 1e3), 1).tolist()} mm "
            f"lies {-depth * 1e3:.1f} mm outside vessel {place.vessel!r}; give a point "
            "inside it."
        )
    return Goal(name, place.vessel, position, arc)


def _cut_at(
    tree: VesselTree, inlet: VesselPlace, goals: Mapping[str, Goal]
) -> tuple[VesselTree, bool]:
    """The tree cut at the inlet, and whether the device enters at the first point."""
    vessel = tree.vessel(inlet.vessel)
    line = vessel.centreline
    arc = inlet.arc(tree)
    where = f"the inlet, {arc * 1e3:.1f} mm along {vessel.name!r},"
    at_first = vessel.parent is None and arc <= 0.5 * line.length
    low, high = (arc, line.length) if at_first else (0.0, arc)
    if high - low < 10e-3 or (vessel.parent and arc < vessel.ostium + 5e-3):
        raise ValueError(
            f"{where} leaves nothing of it; keep 10 mm of a vessel, and of a branch 5 "
            f"mm past its ostium at {vessel.ostium * 1e3:.1f} mm"
        )
    for name, child in tree.vessels.items():
        if child.parent == vessel.name:
            place = line.locate(child.mouth.position)
            reach = float(child.mouth.radius)
            if place - reach < low or place + reach > high:
                raise ValueError(
                    f"{where} is not before the ostium of branch {name!r} at "
                    f"{place * 1e3:.1f} mm; put it nearer to the free end"
                )
    for goal in goals.values():
        if goal.vessel == vessel.name and not low < goal.arc_length < high:
            raise ValueError(f"{where} has the goal {goal.name!r} behind it")
    if math.isclose(low, 0.0) and math.isclose(high, line.length):
        return tree, at_first
    cut = replace(vessel, centreline=line.slice(low, high))
    return VesselTree({**tree.vessels, vessel.name: cut}), at_first
