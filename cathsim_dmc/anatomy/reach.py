"""Goals that a device cannot reach from the inlet of an anatomy."""

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.parts import Inlet

# The head of a device starts half-way to the first ostium, but at least 5 mm past the
# inlet (`tasks.placement`), and enters ostia that are 5 mm or more ahead of it; less in
# vessels narrower than 6.7 mm.
OSTIUM_AHEAD = 10e-3  # m, distance of an ostium from the inlet that always suffices
AHEAD_RADII = 3.0  # the same in radii of the inlet


def least_ahead(inlet: Inlet) -> float:
    """Least distance (m) from an inlet to an ostium that a device can enter."""
    return min(OSTIUM_AHEAD, AHEAD_RADII * inlet.radius)


def unreachable(anatomy: Anatomy, nearest: float = 0.0) -> dict[str, list[str]]:
    """Lists of names of unreachable goals, by the reason.

    They lie in the vessel of the inlet less than `nearest` (m) ahead of it, or in a
    branch whose ostium is less than `least_ahead` ahead of it.
    """
    inlet, tree = anatomy.inlet, anatomy.tree
    line = tree.vessel(inlet.vessel).centreline
    start = line.locate(inlet.position)
    forward = np.sign(line.at(start).tangent @ inlet.direction)
    found: dict[str, list[str]] = {}
    for name, goal in anatomy.goals.items():
        if goal.vessel == inlet.vessel:
            place, least, what = goal.arc_length, nearest, f"{name} lies"
        else:
            branch = tree.vessel(goal.vessel)
            while branch.parent not in (inlet.vessel, None):
                branch = tree.vessel(branch.parent)
            if branch.parent is None:
                continue  # the device enters by a branch, and leaves it at its ostium
            place, least = line.locate(branch.mouth.position), least_ahead(inlet)
            what = f"{branch.name} leaves {inlet.vessel}"
        ahead = forward * (place - start)
        if ahead < least:
            side = "past" if ahead > 0.0 else "before"
            where = f"{what} {1e3 * abs(ahead):.0f} mm {side} the inlet"
            found.setdefault(where, []).append(name)
    return found
