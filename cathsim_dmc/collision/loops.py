"""Capsules and spheres against walls at rest, in MuJoCo's collision table.

The law is `laws.contact`. MuJoCo calls `of_link`, which reads the link and the wall
from MuJoCo's structs and writes the contacts into MuJoCo's buffer. `moving` has the
function for walls that move, which takes longer to compile.
"""

import numpy as np

from cathsim_dmc.collision.links import (
    capsule_of,
    is_capsule,
    is_finite,
    law_of,
    sweep,
)
from cathsim_dmc.collision.native import (
    address_of,
    call_collision,
    call_error,
    callback,
    data_field,
    numbers,
    stacked,
    word,
)
from cathsim_dmc.collision.own import sharing_of
from cathsim_dmc.collision.table import (
    ERROR,
    MESSAGE,
    OF_CAPSULE,
    OF_SPHERE,
    SYMBOL,
    entry_of,
    key_of,
    wall_of,
)
from cathsim_dmc.compiled import compiled, inlined
from cathsim_dmc.laws.capsule import SAMPLES
from cathsim_dmc.laws.contact import CONTACT, Scratch, contacts, world_contact
from cathsim_dmc.laws.planes import MOST, PLANES

_RAW = 80  # bytes of a contact for MuJoCo: distance, position and frame


@inlined
def write(model, data, geoms, law, found, count, raw):
    """Writes contacts into MuJoCo's buffer; returns their number.

    Args:
        model: Address of `mjModel`.
        data: Address of `mjData`.
        geoms: Link and carrier.
        law: `laws.contact.Law`.
        found: (MOST, CONTACT), contacts in the frame of the wall.
        count: Number of contacts.
        raw: Address of MuJoCo's buffer of contacts.
    """
    centre = data_field(data, "geom_xpos")[geoms[0]]
    turned = data_field(data, "geom_xmat")[geoms[0]]
    frame = data_field(data, "geom_xmat")[geoms[1]]
    axis = (turned[2], turned[5], turned[8])
    if law.compliant:
        first, user = sharing_of(model, data, geoms[0]), data_field(data, "userdata")
        if first >= 0:
            for n in range(count):
                user[first + n] = found[n, 5]
    for n in range(count):
        distance, place, towards = world_contact(found[n], law, centre, axis, frame)
        contact = numbers(raw + _RAW * n)
        contact[0] = distance
        for k in range(3):
            contact[1 + k], contact[4 + k], contact[7 + k] = place[k], towards[k], 0.0
    return np.int32(count)


@compiled
def at_rest(model, data, raw, geoms, margin, entry):
    """Writes the contacts of a link with a wall at rest; returns their number."""
    wall = wall_of(entry)
    capsule = capsule_of(model, data, entry, geoms)
    # A place that is not finite is in no cell; MuJoCo's checks report such a state.
    if not is_finite(capsule):
        return np.int32(0)
    law = law_of(model, wall, geoms[0], margin)
    step = sweep(model, data, geoms, capsule, law)
    scratch = Scratch(stacked(1, SAMPLES)[0], stacked(PLANES, 4))
    found = stacked(MOST, CONTACT)
    count = contacts(wall, capsule, law, step, scratch, found)
    return write(model, data, geoms, law, found, count, raw)


@compiled
def collide(model, data, raw, geoms, margin):
    """Writes the contacts of a link with a box or a carrier; returns their number."""
    table, (link, box) = address_of(SYMBOL), geoms
    key = key_of(model, box)
    if key == 0:
        place = OF_CAPSULE if is_capsule(model, link) else OF_SPHERE
        old = word(table + place)
        return call_collision(old, model, data, raw, link, box, margin)
    entry = entry_of(table, key)
    if entry == 0:
        call_error(word(table + ERROR), word(table + MESSAGE), box)
        return np.int32(0)
    return at_rest(model, data, raw, geoms, margin, entry)


@callback("int32(int64, int64, int64, int32, int32, float64)")
def of_link(model, data, contacts, geom1, geom2, margin):
    """Entry of MuJoCo's collision table for a capsule or a sphere and a box."""
    return collide(model, data, contacts, (geom1, geom2), margin)
