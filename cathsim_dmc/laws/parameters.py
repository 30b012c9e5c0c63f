"""Declaration of the parameters of a law: a NamedTuple of numbers and arrays.

A field without a default is a scalar; a field with an `Array` is an array:

    class Wind(NamedTuple):
        force: Any = Array(3)  # N/m
        lengths: Any = Array("links")  # m

`physics.effects` allocates one set for each simulation.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any


class Array:
    """Declaration of an array parameter of a law, float64.

    Attributes:
        shape: Lengths of the axes, as numbers or names of sizes of the chain: "links",
            "joints", "devices", "nodes".
    """

    def __init__(self, *shape: int | str):
        """Sets the shape; in a compiled law only the first axis may be named."""
        self.shape = shape


def shapes(kind: Any, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
    """Shape of each field of a NamedTuple of parameters, () for a scalar.

    Args:
        kind: NamedTuple class.
        sizes: Sizes of the chain by name.

    Raises:
        ValueError: if `kind` is no NamedTuple class, a field has a default that is no
            `Array`, or a shape names an unknown size.
    """
    declared = getattr(kind, "_field_defaults", None)
    if declared is None or not all(isinstance(a, Array) for a in declared.values()):
        raise ValueError(
            f"the parameters of a law are {kind!r}; give a NamedTuple, whose fields "
            "have no default or an Array of cathsim_dmc.laws.parameters"
        )
    named = {each for array in declared.values() for each in array.shape}
    if odd := [one for one in named if isinstance(one, str) and one not in sizes]:
        raise ValueError(
            f"{kind.__name__} has arrays of {', '.join(sorted(odd))}; sizes are "
            f"numbers or of {', '.join(sizes)}"
        )
    lengths = [n for array in declared.values() for n in _shape(array.shape, sizes)]
    if not all(isinstance(n, int) and n > 0 for n in lengths):
        raise ValueError(
            f"{kind.__name__} has arrays of the lengths {lengths}; they must be whole "
            "numbers above 0, or names of sizes"
        )
    return {
        name: _shape(declared[name].shape, sizes) if name in declared else ()
        for name in kind._fields
    }


def _shape(shape: Sequence[int | str], sizes: Mapping[str, int]) -> tuple[int, ...]:
    return tuple(sizes[axis] if isinstance(axis, str) else axis for axis in shape)


def total(kind: Any, sizes: Mapping[str, int]) -> int:
    """Total number of scalars in a NamedTuple of parameters."""
    return sum(math.prod(shape) for shape in shapes(kind, sizes).values())
