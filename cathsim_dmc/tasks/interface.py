"""Actions and observations of a task as JSON-able tables, for other programs."""

from typing import Any

from cathsim_dmc.entities.chain import MAX_PUSH_SPEED, MAX_ROTATION_SPEED, Chain
from cathsim_dmc.tasks import observations
from cathsim_dmc.tasks.navigation import Navigation

_BOUNDS = {"low": -1.0, "high": 1.0}


def action_table(chain: Chain) -> list[dict[str, Any]]:
    """Name, meaning, unit and scale of each entry of an action.

    Returns:
        A dictionary for each of the A entries: "name", "low", "high", "meaning", and
        "scale", the value of the action 1 in "unit".
    """
    motors = {one.name: one for one in getattr(chain, "tip_motors", ())}
    rows = []
    for place, name in enumerate(chain.action_names):
        if name in motors:
            torque = float(motors[name].gainprm[0])
            meaning = "torque of a tip motor, proximal to distal, through its lag"
            row = {"meaning": meaning, "scale": torque, "unit": "N·m"}
        elif place in chain.translations:
            meaning = "speed of the base along the device, positive is forward"
            row = {"meaning": meaning, "scale": MAX_PUSH_SPEED, "unit": "m/s"}
        else:
            meaning = "speed of rotation of the base about its distal axis"
            row = {"meaning": meaning, "scale": MAX_ROTATION_SPEED, "unit": "rad/s"}
        rows.append({"name": name, **_BOUNDS, **row})
    return rows


def observation_table(task: Navigation) -> list[dict[str, Any]]:
    """Key, shape, type, unit and meaning of each entry of an observation, by key."""
    entries = {one.key: one for one in observations.entries(task.observation_names)}
    return [
        {
            "key": key,
            "shape": list(spec.shape),
            "dtype": str(spec.dtype),
            "unit": entries[key].unit,
            "meaning": entries[key].meaning,
        }
        for key, spec in sorted(task.observation_specs.items())
    ]
