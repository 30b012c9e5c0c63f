"""Comparison of a device, by its welcome, with what a policy was trained with."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from cathsim_dmc import bounds
from cathsim_dmc.bridge.messages import BridgeError

_NEAR = 0.05  # relative tolerance of periods, scales and bounds
_WELCOME = ("action", "observation")


class Interface(NamedTuple):
    """Period, action and observation that a policy was trained with.

    Attributes:
        period: Duration of a control step, s.
        action: See `interface.action_table`.
        observation: See `interface.observation_table`.
    """

    period: float
    action: Sequence[Mapping[str, Any]]
    observation: Sequence[Mapping[str, Any]]


def sizes(wanted: Interface, welcome: Mapping[str, Any]) -> list[str]:
    """Lists the differences in size that rule out driving the device.

    Arrays that the device lacks are not listed.

    Args:
        welcome: Welcome of the device.

    Returns:
        A phrase for each difference, empty if there is none.

    Raises:
        BridgeError: an entry of the action or observation is not an object.
    """
    for name in _WELCOME:
        if not all(isinstance(one, Mapping) for one in welcome[name]):
            text = f"{name} of welcome is {bounds.shown(welcome[name])}; it must list "
            text += "an object for each, with its name or key"
            raise BridgeError("bad_message", text)
    there = {one["key"]: one for one in welcome["observation"]}
    wrong = []
    for own in wanted.observation:
        given, shape = there.get(own["key"]), [*own["shape"]]
        if given is not None and [*given["shape"]] != shape:
            wrong.append(f"{own['key']} has shape {[*given['shape']]}, not {shape}")
        elif given and (given["dtype"] == "uint8") != (own["dtype"] == "uint8"):
            wrong.append(f"{own['key']} is {given['dtype']}, not {own['dtype']}")
    if (count := len(welcome["action"])) != len(wanted.action):
        wrong.append(f"an action has {count} entries, not {len(wanted.action)}")
    return wrong


def meanings(wanted: Interface, welcome: Mapping[str, Any]) -> list[str]:
    """Lists the differences in period, names, units, scales and bounds.

    Fields that the device leaves out or announces as None are not compared. Arguments
    and result as for `sizes`, which must have found no difference.
    """
    wrong = []
    period = welcome.get("period", wanted.period)
    if not _same(period, wanted.period):
        wrong.append(f"period is {_text(period)} s, not {wanted.period:g} s")
    for place, (own, given) in enumerate(
        zip(wanted.action, welcome["action"], strict=True)
    ):
        for field in ("name", "unit", "scale", "low", "high"):
            value, wants = given.get(field), own[field]
            if value is not None and not _same(value, wants):
                which = f"{field} of action {place} ({own['name']})"
                wrong.append(f"{which} is {_text(value)}, not {_text(wants)}")
    there = {one["key"]: one for one in welcome["observation"]}
    for own in wanted.observation:
        unit = there[own["key"]].get("unit")
        if unit is not None and not _same(unit, own["unit"]):
            wrong.append(f"unit of {own['key']} is {_text(unit)}, not {own['unit']}")
    return wrong


def _same(given: Any, own: Any) -> bool:
    if isinstance(own, str):
        return isinstance(given, str) and _plain(given) == _plain(own)
    return bounds.is_number(given) and math.isclose(given, own, rel_tol=_NEAR)


def _plain(unit: str) -> str:
    """Returns a unit without separators: N·m, N m and Nm become equal."""
    return unit.translate(dict.fromkeys(map(ord, " ·*⋅.")))


def _text(value: Any) -> str:
    if bounds.is_number(value):
        return f"{value:.4g}"
    return value[:80] if isinstance(value, str) else bounds.shown(value)
