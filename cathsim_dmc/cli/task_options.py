"""Options of a task on the command line, from the fields of `NavigationConfig`."""

import dataclasses
import functools
import json
import operator
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import docstring_parser
from tyro import conf

_SINGLE = (str, int, float, bool)
_JSON = " As JSON; by default the task's own."
_CONSTANTS = {"true", "false", "null", "True", "False"}  # of JSON, or meant so
_OWN = " By default the task's own."
_OBJECTS = frozenset({"effects"})  # Python objects: no text stands for them


@functools.cache
def task_kind(omitted: frozenset[str]) -> type:
    """A dataclass of the options of a task, None by default.

    An option with parts, such as a mapping, is a text with JSON.

    Args:
        omitted: Names of options that the command has no use for.
    """
    from cathsim_dmc.tasks.config import NavigationConfig
    from cathsim_dmc.tasks.objectives import Cannulation

    of_objective = {"reward": Mapping, "goal_radius": float}
    kinds = typing.get_type_hints(NavigationConfig) | of_objective
    helps = field_helps(NavigationConfig) | _helps(Cannulation.to)
    fields = []
    for name, kind in kinds.items():
        if name in omitted | _OBJECTS:
            continue
        either, text = _single(kind), _OWN
        if _has_parts(kind):
            either, text = str, _JSON
        option = Annotated[either | None, conf.arg(help=helps[name] + text)]
        fields.append((name, option, dataclasses.field(default=None)))
    kind = dataclasses.make_dataclass("TaskOptions", fields, kw_only=True, frozen=True)
    kind.__doc__ = "Options of the task."
    return kind


def given(options: Any) -> dict[str, Any]:
    """The options that were given, by name.

    Args:
        options: Instance of a class of `task_kind`.

    Raises:
        ValueError: an option with parts is no JSON.
    """
    from cathsim_dmc.tasks.config import NavigationConfig

    kinds = typing.get_type_hints(NavigationConfig) | {"reward": Mapping}
    values = {name: value for name, value in vars(options).items() if value is not None}
    for name, value in values.items():
        if _has_parts(kinds.get(name, float)):
            values[name] = _parsed(name, value, str in _alternatives(kinds.get(name)))
    return values


def _parsed(name: str, text: str, may_be_text: bool) -> Any:
    if may_be_text and text.isidentifier() and text not in _CONSTANTS:
        return text
    try:
        return json.loads({"True": "true", "False": "false"}.get(text, text))
    except ValueError as error:
        flag = f"--{name.replace('_', '-')}"
        raise ValueError(
            f"{flag} is {text!r}: {error}; give JSON, such as true, [0, 0.5] or "
            '{"force": -1}'
        ) from error


def _alternatives(kind: Any) -> tuple[Any, ...]:
    """Types that a value may have, for a union more than one."""
    union = isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union
    return typing.get_args(kind) if union else (kind,)


def _single(kind: Any) -> Any:
    """Those types of a field that are single values, as a union."""
    kinds = [one for one in _alternatives(kind) if one in _SINGLE]
    return functools.reduce(operator.or_, kinds) if kinds else str


def _has_parts(kind: Any) -> bool:
    origins = [typing.get_origin(one) or one for one in _alternatives(kind)]
    return bool({Mapping, Sequence} & {one for one in origins if one is not str})


def field_helps(kind: type) -> dict[str, str]:
    """Descriptions of the fields in the docstrings of a dataclass and its bases."""
    helps: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if dataclasses.is_dataclass(one):
            helps |= _helps(one)
    return helps


def _helps(documented: Any) -> dict[str, str]:
    parameters = docstring_parser.parse(documented.__doc__ or "").params
    return {p.arg_name: " ".join((p.description or "").split()) for p in parameters}
