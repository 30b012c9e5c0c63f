"""Contacts of links with walls, written into the arrays of MuJoCo Warp.

The law is `laws.contact`, as in `collision.collider`. One thread takes one link and one
carrier of one world.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from cathsim_dmc.collision.fields import registered
from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.capsule import SAMPLES, is_far
from cathsim_dmc.laws.contact import (
    CONTACT,
    contact_law,
    contacts,
    end_caps,
    looks_ahead,
    sweep_of,
    world_contact,
)
from cathsim_dmc.laws.contact import Scratch as Memory
from cathsim_dmc.laws.field import FieldArrays
from cathsim_dmc.laws.places import Capsule
from cathsim_dmc.laws.planes import MOST, PLANES
from cathsim_dmc.laws.vectors import into
from cathsim_dmc.laws.wall import Wall, is_straight_bore
from cathsim_dmc.simulation.warp.devices import NONE, Chosen, Device, Scratch

SCRATCH: Scratch = ((SAMPLES,), (PLANES, 4), (MOST, CONTACT))
_LEAST_FRICTION = 1e-5  # MuJoCo's mjMINMU
_CONSTRAINT = 1  # mujoco_warp's ContactType.CONSTRAINT


class Links(NamedTuple):
    """The links and the carriers of the compiled model.

    Attributes:
        geoms: (L,) geoms of the links.
        joints: (L,) bodies whose origin is the joint of a link; -1 for none.
        carriers: (C,) geoms that carry a wall.
        last_dof: (L,) last degree of freedom that moves a link; -1 for none.
        roots: (L,) bodies at the roots of the links' trees.
        parents: (nv,) degree of freedom before each one; -1 for none.
        dims: (L, C) dimensions of a contact.
        priorities: (L, C) 1 where the carrier's parameters hold, -1 where the link's
            do, 0 where they are mixed.
        mix: (L, C) weight of the link's `solref` and `solimp`.
    """

    geoms: Any
    joints: Any
    carriers: Any
    last_dof: Any
    roots: Any
    parents: Any
    dims: Any
    priorities: Any
    mix: Any


class Walls(NamedTuple):
    """Walls of all anatomies, one after the other, and that of each world.

    Attributes:
        head, coarse, bricks, samples: As `laws.field.FieldArrays`, of all lumens.
        line: As `laws.wall.Wall`, of all bores.
        starts: (F, 5, 2) first and last place of wall f in each of these arrays.
        is_bore: (F,) whether a wall is a bore.
        middle: (F, 3) m, place of the carrier's middle in the frame of the wall.
        of_world: (N, C) wall of a carrier in each world.
    """

    head: Any
    coarse: Any
    bricks: Any
    samples: Any
    line: Any
    starts: Any
    is_bore: Any
    middle: Any
    of_world: Any


class Fields(NamedTuple):
    """Fields of Warp's model, (1 or N, ...)."""

    size: Any
    friction: Any
    solref: Any
    solimp: Any
    timestep: Any


class Motion(NamedTuple):
    """Arrays of Warp's data (N, ...) that a contact depends on."""

    geom_xpos: Any
    geom_xmat: Any
    xpos: Any
    cdof: Any
    qvel: Any
    subtree_com: Any


class Found(NamedTuple):
    """Contacts of all threads, before they are counted.

    Attributes:
        count: (T,) contacts of a thread.
        rows: (T, MOST, 7) of each the distance m, the place (3) m, and the direction
            (3) from the link into the wall.
    """

    count: Any
    rows: Any


class Contacts(NamedTuple):
    """Arrays of mujoco_warp's `Contact`, and their number."""

    dist: Any
    pos: Any
    frame: Any
    includemargin: Any
    friction: Any
    solref: Any
    solreffriction: Any
    solimp: Any
    dim: Any
    geom: Any
    efc_address: Any
    worldid: Any
    type: Any
    geomcollisionid: Any
    adhesion: Any
    nacon: Any


@compiled
def _wall(walls, number):
    """`laws.wall.Wall` of a number."""
    # A device function of numba-cuda may return arrays in a tuple alone.
    first, last = walls.starts[number, :, 0], walls.starts[number, :, 1]
    field = FieldArrays(
        walls.head[first[0] : last[0]],
        walls.coarse[first[1] : last[1]],
        walls.bricks[first[2] : last[2]],
        walls.samples[first[3] : last[3]],
    )
    line = walls.line[first[4] : last[4]]
    return Wall(walls.is_bore[number], field, line)


