"""Quantities on the screen of `cathsim play`."""

from typing import Any

import numpy as np

# Colours of the force bar: mean tip force of trained navigation, the budget of safe
# learning and the proposed rupture threshold, N.
FORCE_LEVELS = ((0.15, "green"), (0.85, "orange"), (1.5, "red"))


def lines(task: Any) -> list[tuple[str, str]]:
    """Name and value of every quantity after a control step or a reset."""
    state, wall = task.readings, task.wall_force
    distance = float(np.linalg.norm(state.head - task.goal_position))
    return [
        ("goal", task.scene.goal.name),
        ("distance", _millimetres(distance)),
        *_inserted(task),
        ("push force", _newton(state.push_force)),
        ("wall force, sum", _newton(wall.sum)),
        ("largest contact", _newton(wall.max)),
        ("peak in the step", _newton(wall.peak_max)),
    ]


def _inserted(task: Any) -> list[tuple[str, str]]:
    """How far each device is in and, where it is turned at its base, by how much."""
    devices = task.devices
    if devices is None:
        return [("inserted", _millimetres(task.readings.insertion))]
    rows = []
    for name, way, angle in zip(
        task.scene.catheter.device_names,
        devices.insertion,
        np.degrees(devices.rotation),
        strict=True,
    ):
        rows += [(name, _millimetres(way)), ("turned", f"{angle:5.0f}°")]
    return rows


def _millimetres(way: float) -> str:
    return f"{float(way) * 1e3:5.1f} mm"


def _newton(force: float) -> str:
    return f"{round(float(force), 3) + 0.0:6.3f} N"  # no minus before zero


def colour(force: float) -> str:
    """Colour of a contact force in N."""
    for level, name in FORCE_LEVELS:
        if force <= level:
            return name
    return FORCE_LEVELS[-1][1]
