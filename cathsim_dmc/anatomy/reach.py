"""Goals that a device cannot reach from the inlet of an anatomy."""

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.parts import Inlet

# The head of a device starts half the way to the first ostium deep, but 5 mm at least
# (`tasks.placement`), and turns into ostia that are 5 mm or more ahead of it; less in
# vessels narrower than 6.7 mm.
OSTIUM_AHEAD = 10e-3  # m, least distance of an ostium from the inlet, at most
AHEAD_RADII = 3.0  # of the inlet, that are enough


def least_ahead(inlet: Inlet) -> float:
    """Least distance (m) from an inlet of an ostium that a device can turn into."""
    return min(OSTIUM_AHEAD, AHEAD_RADII * inlet.radius)


def unreachable(anatomy: Anatomy) -> dict[str, list[str]]:
    """Names of the goals that a device is past when it starts, by the reason.

    They lie behind the inlet, or in a branch that leaves the inlet's vessel less than
    `least_ahead` past the inlet, or before it.
    """
    inlet, tree = anatomy.inlet, anatomy.tree
    line = tree.vessel(inlet.vessel).centreline
    start = line.locate(inlet.position)
    forward = np.sign(line.at(start).tangent @ inlet.direction)
    found: dict[str, list[str]] = {}
    for name, goal in anatomy.goals.items():
        if goal.vessel == inlet.vessel:
            place, least, what = goal.arc_length, 0.0, f"{name} lies"
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
