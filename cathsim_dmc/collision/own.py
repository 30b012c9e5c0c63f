"""Recognition of simulations with effects of this package.

MuJoCo calls its callbacks for every model of a process. In a simulation with effects
the last number of `userdata` is the label of its layout. A table of the process holds
the layouts with the sizes of their models. Callbacks read nothing else of a model until
label and sizes match, and take every offset from the layout, not from the simulation.
"""

import numpy as np

from cathsim_dmc.collision.native import (
    address_of,
    data_field,
    longs,
    model_field,
    numbers,
    symbol,
    word,
)
from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.planes import MOST

# Words of a layout: its label, a float64 in [1, 2), then these sizes of its models:
SIZES = ("nuserdata", "nbody", "nq", "nv", "njnt", "ngeom")
# Addresses of the list of laws of each callback: their number, then for each law the
# address of its adapter and the offset of its parameters in `userdata`.
PASSIVE, CONTROL = 56, 64  # bytes from the layout
# Body of the first link, number of links and of joints (pairs of hinges); address of
# the geoms of the links, then of joints, positions and degrees of freedom of hinges.
LINK, LINKS, JOINTS, PLACES = range(72, 104, 8)
# Geoms of wall and bore of the sheath, and offset of the parameters of the motion in
# `userdata`; -1 for none.
WALL, BORE, MOTION = 104, 112, 120
# 1 + offset of the parameters of a law that has raised an error, negative if it has
# written a number that is not finite; 0 for none.
FAULT = 128
# Offset of the parameters of a compliant wall in `userdata`, -1 for none.
SHARING = 136
# Degree of freedom whose velocity is that of a moving wall, -1 for none.
CLOCK = 144
WORDS, CAPACITY, SPAN = 19, 1 << 12, 1 << 52
SYMBOL = "cathsim_layouts"
# Allocated before code that refers to the symbol is loaded.
TABLE = symbol(SYMBOL, WORDS * CAPACITY).reshape(CAPACITY, WORDS)


@compiled
def _agrees(model, layout):
    """Whether the sizes of a model match a layout."""
    return (
        model_field(model, "nuserdata") == word(layout + 8)
        and model_field(model, "nbody") == word(layout + 16)
        and model_field(model, "nq") == word(layout + 24)
        and model_field(model, "nv") == word(layout + 32)
        and model_field(model, "njnt") == word(layout + 40)
        and model_field(model, "ngeom") == word(layout + 48)
    )


@compiled
def layout_of(model, data):
    """Address of the layout of a simulation; 0 for a model of another package."""
    count = np.int64(model_field(model, "nuserdata"))
    if count < 1:
        return np.int64(0)
    label = data_field(data, "userdata")[count - 1]
    if not 1.0 <= label < 2.0:
        return np.int64(0)
    table, slot = address_of(SYMBOL), np.int64((label - 1.0) * SPAN) % CAPACITY
    for _ in range(CAPACITY):
        layout = table + 8 * WORDS * slot
        found = numbers(layout)[0]
        if found == label:
            return layout if _agrees(model, layout) else np.int64(0)
        if found == 0.0:
            return np.int64(0)
        slot = (slot + 1) % CAPACITY
    return np.int64(0)


@compiled
def motion_of(model, data):
    """Address of the layout of a simulation with a moving vessel; 0 otherwise."""
    layout = layout_of(model, data)
    return layout if layout != 0 and word(layout + MOTION) >= 0 else np.int64(0)


@compiled
def sharing_of(model, data, geom):
    """Offset in `userdata` of a link's MOST numbers of `laws.compliance.Sharing`.

    -1 if the simulation has no compliant wall, or the geom is no link.
    """
    layout = layout_of(model, data)
    if layout == 0 or word(layout + SHARING) < 0:
        return np.int64(-1)
    link = model_field(model, "geom_bodyid")[geom] - word(layout + LINK)
    if not 0 <= link < word(layout + LINKS):
        return np.int64(-1)
    if longs(word(layout + PLACES))[link] != geom:
        return np.int64(-1)
    return np.int64(word(layout + SHARING) + MOST * link)
