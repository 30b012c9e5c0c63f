"""Checks of a user's effects: what they declare, and what they write."""

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc import bounds


def check_declared(effect: Any) -> None:
    """Raises ValueError unless the fields that an effect names exist.

    Args:
        effect: An `effects.Effect`.
    """
    name, model = type(effect).__name__, mujoco.MjModel.from_xml_string("<mujoco/>")
    owners = {
        "data_fields": mujoco.MjData(model),
        "model_fields": model,
        "step_fields": model,
        "state": None,
    }
    for kind, owner in owners.items():
        names = getattr(effect, kind)
        listed = isinstance(names, Sequence) and not isinstance(names, str)
        if not listed or not all(isinstance(one, str) for one in names):
            example = "_speed" if owner is None else "geom_friction"
            allowed = f"a tuple of names, such as ({example!r},)"
            bounds.refuse(f"{kind} of {name}", names, allowed)
        for one in names if owner is not None else ():
            if not isinstance(getattr(owner, one, None), np.ndarray):
                owned = type(owner).__name__
                like = difflib.get_close_matches(one, {*dir(owner)} - {one}, 3)
                closest = f"; similar are {', '.join(like)}" if like else ""
                raise ValueError(
                    f"{kind} of {name} has {one!r}, but mujoco.{owned} has no array of "
                    f"that name{closest}"
                )
    if apart := [one for one in effect.step_fields if one not in effect.model_fields]:
        raise ValueError(
            f"step_fields of {name} has {', '.join(apart)}, which model_fields lacks; "
            "name them in both"
        )


def check_state(effect: Any, name: str, count: int) -> None:
    """Raises ValueError unless a state that an effect names can be saved.

    Args:
        effect: An `effects.Effect`.
        name: Name of the attribute.
        count: Number of simulations.
    """
    value: Any = getattr(effect, name, None)
    array = isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    if not array or value.shape[:1] != (count,):
        is_now = bounds.shown(value) if hasattr(effect, name) else "missing"
        raise ValueError(
            f"the state {name!r} of {type(effect).__name__} is {is_now}; it must be "
            f"an array of numbers with a row for each of the {count} simulations, made "
            "in bind"
        )


def check_begun(effect: Any, indices: np.ndarray) -> None:
    """Raises ValueError unless what `restart` of an effect has written is finite.

    Args:
        effect: An `effects.Effect`, bound; it is one of a user.
        indices: (K,), simulations that have begun an episode.
    """
    name, world = type(effect).__name__, effect.world
    written = getattr(world.parameters, "_asdict", dict)()
    for parameter, values in written.items():
        _check_finite(f"parameter {parameter} of {name}", values[indices])
    for field in effect.model_fields:
        for index in indices.tolist():
            _check_finite(f"{field}, written by {name}", world.field(index, field))


def _check_finite(name: str, values: np.ndarray) -> None:
    if not np.isfinite(values).all():
        bounds.refuse(f"{name}, at the start of an episode,", values, "finite")


def check_conditions(effect: Any, given: Any) -> Mapping[str, float]:
    """Returns what `conditions` of an effect returns; ValueError unless numbers."""
    name = f"conditions of {type(effect).__name__}"
    if not isinstance(given, Mapping):
        bounds.refuse(name, given, "a mapping of names to numbers")
    for key, value in given.items():
        bounds.text(f"a name in {name}", key)
        bounds.number(f"{key} in {name}", value)
    return given


def check_action(effect: Any, action: Any, shape: tuple[int, ...]) -> None:
    """Raises ValueError unless `act` of an effect returns numbers (shape), finite."""
    name = f"act of {type(effect).__name__} returns"
    if action is None:
        raise ValueError(f"{name} None; return the action that takes effect")
    try:
        bounds.array("it", action, shape=shape)
    except ValueError as error:
        raise ValueError(
            f"{name} another value than the action that takes effect: {error}"
        ) from None
