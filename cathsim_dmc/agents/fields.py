"""Values of settings: refused by the name of the field, with what is allowed."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from cathsim_dmc import bounds

_MOST = 2**62


class ConfigError(ValueError):
    """A hyper-parameter is outside what is allowed, or contradicts another."""


def require(condition: bool, name: str, given: object, allowed: str) -> None:
    """Raise ConfigError naming the field, what was given and what is allowed."""
    if not condition:
        raise ConfigError(f"{name} is {bounds.shown(given)}; it must be {allowed}")


def positive(default: Any, **limits: Any) -> Any:
    """A field of numbers greater than zero, with limits as for `within`."""
    return dataclasses.field(default=default, metadata={"positive": True, **limits})


def within(default: Any, **limits: Any) -> Any:
    """A field of numbers in a closed interval, from `low` to `high`."""
    return dataclasses.field(default=default, metadata=limits)


def check_fields(config: Any) -> None:
    """Raise ConfigError unless the fields of a dataclass have their types and bounds.

    Lists become tuples. The bounds of a base class hold in its subclasses.
    """
    for name, kind in typing.get_type_hints(type(config)).items():
        if typing.get_origin(kind) is ClassVar:
            continue
        limits: dict[str, Any] = {}
        for base in reversed(type(config).__mro__):
            field = getattr(base, "__dataclass_fields__", {}).get(name)
            limits |= {} if field is None else field.metadata
        value = checked(name, getattr(config, name), kind, **limits)
        object.__setattr__(config, name, value)


def checked(name: str, value: Any, kind: Any, **limits: Any) -> Any:
    """A value of an annotated type, lists as tuples; or ConfigError."""
    try:
        return _checked(name, value, kind, limits)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _checked(name: str, value: Any, kind: Any, limits: dict[str, Any]) -> Any:
    origin, kinds = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if value is None and types.NoneType in kinds:
            return None
        kinds = [one for one in kinds if one is not types.NoneType]
        # Of a name or names, the first is the name.
        return _checked(name, value, kinds[-(not isinstance(value, str))], limits)
    if origin is Literal:
        return bounds.choice(name, value, kinds)
    if origin is Mapping:
        values = bounds.options(name, bounds.instance(name, value, Mapping))
        if kinds[1] is Any:
            return values
        return {
            key: _checked(f"{name}[{key!r}]", one, kinds[1], limits)
            for key, one in values.items()
        }
    if origin is tuple:
        if not isinstance(value, list | tuple) or not value:
            bounds.refuse(name, value, "a list with one entry or more")
        return tuple(_checked(name, one, kinds[0], limits) for one in value)
    if kind is int:
        low = 1 if "positive" in limits else limits.get("low", -_MOST)
        return bounds.whole(name, value, low, limits.get("high", _MOST))
    if kind is float:
        return bounds.number(name, value, **limits)
    if kind is bool:
        return bounds.switch(name, value)
    if not isinstance(value, str) or not value:
        bounds.refuse(name, value, "a text")
    return value
