"""A capsule, and the places along its axis that touch a wall."""

from typing import Any, NamedTuple


class Capsule(NamedTuple):
    """A link of a device, in the frame of a wall; a sphere has half length 0.

    Attributes:
        centre: (3) m.
        axis: (3) unit vector.
        half_length: Half the length of the cylindrical part, m.
        caps: (2) whether the end caps at -half_length and half_length collide.
    """

    centre: Any
    axis: Any
    half_length: Any
    caps: Any


class Places(NamedTuple):
    """The places of a capsule that are nearest to the wall, two at most.

    Attributes:
        found: Number of places, 0 to 2.
        first, second: Positions along the axis from the centre, m.
        first_clearance, second_clearance: Distance of the axis from the wall there, m.
    """

    found: Any
    first: Any
    first_clearance: Any
    second: Any
    second_clearance: Any
