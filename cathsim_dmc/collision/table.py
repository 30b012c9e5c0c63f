"""The table of a process's fields, and links in memory, for compiled functions."""

import numpy as np

from cathsim_dmc.anatomy.motion_loops import MARK as MOTION
from cathsim_dmc.collision.native import numbers, symbol, wholes, word
from cathsim_dmc.compiled import compiled

# Words in the head of the table: offsets in mjModel and mjData, the functions that
# stood in MuJoCo's collision table, and how an error is raised.
(
    NUSER_GEOM,
    GEOM_USER,
    GEOM_SIZE,
    GEOM_BODYID,
    BODY_PARENTID,
    GEOM_XPOS,
    GEOM_XMAT,
    XPOS,
    OF_CAPSULE,
    OF_SPHERE,
    ERROR,
    MESSAGE,
    GEOM_SOLIMP,
    NUSERDATA,
    USERDATA,
    TIME,
    BODY_DOFADR,
    BODY_DOFNUM,
    BODY_ROOTID,
    DOF_PARENTID,
    TIMESTEP,
    QVEL,
    CDOF,
    SUBTREE_COM,
    GEOM_SOLREF,
) = range(0, 200, 8)
HEAD = 25  # words
# An entry: key, kind, addresses of the place of the carrier's middle in the field's
# frame, of head, coarse lattice, index and samples, and of the lattice of its motion.
ENTRY, CAPACITY = 8, 1 << 14
LUMEN, BORE = 0, 1
# Numbers of a carrier geom: the mark, then the key of its field in three parts, which
# any printing of a model file keeps.
USER, MARK, PART = 4, 730155.0, 1 << 20
SYMBOL = "cathsim_fields"
# Before anything that knows it by the symbol is loaded.
TABLE = np.zeros(HEAD + ENTRY * CAPACITY, np.int64)
symbol(SYMBOL, TABLE)
MOTION_ENTRY = 56  # bytes from an entry to the address of the lattice of its motion
_JOINED = 1e-6  # m
COUNT = 1 << 40  # more than any array has; nothing checks it


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
def key_of(table, model, geom):
    """Key of the field that a geom carries; 0 for none."""
    stride = word(model + word(table + NUSER_GEOM))
    if stride < USER:
        return np.int64(0)
    user = numbers(word(model + word(table + GEOM_USER)) + 8 * stride * geom, USER)
    if user[0] != MARK:
        return np.int64(0)
    key = (np.int64(user[1]) * PART + np.int64(user[2])) * PART
    return key + np.int64(user[3])


@compiled
def motion_of(table, model, data):
    """Address of the parameters of a simulation's motion; 0 for none."""
    count = word(model + word(table + NUSERDATA))
    place = word(data + word(table + USERDATA))
    user, start = numbers(place, count), 0
    while start + 2 < count:
        if user[start + 2] == MOTION:
            return place + 8 * (start + 2)
        start += 2 + int(user[start + 1])
    return np.int64(0)


@compiled
def into(frame, way):
    """A vector (3) in the frame of a matrix (9)."""
    return (
        frame[0] * way[0] + frame[3] * way[1] + frame[6] * way[2],
        frame[1] * way[0] + frame[4] * way[1] + frame[7] * way[2],
        frame[2] * way[0] + frame[5] * way[1] + frame[8] * way[2],
    )


@compiled
def posed(table, data, entry, geom1, geom2):
    """Middle (3) m and axis (3) of a capsule in the frame of the field of a geom."""
    places = word(data + word(table + GEOM_XPOS))
    turns = word(data + word(table + GEOM_XMAT))
    centre, origin = numbers(places + 24 * geom1, 3), numbers(places + 24 * geom2, 3)
    turned, frame = numbers(turns + 72 * geom1, 9), numbers(turns + 72 * geom2, 9)
    middle = numbers(word(entry + 16), 3)
    apart = (centre[0] - origin[0], centre[1] - origin[1], centre[2] - origin[2])
    apart = into(frame, apart)
    local = (middle[0] + apart[0], middle[1] + apart[1], middle[2] + apart[2])
    return local, into(frame, (turned[2], turned[5], turned[8]))


