"""A capsule, and the places along its axis that touch a wall."""

from typing import Any, NamedTuple


class Capsule(NamedTuple):
    """A link of a device, in the frame of a wall. A sphere has no length.

    Attributes:
        centre: (3) m.
        axis: (3) unit vector.
        half_length: m, half its length without the end caps.
        caps: (2) whether the end caps at -half_length and half_length collide.
    """

    centre: Any
    axis: Any
    half_length: Any
    caps: Any


class Places(NamedTuple):
    """The places of a capsule that are nearest to the wall, two at most.

    Attributes:
        found: How many there are.
        first, second: m along the axis from the centre.
        first_clearance, second_clearance: Distance of the axis from the wall there, m.
    """

    found: Any
    first: Any
    first_clearance: Any
    second: Any
    second_clearance: Any
