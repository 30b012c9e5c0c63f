"""Contacts of links with walls, written into the arrays of MuJoCo Warp."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc.collision.fields import Registered, registered
from cathsim_dmc.laws.planes import MOST
from cathsim_dmc.physics.deep_links import last_dofs
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

_CONSTRAINT = 1  # mujoco_warp's ContactType.CONSTRAINT
# Of the arrays of `Walls` that are joined.
_KINDS = (np.float64, np.int16, np.int32, np.int16, np.float64, np.float64)


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
        links = _links(model, self.carriers)
        self._links = device.constant(links)
        self._threads = num_worlds * links.dims.size
        self._numbers: dict[tuple[float, ...], int] = {}
        self._parts: list[Registered] = []
        shape = num_worlds, len(self.carriers)
        self._of_world = np.zeros(shape, np.int32)
        self._places, self._turns = np.zeros((*shape, 3)), np.zeros((*shape, 3, 3))
        self._walls: Any = None
        self.enter(np.arange(num_worlds), model, mujoco.MjData(model))

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
        self._entered = True

    def take(self, effects: Iterable[Effect]) -> None:
        """Takes the effects, bound to their worlds, before `bind`."""

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
        fields = device.views(Fields, model, timestep=view(model.opt.timestep))
        found = Found(
            device.constant(np.zeros(self._threads, np.int32)),
            device.constant(np.zeros((self._threads, MOST, ROW))),
        )
        motion = device.views(Motion, data)
        self._scene = Scene(self._links, self._walls, fields, motion, found)
        # The arrays that `Contacts` lacks stay 0.
        data.contact.type.fill_(_CONSTRAINT)
        contacts = device.views(Contacts, data.contact, nacon=view(data.nacon))
        self._sums = tuple(device.zeros(self.num_worlds) for _ in range(2))
        self.counts, self.starts = map(view, self._sums)
        self._written = Written(
            links=self._links,
            fields=fields,
            found=found,
            out=contacts,
            counts=self.counts,
            starts=self.starts,
            overflow=view(data.overflow),
        )

    def begin(self) -> None:
        """Begins a control step."""
        if self._entered:
            self._place()
            self._entered = False

    def _place(self) -> None:
        """Copies what `enter` has set to the device."""
        self._device.write(self._walls.of_world, self._of_world)
        self._device.write(self._walls.places, self._places)
        self._device.write(self._walls.turns, self._turns)

    def __call__(self, model: Any, data: Any) -> None:
        """Finds the contacts with walls; mujoco_warp's callback after its collision."""
        del model, data
        self._find()
        self._device.launch(count, self.num_worlds, NONE, self._written)
        self._device.sum_before(self._sums[0], self._sums[1])
        self._device.launch(place, self._threads, NONE, self._written)

    def _find(self) -> None:
        self._device.launch(find, self._threads, SCRATCH, self._scene)

    def write(self) -> None:
        """Copies the parameters of a motion from the host to the device."""

    def carry(self) -> None:
        """Adds velocities of the walls to the rows of constraints, once these exist."""

    def _lattice(self, wall: Registered) -> np.ndarray:
        """Lattice of the motion of a wall, empty if it does not move."""
        del wall
        return np.zeros(0)

    def _made(self) -> Walls:
        """Copies the walls of all anatomies to the device."""
        empty = np.zeros(0)
        columns: list[list[np.ndarray]] = [[] for _ in _KINDS]
        starts = np.zeros((len(self._parts), len(_KINDS), 2), np.int64)
        for number, wall in enumerate(self._parts):
            lumen, line = wall.arrays, empty
            if wall.is_bore:
                lumen, line = [empty] * 4, wall.arrays[0]
            for which, array in enumerate([*lumen, line, self._lattice(wall)]):
                before = sum(map(len, columns[which]))
                starts[number, which] = before, before + len(array)
                columns[which].append(array)
        joined = (
            np.concatenate(column).astype(kind)
            for column, kind in zip(columns, _KINDS, strict=True)
        )
        bores = np.array([wall.is_bore for wall in self._parts])
        middles = np.array([wall.middle for wall in self._parts], np.float64)
        rest = (starts, bores, middles, self._of_world, self._places, self._turns)
        return self._device.constant(Walls._make([*joined, *rest]))


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
    bodies, priority = model.geom_bodyid[geoms], model.geom_priority
    above = np.sign(priority[None, carriers] - priority[geoms, None])
    own, other = model.geom_condim[geoms, None], model.geom_condim[None, carriers]
    mixed = np.maximum(own, other)
    dims = np.where(above > 0, other, np.where(above < 0, own, mixed))
    weights = model.geom_solmix[geoms, None], model.geom_solmix[None, carriers]
    return Links(
        geoms=geoms.astype(np.int32),
        joints=np.where(model.body_parentid[bodies] > 0, bodies, -1),
        carriers=carriers.astype(np.int32),
        last_dof=last_dofs(model, bodies),
        roots=model.body_rootid[bodies],
        parents=model.dof_parentid,
        dims=dims,
        priorities=above,
        mix=weights[0] / sum(weights),
    )
