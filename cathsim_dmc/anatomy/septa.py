"""Walls between vessels that run side by side."""

import numpy as np

from cathsim_dmc.anatomy.centreline import Vessel, VesselTree

# Two lumens side by side need this much wall between them, m.
LEAST = 0.2e-3
# A branch may share its lumen with its parent up to so many radii past its ostium.
_LONGEST_JUNCTION = 8.0


def junction_end(vessel: Vessel, parent: Vessel) -> float:
    """Arc length (m) from which a branch's lumen is free of its parent's.

    It is the first place past the ostium where the two tubes are `LEAST` apart.

    Raises:
        ValueError: if they are not within 8 radii of the ostium.
    """
    line = vessel.centreline
    s = np.arange(vessel.ostium, line.length, 0.5e-3)
    place = line.at(s)
    near = parent.centreline.project(place.position)
    free = near.distance - near.radius - place.radius >= LEAST
    reach = s - vessel.ostium <= _LONGEST_JUNCTION * place.radius[0]
    if not (free & reach).any():
        raise ValueError(
            f"branch {vessel.name!r} does not part from {parent.name!r} within "
            f"{_LONGEST_JUNCTION * place.radius[0] * 1e3:.0f} mm of its ostium; it "
            "runs along its parent's wall. Start it further on, or merge the two."
        )
    return float(s[int(free.argmax())])


def check_septa(tree: VesselTree) -> None:
    """Raise ValueError if two lumens touch away from where one leaves the other."""
    free = {
        name: junction_end(vessel, tree.vessel(vessel.parent))
        for name, vessel in tree.vessels.items()
        if vessel.parent is not None
    }
    for name, start in free.items():
        vessel = tree.vessel(name)
        line = vessel.centreline
        for other in tree.vessels.values():
            if other is vessel or name == other.parent:
                continue
            first = start if other.name == vessel.parent else vessel.ostium
            outside = line.slice(first, line.length)
            body = other.centreline
            if other.name in free and other.name != vessel.parent:
                body = body.slice(other.ostium, body.length)
            near = body.project(outside.points)
            clear = near.distance - near.radius - outside.radii
            worst = int(clear.argmin())
            if clear[worst] < LEAST - 1e-9:
                x, y, z = np.round(outside.points[worst] * 1e3, 1)
                raise ValueError(
                    f"vessels {name!r} and {other.name!r} come within "
                    f"{clear[worst] * 1e3:.1f} mm of each other at ({x}, {y}, {z}) mm; "
                    f"a wall between them needs {LEAST * 1e3:.1f} mm."
                )
