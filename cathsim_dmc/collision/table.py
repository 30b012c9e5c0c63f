"""The table of a process's fields, and links in memory, for compiled functions."""

import numpy as np

from cathsim_dmc.collision.native import data_field, model_field, numbers, symbol, word
from cathsim_dmc.compiled import compiled

# Words in the head of the table: the functions that stood in MuJoCo's collision table,
# and how an error is raised.
OF_CAPSULE, OF_SPHERE, ERROR, MESSAGE = range(0, 32, 8)
HEAD = 4  # words
# An entry: key, kind, addresses of the place of the carrier's middle in the field's
# frame, of head, coarse lattice, index and samples, and of the lattice of its motion.
ENTRY, CAPACITY = 8, 1 << 14
LUMEN, BORE = 0, 1
# Numbers of a carrier geom: the mark, then the key of its field in three parts, which
# any printing of a model file keeps.
USER, MARK, PART = 4, 730155.0, 1 << 20
SYMBOL = "cathsim_fields"
# Before anything that knows it by the symbol is loaded.
TABLE = symbol(SYMBOL, HEAD + ENTRY * CAPACITY)
MOTION_ENTRY = 56  # bytes from an entry to the address of the lattice of its motion
_JOINED = 1e-6  # m


@compiled
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


@compiled
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


@compiled
def into(frame, way):
    """A vector (3) in the frame of a matrix (9)."""
    return (
        frame[0] * way[0] + frame[3] * way[1] + frame[6] * way[2],
        frame[1] * way[0] + frame[4] * way[1] + frame[7] * way[2],
        frame[2] * way[0] + frame[5] * way[1] + frame[8] * way[2],
    )


@compiled
def seen_from(data, geom, place):
    """A place (3) of the world in the frame of a geom, m."""
    centre = data_field(data, "geom_xpos")[geom]
    apart = (place[0] - centre[0], place[1] - centre[1], place[2] - centre[2])
    return into(data_field(data, "geom_xmat")[geom], apart)


@compiled
def posed(data, entry, geom1, geom2):
    """Middle (3) m and axis (3) of a capsule in the frame of the field of a geom."""
    turns, middle = data_field(data, "geom_xmat"), numbers(word(entry + 16))
    apart = seen_from(data, geom2, data_field(data, "geom_xpos")[geom1])
    local = (middle[0] + apart[0], middle[1] + apart[1], middle[2] + apart[2])
    turned = turns[geom1]
    return local, into(turns[geom2], (turned[2], turned[5], turned[8]))


@compiled
def ends(model, data, geom, half):
    """Which ends (2) of a capsule count: one at its body's joint is another link's."""
    body = model_field(model, "geom_bodyid")[geom]
    if model_field(model, "body_parentid")[body] == 0 or half == 0.0:
        return (True, True)
    centre = data_field(data, "geom_xpos")[geom]
    turned = data_field(data, "geom_xmat")[geom]
    joint = data_field(data, "xpos")[body]
    low, high = 0.0, 0.0
    for k in range(3):
        low += (centre[k] - half * turned[3 * k + 2] - joint[k]) ** 2
        high += (centre[k] + half * turned[3 * k + 2] - joint[k]) ** 2
    return (low > _JOINED * _JOINED, high > _JOINED * _JOINED)


@compiled
def swept(model, data, geom):
    """Ways of a geom's middle (3) and turn (3) in a physics step at its velocity, m."""
    body = model_field(model, "geom_bodyid")[geom]
    parents = model_field(model, "body_parentid")
    counts = model_field(model, "body_dofnum")
    while body > 0 and counts[body] == 0:
        body = parents[body]
    a, b, c, x, y, z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if body == 0:
        return (x, y, z), (a, b, c)
    ancestors = model_field(model, "dof_parentid")
    velocities, motions = data_field(data, "qvel"), data_field(data, "cdof")
    dof = model_field(model, "body_dofadr")[body] + counts[body] - 1
    while dof >= 0:
        motion, velocity = motions[dof], velocities[dof]
        a, b = a + motion[0] * velocity, b + motion[1] * velocity
        c, x = c + motion[2] * velocity, x + motion[3] * velocity
        y, z = y + motion[4] * velocity, z + motion[5] * velocity
        dof = ancestors[dof]
    about = data_field(data, "subtree_com")[model_field(model, "body_rootid")[body]]
    centre = data_field(data, "geom_xpos")[geom]
    step = model_field(model, "opt.timestep")
    u, v, w = centre[0] - about[0], centre[1] - about[1], centre[2] - about[2]
    x, y, z = x + b * w - c * v, y + c * u - a * w, z + a * v - b * u
    return (step * x, step * y, step * z), (step * a, step * b, step * c)


@compiled
def sheathed(model, data, geom, place):
    """Whether a place (3) is in the box of a geom, that of the sheath's bore."""
    if geom < 0:
        return False
    x, y, z = seen_from(data, geom, place)
    size = model_field(model, "geom_size")[geom]
    return abs(x) < size[0] and abs(y) < size[1] and abs(z) < size[2]
