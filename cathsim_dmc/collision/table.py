"""The table of a process's fields, for compiled functions."""

import numpy as np

from cathsim_dmc.collision.native import (
    model_field,
    numbers,
    shorts,
    symbol,
    wholes,
    word,
)
from cathsim_dmc.compiled import inlined
from cathsim_dmc.laws.field import FieldArrays
from cathsim_dmc.laws.wall import Wall

# Byte offsets in the head of the table: the functions that this package has replaced in
# MuJoCo's collision table, `mju_error` and its message.
OF_CAPSULE, OF_SPHERE, ERROR, MESSAGE = range(0, 32, 8)
HEAD = 4  # words
# Words of an entry: key, kind, addresses of the carrier's centre in the field's frame,
# of head, coarse lattice, bricks and samples of a lumen or of the line of a bore, and
# of the lattice of its motion.
ENTRY, CAPACITY = 8, 1 << 14
KIND, MIDDLE, ARRAYS, MOTION_ENTRY = 8, 16, 24, 56  # bytes from the entry
LUMEN, BORE = 0, 1
# Values of `geom_user` of a carrier: the mark, then the key of its field in three
# parts, small enough that a printed model file keeps every digit.
USER, MARK, PART = 4, 730155.0, 1 << 20
SYMBOL = "cathsim_fields"
# Allocated before code that refers to the symbol is loaded.
TABLE = symbol(SYMBOL, HEAD + ENTRY * CAPACITY)


@inlined
def entry_of(table, key):
    """Address of the entry with a key, 0 for none."""
    slot = key % CAPACITY
    for _ in range(CAPACITY):
        at = table + 8 * (HEAD + ENTRY * slot)
        found = word(at)
        if found == key:
            return at
        if found == 0:
            return 0
        slot = (slot + 1) % CAPACITY
    return 0


@inlined
def key_of(model, geom):
    """Key of the field that a geom carries; 0 for none."""
    stride = model_field(model, "nuser_geom")
    if stride < USER:
        return np.int64(0)
    user = model_field(model, "geom_user")[stride * geom :]
    if user[0] != MARK:
        return np.int64(0)
    key = (np.int64(user[1]) * PART + np.int64(user[2])) * PART
    return key + np.int64(user[3])


@inlined
def wall_of(entry):
    """The wall of an entry, for the laws: `laws.wall.Wall`."""
    first = entry + ARRAYS
    head, coarse = numbers(word(first)), shorts(word(first + 8))
    bricks, samples = wholes(word(first + 16)), shorts(word(first + 24))
    # A bore has its line in place of the head.
    field = FieldArrays(head, coarse, bricks, samples)
    return Wall(word(entry + KIND) == BORE, field, head)
