"""Parameters of laws in `userdata`, as the NamedTuples that compiled laws take."""

from typing import Any

from numba.core import types
from numba.extending import overload

from cathsim_dmc.laws.parameters import Array


def unpacked(kind, row, links, joints):
    """Parameters of a simulation: a NamedTuple of numbers and views.

    Args:
        kind: Class of the NamedTuple, see `laws.parameters`.
        row: (P or more,) float64, the values of its fields one after the other.
        links: Number of links.
        joints: Number of joints of two hinges.
    """


@overload(unpacked)
def _unpacked(kind, row, links, joints):
    if not isinstance(kind, types.NamedTupleClass):
        return None
    fields, place = [], "0"
    for name in kind.instance_class._fields:
        array = kind.instance_class._field_defaults.get(name)
        if not isinstance(array, Array):
            fields.append(f"row[{place}]")
            place += " + 1"
            continue
        shape = ", ".join(map(str, array.shape))
        size = " * ".join(map(str, array.shape))
        fields.append(f"row[{place} : {place} + {size}].reshape(({shape},))")
        place += f" + {size}"
    source = f"def make(kind, row, links, joints): return kind({', '.join(fields)})"
    made: dict[str, Any] = {}
    exec(source, made)  # noqa: S102  numba takes no loop over fields of several types
    return made["make"]
