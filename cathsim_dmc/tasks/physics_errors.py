"""Physics errors: detection and names."""

from collections.abc import Callable

import numpy as np

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.placement import past_sheath

DIVERGED = "diverged"
ESCAPED = "escaped through the wall"
EXPLODED = "exploding force"

# Control steps between two checks for an escape.
ESCAPE_INTERVAL = 50
# Deeper outside the lumen than this, m, the axis of the device is behind the wall:
# the wall is 4 mm thick, and penetration stays below 1 mm.
_ESCAPE_DEPTH = 2e-3
# No contact of a device that is pushed with 5 N at most is harder than this, N.
MAX_FORCE = 50.0


def escaped(anatomy: Anatomy, centreline: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Whether devices have left the lumen.

    Args:
        centreline: (..., n, 3), nodes of the devices, m, world frame.
        along: (3,) unit vector of the sheath, which need not stand as the vessel does.

    Returns:
        (...) bool: some node past the inlet lies more than 2 mm outside the lumen.
    """
    outside = past_sheath(anatomy, centreline, along)
    outside[outside] = anatomy.lumen(centreline[outside]) < -_ESCAPE_DEPTH
    return np.logical_or.reduce(outside, axis=-1)


def found(
    case: Callable[[int], Case],
    steps: np.ndarray,
    nodes: np.ndarray,
    warned: np.ndarray,
    force: np.ndarray,
) -> tuple[str | None, ...]:
    """What went wrong in the last control step of N simulations, None for nothing.

    Args:
        case: Gives the case of a simulation by its number.
        steps: (N,), control steps of the episodes.
        nodes: (N, n, 3), nodes of the devices where they are in the vessel at rest, m.
        warned: (N,) bool, whether MuJoCo has warned.
        force: (N,), largest contact force in any physics step, N.
    """
    errors: list[str | None] = [None] * len(steps)
    due: dict[Case, list[int]] = {}
    # Of few simulations, plain numbers take less time than arrays.
    ends = zip(steps.tolist(), warned.tolist(), force.tolist(), strict=True)
    for index, (step, has_warned, hardest) in enumerate(ends):
        if has_warned:
            errors[index] = DIVERGED
        elif not hardest <= MAX_FORCE:
            errors[index] = EXPLODED
        elif step % ESCAPE_INTERVAL == 0:
            due.setdefault(case(index), []).append(index)
    for own, indices in due.items():
        scene = own.scene
        left = escaped(scene.anatomy, nodes[indices], scene.placement.direction)
        for index in np.array(indices)[left].tolist():
            errors[index] = ESCAPED
    return tuple(errors)
