"""Whether a device is one that a policy can drive, by what it announces of itself."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from cathsim_dmc import bounds
from cathsim_dmc.bridge.messages import BridgeError

_NEAR = 0.05  # of a number, to which periods and scales agree
_WELCOME = ("action", "observation")


class Interface(NamedTuple):
    """What a policy was trained with.

    Attributes:
        period: Duration of a control step, s.
        action: See `interface.action_table`.
        observation: See `interface.observation_table`.
    """

    period: float
    action: Sequence[Mapping[str, Any]]
    observation: Sequence[Mapping[str, Any]]


def sizes(wanted: Interface, welcome: Mapping[str, Any]) -> list[str]:
    """What forbids to drive a device at all: arrays that lack or have other sizes.

    Args:
        welcome: What a device says of itself.

    Returns:
        A phrase for each, empty if there is none.

    Raises:
        BridgeError: the welcome holds no tables.
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
    """What a device announces otherwise than a policy was trained with.

    What it does not announce, or as None, is not looked at. Arguments and result as of
    `sizes`, of which there must be none.
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
    """A unit without the signs between its parts: N·m, N m and Nm are one."""
    return unit.translate(dict.fromkeys(map(ord, " ·*⋅.")))


def _text(value: Any) -> str:
    if bounds.is_number(value):
        return f"{value:.4g}"
    return value[:80] if isinstance(value, str) else bounds.shown(value)
