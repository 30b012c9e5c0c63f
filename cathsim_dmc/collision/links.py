"""Links of devices in MuJoCo's structs, read for the laws; compiled."""

import math

import mujoco

from cathsim_dmc.collision.native import data_field, model_field, numbers, word
from cathsim_dmc.collision.table import MIDDLE
from cathsim_dmc.compiled import compiled, inlined
from cathsim_dmc.laws.contact import (
    contact_law,
    end_caps,
    looks_ahead,
    sweep_of,
    swept,
)
from cathsim_dmc.laws.places import Capsule
from cathsim_dmc.laws.vectors import into

_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)


@inlined
def seen_from(data, geom, place):
    """Point (3) m of the world, in the frame of a geom."""
    centre = data_field(data, "geom_xpos")[geom]
    apart = (place[0] - centre[0], place[1] - centre[1], place[2] - centre[2])
    return into(data_field(data, "geom_xmat")[geom], apart)


@inlined
def _caps(model, data, geom, half_length):
    """Which end caps of a link collide; see `laws.contact.end_caps`."""
    body = model_field(model, "geom_bodyid")[geom]
    if model_field(model, "body_parentid")[body] == 0 or half_length == 0.0:
        return (True, True)
    centre = data_field(data, "geom_xpos")[geom]
    turned = data_field(data, "geom_xmat")[geom]
    axis = (turned[2], turned[5], turned[8])
    return end_caps(centre, axis, half_length, data_field(data, "xpos")[body])


@inlined
def is_capsule(model, geom):
    """Whether a link is a capsule, not a sphere."""
    return model_field(model, "geom_type")[geom] == _CAPSULE


@inlined
def capsule_of(model, data, entry, geoms):
    """`Capsule` of a link, in the frame of a carrier's field.

    Args:
        model: Address of `mjModel`.
        data: Address of `mjData`.
        entry: Address of the field's entry.
        geoms: Link and carrier.
    """
    link, carrier = geoms
    size = model_field(model, "geom_size")[link]
    half_length = size[1] if is_capsule(model, link) else 0.0
    turns, middle = data_field(data, "geom_xmat"), numbers(word(entry + MIDDLE))
    apart = seen_from(data, carrier, data_field(data, "geom_xpos")[link])
    local = (middle[0] + apart[0], middle[1] + apart[1], middle[2] + apart[2])
    turned = turns[link]
    axis = into(turns[carrier], (turned[2], turned[5], turned[8]))
    return Capsule(local, axis, half_length, _caps(model, data, link, half_length))


@inlined
def is_finite(capsule):
    """Whether the position and the axis of a capsule are finite."""
    local, axis = capsule.centre, capsule.axis
    return math.isfinite(local[0] + local[1] + local[2] + axis[0] + axis[1] + axis[2])


@inlined
def law_of(model, wall, geom, margin):
    """The law of a link and a wall; see `laws.contact.contact_law`."""
    radius = model_field(model, "geom_size")[geom, 0]
    impedance = model_field(model, "geom_solimp")[geom, 0]
    reference = model_field(model, "geom_solref")[geom, 0]
    return contact_law(wall, radius, margin, impedance, reference)


@compiled
def _swept(model, data, geom):
    """Motion of a geom in this physics step; see `laws.contact.swept`."""
    body = model_field(model, "geom_bodyid")[geom]
    parents = model_field(model, "body_parentid")
    counts = model_field(model, "body_dofnum")
    while body > 0 and counts[body] == 0:
        body = parents[body]
    if body == 0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    about = data_field(data, "subtree_com")[model_field(model, "body_rootid")[body]]
    return swept(
        model_field(model, "dof_parentid"),
        data_field(data, "cdof"),
        data_field(data, "qvel"),
        model_field(model, "body_dofadr")[body] + counts[body] - 1,
        data_field(data, "geom_xpos")[geom],
        about,
        model_field(model, "opt.timestep"),
    )


@inlined
def sweep(model, data, geoms, capsule, law):
    """Motion of a link in this physics step; see `laws.contact.sweep_of`."""
    travel, turn = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if looks_ahead(law):
        travel, turn = _swept(model, data, geoms[0])
        frame = data_field(data, "geom_xmat")[geoms[1]]
        travel, turn = into(frame, travel), into(frame, turn)
    return sweep_of(capsule, law, travel, turn)


@compiled
def is_in_box(model, data, geom, place):
    """Whether a point (3) of the world is in the box of a geom; False for geom -1."""
    if geom < 0:
        return False
    x, y, z = seen_from(data, geom, place)
    size = model_field(model, "geom_size")[geom]
    return abs(x) < size[0] and abs(y) < size[1] and abs(z) < size[2]
