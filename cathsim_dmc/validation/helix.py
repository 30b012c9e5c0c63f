"""Axial force on a device that has buckled into a helix in a straight tube."""

from collections.abc import Iterator

import numpy as np

from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import in_tube, uniform

TUBE = 0.3, 4e-3  # m, length and radius
LINK = 5e-3  # m, in the check; links of the tasks give a finding without bound
FORCE = 2.0  # N, at which the push stops
HELIX_BOUND = 3.0  # % of the force
_REST = 50  # control steps
_MOST = 1000  # control steps of a push
_LEAST = 0.9  # of the largest distance from the axis, where the helix begins
_MARGIN = 0.15  # of the helix, left out at both ends


def helix(link: float) -> tuple[float, float, float]:
    """Pushes a uniform device against the end of a frictionless tube.

    Args:
        link: Length of the links, m.

    Returns:
        Push force of the simulation and of `borne`, N; angle of the helix, rad.

    Raises:
        RuntimeError: if the push force is not reached.
    """
    device = uniform(link)
    environment = in_tube(TUBE, device=device, shaft_link=link, friction=0.0)
    task, action = environment.task, np.array([0.5])
    for _ in range(_MOST):
        environment.step(action)
        if task.readings.push_force >= FORCE:
            break
    else:
        raise RuntimeError(f"the push force stays below {FORCE} N")
    for _ in range(_REST):
        environment.step(0.0 * action)
    push, line = float(task.readings.push_force), task.readings.centreline
    environment.close()
    return push, *borne(one_hand(line), device.shaft.bending_stiffness)


def borne(line: np.ndarray, bending: float) -> tuple[float, float]:
    """Axial force (N) and angle α to the axis (rad) of a helix (L, 3), m, around z.

    The force is F = 2 EI sin²α cos α / r², the derivative of the bending energy by the
    shortening of a rod with the stiffness EI, N·m², that is free to rotate.
    """
    cosine = np.ptp(line[:, 2]) / np.linalg.norm(np.diff(line, axis=0), axis=-1).sum()
    radius = np.linalg.norm(line[:, :2], axis=1).mean()  # of the joints, on the rod
    force = 2 * bending * (1 - cosine**2) * cosine / radius**2
    return float(force), float(np.arccos(cosine))


def one_hand(line: np.ndarray) -> np.ndarray:
    """The first part (L, 3) of a line (N, 3) around z that is a helix of one hand.

    A rod whose base does not rotate may buckle into helices of both hands; the push
    acts on the first one from the base.

    Raises:
        RuntimeError: if the part is less than one turn.
    """
    distance = np.linalg.norm(line[:, :2], axis=1)
    first = int(np.argmax(distance > _LEAST * distance.max()))
    x, y = line[first:, :2].T
    turn = np.unwrap(np.arctan2(y, x))
    back = np.diff(turn) * (turn[1] - turn[0]) <= 0
    count = int(np.argmax(back)) if back.any() else len(back)
    low, high = (first + round(count * share) for share in (_MARGIN, 1 - _MARGIN))
    if abs(turn[high - first] - turn[low - first]) < 2 * np.pi:
        raise RuntimeError(f"the helix next to the base ends after {count} links")
    return line[low : high + 1]


def checks() -> Iterator[Check]:
    """Check of a helix of short links."""
    push, theory, angle = helix(LINK)
    name = f"helix of {np.degrees(angle):.0f}° in a straight tube, links of "
    name += f"{1e3 * LINK:g} mm: push"
    yield Check.deviation(name, push, theory, HELIX_BOUND, "N")


def long_links() -> float:
    """Deviation (%) of the push force of a helix with the links of the tasks."""
    push, theory, _ = helix(NavigationConfig().shaft_link)
    return 100 * (push / theory - 1)
