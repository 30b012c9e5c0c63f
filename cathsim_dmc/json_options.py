"""Options as values of JSON."""

import dataclasses
import json
import os
import re
from collections.abc import Mapping
from typing import Any

import numpy as np


class Constant(dict[str, Any]):
    """A mapping that cannot be changed; JSON, pickles and copies take it."""

    def __reduce__(self):
        return type(self), (dict(self),)

    def _unchanged(self, *_: Any, **__: Any) -> Any:
        raise TypeError(f"{dict(self)} cannot be changed; change a copy, dict(...)")

    _never: Any = _unchanged  # of any signature
    __setitem__ = __delitem__ = __ior__ = _never
    update = pop = popitem = clear = setdefault = _never


def split(given: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Splits options into JSON values and the objects that JSON cannot hold."""
    plain, objects = dict[str, Any](), dict[str, Any]()
    for name, value in given.items():
        try:
            plain[name] = json.loads(json.dumps(value, default=_as_plain))
        except (TypeError, ValueError):
            objects[name] = value
    return plain, objects


def as_texts(given: Mapping[str, Any]) -> dict[str, Any]:
    """Returns options as they are read from JSON, objects among them as texts."""
    plain, objects = split(given)
    return plain | json.loads(json.dumps(objects, default=_as_text))


def _as_text(value: Any) -> str:
    """Returns the representation without addresses, which differ between processes.

    An object whose class has no representation of its own is told by its attributes.
    """
    text, plain = repr(value), type(value).__repr__ is object.__repr__
    if plain and (own := getattr(value, "__dict__", {})):
        text += f" {own}"
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)


def _as_plain(value: Any) -> Any:
    """Returns plain values that make an option again; TypeError if none do.

    A mapping makes options of this package, whose fields all have defaults, but no
    device, no anatomy and no object of a user's class, such as an effect.
    """
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        raise TypeError
    if type(value).__module__.partition(".")[0] != __package__:
        raise TypeError
    if any(
        field.default is field.default_factory is dataclasses.MISSING
        for field in dataclasses.fields(value)
    ):
        raise TypeError
    return dataclasses.asdict(
        value, dict_factory=lambda pairs: {k: v for k, v in pairs if v is not None}
    )
