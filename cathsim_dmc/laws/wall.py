"""The wall of a lumen or of a bore: clearance and normal at a point."""

from typing import Any, NamedTuple

from cathsim_dmc.compiled import inlined, law
from cathsim_dmc.laws.bore import bore_clearance
from cathsim_dmc.laws.field import FieldArrays, field_clearance, field_gradient
from cathsim_dmc.laws.vectors import along, length

_STEP = 0.25e-3  # m, to each side, of the differences that give the normal
_LEAST = 1e-12  # length below which a gradient has no direction


class Wall(NamedTuple):
    """A wall in its own frame.

    Attributes:
        is_bore: Whether `line` describes it; otherwise `field` does.
        field: `field.FieldArrays` of a lumen.
        line: Array of a bore, see `bore`.
    """

    is_bore: Any
    field: FieldArrays
    line: Any


@inlined
def clearance(wall, point):
    """Clearance (m) at a point (3) m, > 0 inside, `FREE` past open ends."""
    if wall.is_bore:
        return bore_clearance(wall.line, point)[0]
    return field_clearance(wall.field, point)


@inlined
def clearance_along(wall, capsule, t):
    """Clearance (m) at the place t (m) along a capsule's axis."""
    return clearance(wall, along(capsule.centre, capsule.axis, t))


@law
def normal_at(wall, point):
    """Unit normal (3) away from the wall at a point (3) m; zeros if undefined.

    In a lumen it is the direction of the depth's central differences over 0.25 mm to
    each side.
    """
    if wall.is_bore:
        way = bore_clearance(wall.line, point)[1]
    else:
        way = field_gradient(wall.field, point, _STEP)
    norm = length(way)
    if norm < _LEAST:
        return (0.0, 0.0, 0.0)
    return (way[0] / norm, way[1] / norm, way[2] / norm)


@inlined
def is_straight_bore(wall):
    """Whether a wall is a bore of one segment."""
    return wall.is_bore and wall.line[0] == 2.0
