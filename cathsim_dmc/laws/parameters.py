"""Declaration of the parameters of a law: a NamedTuple of numbers and arrays.

A field without a default is a number, one with an `Array` an array:

    class Wind(NamedTuple):
        force: Any = Array(3)  # N/m
        lengths: Any = Array("links")  # m

`physics.effects` lays them out in memory, one set for each simulation.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any


class Array:
    """An array among the parameters of a law, float64.

    Attributes:
        shape: Numbers, or names of sizes of the chain: "links", "joints", "devices",
            "nodes".
    """

    def __init__(self, *shape: int | str):
        """Takes the shape; only its first axis may be named in a compiled law."""
        self.shape = shape


def shapes(kind: Any, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
    """Shapes of the fields of a NamedTuple of parameters, () of a number.

    Args:
        kind: The class.
        sizes: The named sizes.
    """
    declared = kind._field_defaults
    return {
        name: _shape(declared[name].shape, sizes) if name in declared else ()
        for name in kind._fields
    }


def _shape(shape: Sequence[int | str], sizes: Mapping[str, int]) -> tuple[int, ...]:
    return tuple(sizes[axis] if isinstance(axis, str) else axis for axis in shape)


def total(kind: Any, sizes: Mapping[str, int]) -> int:
    """How many numbers the fields of a NamedTuple of parameters have together."""
    return sum(math.prod(shape) for shape in shapes(kind, sizes).values())
