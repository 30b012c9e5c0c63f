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
# Depth of the axis outside the lumen, m, from which a device is behind the wall. A
# rigid wall is penetrated by less than 1 mm; a compliant one may be indented up to the
# depth from which control steps are repeated, here with 1 mm to spare.
_ESCAPE_DEPTH, _BEYOND_INDENTATION = 2e-3, 1e-3
# No contact of a device that is pushed with 5 N at most is harder than this, N.
MAX_FORCE = 50.0


def escaped(
    anatomy: Anatomy,
    centreline: np.ndarray,
    along: np.ndarray,
    indentation: float | None = None,
) -> np.ndarray:
    """Whether devices have left the lumen.

    Args:
        centreline: (..., n, 3), nodes of the devices, m, world frame.
        along: (3,) unit vector of the sheath, which may be tilted against the inlet.
        indentation: Depth in a compliant wall from which control steps are repeated, m;
            None for a rigid wall.

    Returns:
        (...) bool: a node past the inlet is more than 2 mm outside the lumen, or, in a
        compliant wall, more than `indentation` + 1 mm.
    """
    deep = _ESCAPE_DEPTH
    if indentation is not None:
        deep = indentation + _BEYOND_INDENTATION
    outside = past_sheath(anatomy, centreline, along)
    outside[outside] = anatomy.lumen(centreline[outside]) < -deep
    return np.logical_or.reduce(outside, axis=-1)


def found(
    case: Callable[[int], Case],
    steps: np.ndarray,
    nodes: np.ndarray,
    warned: np.ndarray,
    force: np.ndarray,
    indentation: float | None = None,
) -> tuple[str | None, ...]:
    """Physics error of each of N simulations in the last control step, or None.

    Args:
        case: Function from the number of a simulation to its case.
        steps: (N,), control steps of the episodes.
        nodes: (N, n, 3), nodes of the devices, mapped to the vessel at rest, m.
        warned: (N,) bool, whether MuJoCo has warned.
        force: (N,), largest contact force in any physics step, N.
        indentation: See `escaped`.
    """
    errors: list[str | None] = [None] * len(steps)
    due: dict[Case, list[int]] = {}
    # With few simulations, plain numbers are faster than arrays.
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
        along = scene.placement.direction
        left = escaped(scene.anatomy, nodes[indices], along, indentation)
        for index in np.array(indices)[left].tolist():
            errors[index] = ESCAPED
    return tuple(errors)