@compiled
def _matrix(turns, world, geom):
    """The nine numbers of a matrix of Warp, row by row, float64."""
    m = turns[world, geom]
    return (
        float(m[0, 0]), float(m[0, 1]), float(m[0, 2]),
        float(m[1, 0]), float(m[1, 1]), float(m[1, 2]),
        float(m[2, 0]), float(m[2, 1]), float(m[2, 2]),
    )  # fmt: skip


@compiled
def _vector(places, world, number):
    place = places[world, number]
    return float(place[0]), float(place[1]), float(place[2])


@compiled
def _swept(links, motion, world, link, step):
    """Ways of a link's centre (3) m and turn (3) rad in a physics step, in the world.

    See `collision.links`.
    """
    a, b, c, x, y, z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    dof = links.last_dof[link]
    while dof >= 0:
        way, velocity = motion.cdof[world, dof], float(motion.qvel[world, dof])
        a, b = a + way[0] * velocity, b + way[1] * velocity
        c, x = c + way[2] * velocity, x + way[3] * velocity
        y, z = y + way[4] * velocity, z + way[5] * velocity
        dof = links.parents[dof]
    about = motion.subtree_com[world, links.roots[link]]
    centre = motion.geom_xpos[world, links.geoms[link]]
    u, v, w = centre[0] - about[0], centre[1] - about[1], centre[2] - about[2]
    x, y, z = x + b * w - c * v, y + c * u - a * w, z + a * v - b * u
    return (step * x, step * y, step * z), (step * a, step * b, step * c)


class Pair(NamedTuple):
    """A link and a wall in one world.

    Attributes:
        wall: `laws.wall.Wall`.
        capsule: The link in the frame of the wall.
        law: `laws.contact.Law`.
        sweep: `laws.contact.Sweep`.
        centre: (3) m, of the link, in the world.
        axis: (3) unit vector of the link, in the world.
        frame: (9) matrix whose columns are the axes of the wall's frame.
    """

    wall: Any
    capsule: Any
    law: Any
    sweep: Any
    centre: Any
    axis: Any
    frame: Any


