"""Contacts of links with walls, written into the arrays of MuJoCo Warp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc.collision.fields import Registered, registered
from cathsim_dmc.laws.planes import MOST
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.simulation.warp.contact_arrays import (
    ROW,
    Contacts,
    Fields,
    Found,
    Links,
    Motion,
    Walls,
)
from cathsim_dmc.simulation.warp.contact_kernels import (
    SCRATCH,
    Scene,
    Written,
    count,
    find,
    place,
)
from cathsim_dmc.simulation.warp.devices import NONE, Device
from cathsim_dmc.simulation.warp.moving import MovingWalls


class WallContacts:
    """Contacts of the devices of N worlds with their walls.

    Attributes:
        num_worlds: N.
        carriers: (C,) geoms that carry a wall.
        counts, starts: (N,) contacts of each world in Warp's arrays, and the first.
        is_wall: (ngeom,) whether a geom is the wall of the vessel.
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
        self.is_wall = np.zeros(model.ngeom, bool)
        self.is_wall[self.carriers] = model.geom_bodyid[self.carriers] == 0
        self._host = _links(model, self.carriers)
        self._links = Links._make(map(device.constant, self._host))
        self._numbers: dict[tuple[float, ...], int] = {}
        self._parts: list[Registered] = []
        shape = num_worlds, len(self.carriers)
        self._of_world = np.zeros(shape, np.int32)
        self._places, self._turns = np.zeros((*shape, 3)), np.zeros((*shape, 3, 3))
        self._walls: Walls | None = None
        self._motion: MovingWalls | None = None
        self.enter(np.arange(num_worlds), model, mujoco.MjData(model))
        self._scene: Scene | None = None
        self._written: Written | None = None

    def enter(
        self, worlds: Sequence[int] | np.ndarray, model: mujoco.MjModel,
        data: mujoco.MjData,
    ) -> None:  # fmt: skip
        """Sets the walls of some worlds to those of an anatomy.

        Args:
            worlds: (K,) numbers of worlds.
            model: Model whose carriers name the walls and have their places.
            data: Data of the model, in any posture; its kinematics are overwritten.
        """
        mujoco.mj_kinematics(model, data)
        for which, carrier in enumerate(self.carriers):
            key = tuple(model.geom_user[carrier].tolist())
            wall = None if key in self._numbers else registered(key)
            if wall is not None:
                self._numbers[key] = len(self._parts)
                self._parts.append(wall)
                self._walls = None
            self._of_world[worlds, which] = self._numbers[key]
            self._places[worlds, which] = data.geom_xpos[carrier]
            self._turns[worlds, which] = data.geom_xmat[carrier].reshape(3, 3)
        if self._motion is not None:
            self._motion.enter(worlds, model, data)
        self._entered = True

    def move(self, effect: Effect, bore: int) -> None:
        """Makes the walls move; called before `bind`.

        Args:
            effect: `physics.motion.Moving`, bound to its worlds.
            bore: Geom around the sheath; -1 for none.
        """
        self._motion = MovingWalls(self._device, effect, bore)

    @property
    def is_bound(self) -> bool:
        """Whether all walls are on the device, in the arrays of the last `bind`."""
        return self._walls is not None

    def bind(self, model: Any, data: Any) -> None:
        """Binds to the arrays of Warp's model and data, which must not be replaced.

        Args:
            model: `mujoco_warp.Model`.
            data: `mujoco_warp.Data` with the same room for contacts in each world.
        """
        device, view = self._device, self._device.view
        if self._walls is None:
            self._walls = self._made()
        names = ("geom_size", "geom_friction", "geom_solref", "geom_solimp")
        given = [view(getattr(model, name)) for name in names]
        fields = Fields._make([*given, view(model.opt.timestep)])
        motion = Motion._make(view(getattr(data, name)) for name in Motion._fields)
        arrays = [view(getattr(data.contact, name)) for name in Contacts._fields[:-1]]
        threads = self.num_worlds * self._host.dims.size
        found = Found(
            device.constant(np.zeros(threads, np.int32)),
            device.constant(np.zeros((threads, MOST, ROW))),
        )
        self._overflow = device.constant(np.zeros(self.num_worlds, np.int32))
        self._scene = Scene(self._links, self._walls, fields, motion, found)
        contacts = Contacts._make([*arrays, view(data.nacon)])
        self._sums = tuple(device.zeros(self.num_worlds) for _ in range(2))
        self.counts, self.starts = map(view, self._sums)
        self._written = Written(
            self._links, fields, found, contacts, self.counts, self.starts,
            self._overflow,
        )  # fmt: skip
        if self._motion is not None:
            self._motion.bind(model, data, self._scene, self._written)

    def begin(self) -> None:
        """Begins a control step."""
        if self._entered and self._walls is not None:
            self._device.write(self._walls.of_world, self._of_world)
            self._device.write(self._walls.places, self._places)
            self._device.write(self._walls.turns, self._turns)
            if self._motion is not None:
                self._motion.place()
            self._entered = False
        self._device.write(self._overflow, np.zeros(self.num_worlds, np.int32))

    def overflowed(self) -> np.ndarray:
        """(N,) bool, whether a world had more contacts than room in the step."""
        return self._device.host(self._overflow) != 0

    def __call__(self, model: Any, data: Any) -> None:
        """Finds the contacts with walls; mujoco_warp's callback after its collision."""
        del model, data
        device, threads = self._device, self.num_worlds * self._host.dims.size
        if self._motion is None:
            device.launch(find, threads, SCRATCH, self._scene)
        else:
            self._motion.find(threads)
        device.launch(count, self.num_worlds, NONE, self._written)
        device.sum_before(self._sums[0], self._sums[1])
        device.launch(place, threads, NONE, self._written)

    def write(self) -> None:
        """Copies the parameters of the motion from the host to the device."""
        if self._motion is not None:
            self._motion.write()

    def carry(self) -> None:
        """Adds the velocities of walls to the rows of constraints, once these exist."""
        if self._motion is not None:
            self._motion.carry(self.num_worlds)

    def _made(self) -> Walls:
        """Copies the walls of all anatomies to the device."""
        empty = [np.zeros(1), *(np.zeros(1, t) for t in (np.int16, np.int32, np.int16))]
        columns: list[list[np.ndarray]] = [[] for _ in range(6)]
        starts = np.zeros((len(self._parts), 6, 2), np.int64)
        for number, wall in enumerate(self._parts):
            lattice = wall.lattice
            if self._motion is None or lattice is None:
                lattice = np.zeros(0)
            one = [*empty, wall.arrays[0]] if wall.is_bore else [*wall.arrays, empty[0]]
            for which, array in enumerate([*one, lattice]):
                before = sum(map(len, columns[which]))
                starts[number, which] = before, before + len(array)
                columns[which].append(np.asarray(array).ravel())
        types = (np.float64, np.int16, np.int32, np.int16, np.float64, np.float64)
        joined = (
            np.concatenate(column).astype(kind)
            for column, kind in zip(columns, types, strict=True)
        )
        constant = self._device.constant
        rest = (
            constant(starts),
            constant(np.array([part.is_bore for part in self._parts])),
            constant(np.array([part.middle for part in self._parts], np.float64)),
            *map(constant, (self._of_world, self._places, self._turns)),
        )
        return Walls._make([*map(constant, joined), *rest])


def carriers_of(model: mujoco.MjModel) -> np.ndarray:
    """Geoms (C,) of a compiled model that carry a wall and collide."""
    marked = [registered(user) is not None for user in model.geom_user.tolist()]
    # The bore of a sheath that holds the device by hinges does not.
    return np.flatnonzero(np.array(marked) & (model.geom_contype != 0))


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
    whole = (
        geoms,
        joints,
        carriers,
        last,
        model.body_rootid[bodies],
        model.dof_parentid,
        dims,
        above,
    )
    arrays = [np.asarray(each, np.int32) for each in whole]
    return Links._make([*arrays, weights[0] / sum(weights)])