@compiled
def ends(table, model, data, geom, half):
    """Which ends (2) of a capsule count: one at its body's joint is another link's."""
    body = wholes(word(model + word(table + GEOM_BODYID)) + 4 * geom, 1)[0]
    parent = wholes(word(model + word(table + BODY_PARENTID)) + 4 * body, 1)[0]
    if parent == 0 or half == 0.0:
        return (True, True)
    centre = numbers(word(data + word(table + GEOM_XPOS)) + 24 * geom, 3)
    turned = numbers(word(data + word(table + GEOM_XMAT)) + 72 * geom, 9)
    joint = numbers(word(data + word(table + XPOS)) + 24 * body, 3)
    low, high = 0.0, 0.0
    for k in range(3):
        low += (centre[k] - half * turned[3 * k + 2] - joint[k]) ** 2
        high += (centre[k] + half * turned[3 * k + 2] - joint[k]) ** 2
    return (low > _JOINED * _JOINED, high > _JOINED * _JOINED)


@compiled
def swept(table, model, data, geom):
    """Ways of a geom's middle (3) and turn (3) in a physics step at its velocity, m."""
    body = wholes(word(model + word(table + GEOM_BODYID)) + 4 * geom, 1)[0]
    parents = wholes(word(model + word(table + BODY_PARENTID)), COUNT)
    counts = wholes(word(model + word(table + BODY_DOFNUM)), COUNT)
    while body > 0 and counts[body] == 0:
        body = parents[body]
    a, b, c, x, y, z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if body == 0:
        return (x, y, z), (a, b, c)
    ancestors = wholes(word(model + word(table + DOF_PARENTID)), COUNT)
    velocities = numbers(word(data + word(table + QVEL)), COUNT)
    motions = word(data + word(table + CDOF))
    first = wholes(word(model + word(table + BODY_DOFADR)) + 4 * body, 1)[0]
    dof = first + counts[body] - 1
    while dof >= 0:
        motion, velocity = numbers(motions + 48 * dof, 6), velocities[dof]
        a, b, c = (
            a + motion[0] * velocity,
            b + motion[1] * velocity,
            c + motion[2] * velocity,
        )
        x, y, z = (
            x + motion[3] * velocity,
            y + motion[4] * velocity,
            z + motion[5] * velocity,
        )
        dof = ancestors[dof]
    root = wholes(word(model + word(table + BODY_ROOTID)) + 4 * body, 1)[0]
    about = numbers(word(data + word(table + SUBTREE_COM)) + 24 * root, 3)
    centre = numbers(word(data + word(table + GEOM_XPOS)) + 24 * geom, 3)
    step = numbers(model + word(table + TIMESTEP), 1)[0]
    u, v, w = centre[0] - about[0], centre[1] - about[1], centre[2] - about[2]
    x, y, z = x + b * w - c * v, y + c * u - a * w, z + a * v - b * u
    return (step * x, step * y, step * z), (step * a, step * b, step * c)


@compiled
def sheathed(table, model, data, geom, place):
    """Whether a place (3) is in the box of a geom, that of the sheath's bore."""
    if geom < 0:
        return False
    centre = numbers(word(data + word(table + GEOM_XPOS)) + 24 * geom, 3)
    frame = numbers(word(data + word(table + GEOM_XMAT)) + 72 * geom, 9)
    size = numbers(word(model + word(table + GEOM_SIZE)) + 24 * geom, 3)
    apart = (place[0] - centre[0], place[1] - centre[1], place[2] - centre[2])
    x, y, z = into(frame, apart)
    return abs(x) < size[0] and abs(y) < size[1] and abs(z) < size[2]