@compiled
def pair_of(thread, links, walls, fields, motion):
    """`Pair` of a thread.

    Args:
        thread: (carrier · N + world) · L + link.
        links: `Links`.
        walls: `Walls`.
        fields: `Fields`.
        motion: `Motion`.
    """
    count, worlds = len(links.geoms), len(walls.of_world)
    link, world = thread % count, (thread // count) % worlds
    which = thread // (count * worlds)
    geom, carrier = links.geoms[link], links.carriers[which]
    number = walls.of_world[world, which]
    wall, middle = _wall(walls, number), walls.middle[number]
    frame = _matrix(motion.geom_xmat, world, carrier)
    turned = _matrix(motion.geom_xmat, world, geom)
    centre = _vector(motion.geom_xpos, world, geom)
    origin = _vector(motion.geom_xpos, world, carrier)
    axis = (turned[2], turned[5], turned[8])
    apart = (centre[0] - origin[0], centre[1] - origin[1], centre[2] - origin[2])
    seen = into(frame, apart)
    local = (middle[0] + seen[0], middle[1] + seen[1], middle[2] + seen[2])
    size = fields.size[world % len(fields.size), geom]
    radius, half_length = float(size[0]), float(size[1])
    caps = (True, True)
    if links.joints[link] >= 0:
        joint = _vector(motion.xpos, world, links.joints[link])
        caps = end_caps(centre, axis, half_length, joint)
    capsule = Capsule(local, into(frame, axis), half_length, caps)
    impedance = float(fields.solimp[world % len(fields.solimp), geom, 0])
    reference = float(fields.solref[world % len(fields.solref), geom, 0])
    law = contact_law(wall, radius, 0.0, impedance, reference)
    travel, turn = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if looks_ahead(law):
        step = float(fields.timestep[world % len(fields.timestep)])
        travel, turn = _swept(links, motion, world, link, step)
        travel, turn = into(frame, travel), into(frame, turn)
    sweep = sweep_of(capsule, law, travel, turn)
    return Pair(wall, capsule, law, sweep, centre, axis, frame)


@compiled
def is_near(thread, scratch, links, walls, fields, motion, found):
    """Whether `find` is to look at the link and the wall of a thread; clears `found`.

    Most links are far from the wall. The others are gathered, so that all threads of a
    GPU that run together have as much to do.
    """
    found.count[thread] = 0
    pair = pair_of(thread, links, walls, fields, motion)
    place = pair.capsule.centre
    if not math.isfinite(place[0] + place[1] + place[2] + pair.axis[0] + pair.axis[1]):
        return False
    if is_straight_bore(pair.wall):
        return True
    law = pair.law
    limit = max(law.radius + law.margin + law.activation, pair.sweep.reach)
    return not is_far(pair.wall, pair.capsule, limit)


@compiled
def find(thread, scratch, links, walls, fields, motion, found):
    """Finds the contacts of a link with a wall.

    Args:
        thread: As `pair_of`.
        scratch: Arrays of the shapes `SCRATCH`.
        links: `Links`.
        walls: `Walls`.
        fields: `Fields`.
        motion: `Motion`.
        found: `Found`, gets the contacts.
    """
    pair = pair_of(thread, links, walls, fields, motion)
    samples, planes, out = scratch
    memory = Memory(samples, planes)
    count = contacts(pair.wall, pair.capsule, pair.law, pair.sweep, memory, out)
    for n in range(count):
        distance, place, towards = world_contact(
            out[n], pair.law, pair.centre, pair.axis, pair.frame
        )
        row = found.rows[thread, n]
        row[0] = distance
        for k in range(3):
            row[1 + k], row[4 + k] = place[k], towards[k]
    found.count[thread] = count


@compiled
def _tangent(normal):
    """A unit vector (3) across a unit vector, that of MuJoCo's `mju_makeFrame`."""
    x, y, z = normal
    a, b = (0.0, 1.0) if abs(y) < 0.5 else (1.0, 0.0)
    along = a * z + b * y
    u, v, w = -along * x, b - along * y, a - along * z
    norm = math.sqrt(u * u + v * v + w * w)
    return u / norm, v / norm, w / norm


@compiled
def _mixed(array, row, geoms, k, mix, priority):
    """Entry k of a parameter of a contact, from those of link and carrier."""
    link, carrier = float(array[row, geoms[0], k]), float(array[row, geoms[1], k])
    if priority:
        return carrier if priority > 0 else link
    return mix * link + (1.0 - mix) * carrier


@compiled
def _write_law(links, fields, out, at, pair):
    """Writes what two geoms give a contact, as MuJoCo's `mj_contactParam` does."""
    world, link, which = pair
    geoms = links.geoms[link], links.carriers[which]
    priority, mix = links.priorities[link, which], links.mix[link, which]
    row = world % len(fields.friction)
    for k in range(3):  # sliding, spinning and rolling
        one = float(fields.friction[row, geoms[0], k])
        other = float(fields.friction[row, geoms[1], k])
        value = max(one, other)
        if priority:
            value = other if priority > 0 else one
        value = max(value, _LEAST_FRICTION)
        if k == 1:
            out.friction[at, 2] = value
        else:
            first = 0 if k == 0 else 3
            out.friction[at, first] = out.friction[at, first + 1] = value
    row = world % len(fields.solref)
    first = fields.solref[row, geoms[0], 0], fields.solref[row, geoms[1], 0]
    direct = first[0] <= 0 or first[1] <= 0
    for k in range(2):
        value = _mixed(fields.solref, row, geoms, k, mix, priority)
        if direct and not priority:
            one = float(fields.solref[row, geoms[0], k])
            value = min(one, float(fields.solref[row, geoms[1], k]))
        out.solref[at, k], out.solreffriction[at, k] = value, 0.0
    row = world % len(fields.solimp)
    for k in range(5):
        out.solimp[at, k] = _mixed(fields.solimp, row, geoms, k, mix, priority)
    out.dim[at] = links.dims[link, which]
    out.geom[at, 0], out.geom[at, 1] = geoms


@compiled
def place(world, scratch, links, fields, found, out, overflow):
    """Writes the contacts of a world into its own places of Warp's arrays.

    Args:
        world: Its number.
        scratch: Not used.
        links: `Links`.
        fields: `Fields`.
        found: `Found`.
        out: `Contacts`; world w has the places from w K on.
        overflow: (N,) gets 1 where there are more than K contacts.
    """
    count, most = len(links.geoms), len(out.dist) // len(overflow)
    carriers, at = len(links.carriers), world * most
    for own in range(count * carriers):
        link, which = own // carriers, own % carriers
        thread = (which * len(overflow) + world) * count + link
        for n in range(found.count[thread]):
            if at == (world + 1) * most:
                overflow[world] = 1
                break
            row = found.rows[thread, n]
            out.dist[at], out.includemargin[at] = row[0], 0.0
            normal = (row[4], row[5], row[6])
            side = _tangent(normal)
            other = (
                normal[1] * side[2] - normal[2] * side[1],
                normal[2] * side[0] - normal[0] * side[2],
                normal[0] * side[1] - normal[1] * side[0],
            )
            for k in range(3):
                out.pos[at, k] = row[1 + k]
                out.frame[at, 0, k] = normal[k]
                out.frame[at, 1, k] = side[k]
                out.frame[at, 2, k] = other[k]
            _write_law(links, fields, out, at, (world, link, which))
            out.worldid[at], out.type[at] = world, _CONSTRAINT
            out.geomcollisionid[at], out.adhesion[at] = n, 0.0
            at += 1
    for free in range(world * most, (world + 1) * most):
        for k in range(out.efc_address.shape[1]):
            out.efc_address[free, k] = -1
        if free >= at:
            out.type[free], out.worldid[free] = 0, world
    if world == 0:
        out.nacon[0] = len(out.dist)


class WallContacts:
    """Contacts of the devices of N worlds with their walls.

    Attributes:
        num_worlds: N.
        carriers: (C,) geoms that carry a wall.
    """

    def __init__(self, device: Device, model: mujoco.MjModel, num_worlds: int):
        """Finds links and carriers in the compiled model.

        Args:
            device: Where Warp's arrays are.
            model: Scene of the task.
            num_worlds: N.

        Raises:
            NotImplementedError: if other geoms collide in the model.
        """
        self._device, self.num_worlds = device, num_worlds
        self.carriers = carriers_of(model)
        self._host = _links(model, self.carriers)
        self._links = Links(*map(device.constant, self._host))
        self._numbers: dict[tuple[float, ...], int] = {}
        self._parts: list[tuple[bool, np.ndarray, list[np.ndarray]]] = []
        self._of_world = np.zeros((num_worlds, len(self.carriers)), np.int32)
        self.enter(np.arange(num_worlds), model.geom_user[self.carriers])
        self._walls: Walls | None = None
        self._arguments: tuple[Any, ...] = ()

    def enter(self, worlds: Sequence[int] | np.ndarray, users: np.ndarray) -> None:
        """Gives some worlds the walls that their carriers name.

        Args:
            worlds: (K,) numbers of worlds.
            users: (C, 4) `geom_user` of the carriers.
        """
        for which, user in enumerate(users):
            key = tuple(user.tolist())
            if key not in self._numbers:
                self._numbers[key] = len(self._parts)
                self._parts.append(registered(key))
                self._walls = None
            self._of_world[worlds, which] = self._numbers[key]
        if self._walls is not None:
            self._device.write(self._walls.of_world, self._of_world)

    @property
    def is_bound(self) -> bool:
        """Whether all walls are on the device, in the arrays of the last `bind`."""
        return self._walls is not None

    def bind(self, model: Any, data: Any) -> None:
        """Takes the arrays of Warp's model and data, which must not be replaced.

        Args:
            model: `mujoco_warp.Model`.
            data: `mujoco_warp.Data` with as many places for contacts in each world.
        """
        device, view = self._device, self._device.view
        if self._walls is None:
            self._walls = self._made()
        names = ("geom_size", "geom_friction", "geom_solref", "geom_solimp")
        given = [view(getattr(model, name)) for name in names]
        fields = Fields(*given, view(model.opt.timestep))
        motion = Motion(*(view(getattr(data, name)) for name in Motion._fields))
        arrays = (view(getattr(data.contact, name)) for name in Contacts._fields[:-1])
        threads = self.num_worlds * self._host.dims.size
        found = Found(
            device.constant(np.zeros(threads, np.int32)),
            device.constant(np.zeros((threads, MOST, 7))),
        )
        self._overflow = device.constant(np.zeros(self.num_worlds, np.int32))
        self._near = Chosen(
            device.constant(np.zeros(threads, np.int32)),
            device.constant(np.zeros(1, np.int32)),
        )
        self._arguments = self._links, self._walls, fields, motion, found
        contacts = Contacts(*arrays, view(data.nacon))
        self._placed = self._links, fields, found, contacts, self._overflow

    def begin(self) -> None:
        """Begins a control step."""
        self._device.write(self._overflow, np.zeros(self.num_worlds, np.int32))

    def overflowed(self) -> np.ndarray:
        """(N,) whether a world had more contacts than places in the control step."""
        return self._device.host(self._overflow) != 0

    def __call__(self, model: Any, data: Any) -> None:
        """What mujoco_warp calls at the end of its own collision."""
        del model, data
        near = self._device.select(is_near, self._near, *self._arguments)
        self._device.launch(find, near, SCRATCH, *self._arguments)
        self._device.launch(place, self.num_worlds, NONE, *self._placed)

    def _made(self) -> Walls:
        """The walls of all anatomies on the device."""
        empty = [np.zeros(1), *(np.zeros(1, t) for t in (np.int16, np.int32, np.int16))]
        columns: list[list[np.ndarray]] = [[] for _ in range(5)]
        starts = np.zeros((len(self._parts), 5, 2), np.int64)
        for number, (is_bore, _, arrays) in enumerate(self._parts):
            five = [*empty, arrays[0]] if is_bore else [*arrays, np.zeros(1)]
            for which, array in enumerate(five):
                before = sum(map(len, columns[which]))
                starts[number, which] = before, before + len(array)
                columns[which].append(np.asarray(array).ravel())
        types = (np.float64, np.int16, np.int32, np.int16, np.float64)
        joined = (
            np.concatenate(column).astype(kind)
            for column, kind in zip(columns, types, strict=True)
        )
        constant = self._device.constant
        return Walls(
            *map(constant, joined),
            constant(starts),
            constant(np.array([part[0] for part in self._parts])),
            constant(np.array([part[1] for part in self._parts], np.float64)),
            constant(self._of_world),
        )


def carriers_of(model: mujoco.MjModel) -> np.ndarray:
    """Geoms (C,) of a compiled model that carry a wall."""
    marked = [registered(tuple(user)) is not None for user in model.geom_user.tolist()]
    return np.flatnonzero(marked)


def _links(model: mujoco.MjModel, carriers: np.ndarray) -> Links:
    """`Links` of a compiled model, arrays on the host."""
    colliding = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.setdiff1d(np.flatnonzero(colliding), carriers)
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE.value
    if (model.geom_type[geoms] != capsule).any() or (model.geom_contype[geoms]).any():
        raise NotImplementedError(
            "a geom beside links and walls collides in this scene; simulation on Warp "
            "has contacts of links with walls only: take simulation_device='cpu'"
        )
    bodies, joints, last = model.geom_bodyid[geoms], [], []
    for body in bodies.tolist():
        joints.append(body if model.body_parentid[body] else -1)
        while body > 0 and model.body_dofnum[body] == 0:
            body = model.body_parentid[body]
        last.append(model.body_dofadr[body] + model.body_dofnum[body] - 1)
    priority = model.geom_priority
    above = np.sign(priority[None, carriers] - priority[geoms, None])
    own, other = model.geom_condim[geoms, None], model.geom_condim[None, carriers]
    mixed = np.maximum(own, other)
    dims = np.where(above > 0, other, np.where(above < 0, own, mixed))
    weights = model.geom_solmix[geoms, None], model.geom_solmix[None, carriers]
    return Links(
        *(np.asarray(a, np.int32) for a in (geoms, joints, carriers, last)),
        model.body_rootid[bodies].astype(np.int32),
        model.dof_parentid.astype(np.int32),
        dims.astype(np.int32),
        above.astype(np.int32),
        weights[0] / sum(weights),
    )
