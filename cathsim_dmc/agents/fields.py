"""Values of settings: refused by the name of the field, with what is allowed."""

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal

MAX_INTEGER = 2**62


class ConfigError(ValueError):
    """A hyper-parameter is outside what is allowed, or contradicts another."""


def require(condition: bool, name: str, given: object, allowed: str) -> None:
    """Raise ConfigError naming the field, what was given and what is allowed."""
    if not condition:
        raise ConfigError(f"{name}={given!r} is not allowed: {name} must be {allowed}.")


def positive(default: Any) -> Any:
    """A field greater than zero; None passes where its type allows it."""
    return _checked(default, lambda value: value > 0, "positive")


def within(default: Any, low: float, high: float = math.inf, ends: str = "[]") -> Any:
    """A field in an interval, whose `ends` belong to it ("[]") or not ("()")."""

    def fits(value: float) -> bool:
        above = value > low if ends[0] == "(" else value >= low
        return above and (value < high if ends[1] == ")" else value <= high)

    bounds = f"in {ends[0]}{low:g}, {high:g}{ends[1]}"
    return _checked(default, fits, bounds if high < math.inf else f">= {low:g}")


def _checked(default: Any, fits: Callable[[Any], bool], allowed: str) -> Any:
    return dataclasses.field(default=default, metadata={"check": (fits, allowed)})


def check_fields(config: Any) -> None:
    """Raise ConfigError unless the fields of a dataclass have their types and bounds.

    Lists become tuples. The bounds of a base class hold in its subclasses.
    """
    for name, kind in typing.get_type_hints(type(config)).items():
        if typing.get_origin(kind) is ClassVar:
            continue
        value = getattr(config, name)
        value = dict(value) if isinstance(value, Mapping) else tuples(value)
        require_type(name, value, kind)
        object.__setattr__(config, name, value)
        for base in type(config).__mro__:
            field = getattr(base, "__dataclass_fields__", {}).get(name)
            if field is None or value is None or "check" not in field.metadata:
                continue
            fits, allowed = field.metadata["check"]
            whole = isinstance(value, int) and allowed == "positive"
            require(
                fits(value), name, value, "a positive integer" if whole else allowed
            )


_KINDS = {
    int: "an integer below 2**62",
    float: "a finite number",
    str: "a string",
    bool: "true or false",
    type(None): "None",
}


def require_type(name: str, value: object, kind: Any) -> None:
    """Raise ConfigError unless a value is of an annotated type."""
    require(_fits(value, kind), name, value, _description(kind))


def _fits(value: object, kind: Any) -> bool:
    """Whether a value is of an annotated type; of numbers only finite ones."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return any(value == choice and isinstance(value, str) for choice in arguments)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, argument) for argument in arguments)
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(v, arguments[0]) for v in value)
    if origin is Mapping:
        return isinstance(value, Mapping) and all(
            isinstance(name, str) and (arguments[1] is Any or _fits(one, arguments[1]))
            for name, one in value.items()
        )
    if type(value) is int and abs(value) > MAX_INTEGER:
        return False
    if kind is float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            return False
        return math.isfinite(value)
    # A bool is an int to Python, but no number of anything.
    return type(value) is kind


def _description(kind: Any) -> str:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return "one of " + ", ".join(map(repr, arguments))
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_description(argument) for argument in arguments)
    if origin is tuple:
        return f"a list, each entry {_description(arguments[0])}"
    if origin is Mapping and arguments[1] is not Any:
        return f"names, each with {_description(arguments[1])}"
    return _KINDS.get(kind, "an object of settings")


def tuples(value: Any) -> Any:
    """Lists as tuples, at every depth."""
    if isinstance(value, list | tuple):
        return tuple(tuples(one) for one in value)
    return value
