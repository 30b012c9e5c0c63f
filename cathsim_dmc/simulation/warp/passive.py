"""Passive forces of a task's effects, added in MuJoCo Warp.

The laws are `laws.blood` and `laws.springs`, which MuJoCo calls through
`physics.dispatcher` on the CPU. One thread computes one world.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.blood import Blood, drag
from cathsim_dmc.laws.device import Device as DeviceState
from cathsim_dmc.laws.hinges import Bends
from cathsim_dmc.laws.springs import Scratch, Springs, shape_torques
from cathsim_dmc.physics.dispatcher import Places
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.physics.flow import Flow
from cathsim_dmc.simulation.warp.devices import NONE, Device

_OF_CONTACTS = ("compliance", "motion")  # adapters; see `contacts.WallContacts`


class Arrays(NamedTuple):
    """Arrays of Warp's data and model, (1 or N, ...), as `laws.device.Device`.

    Attributes:
        first_link: Number of the first link among the bodies.
        body_dofadr: (L,) first degree of freedom of each link.
        body_dofnum: (L,) number of degrees of freedom of each link.
        geoms: (L,) geoms of the links.
        hinges: (3, 2 J) joints of the hinges, their indices in `qpos`, and their
            degrees of freedom.
        time: (N,) s.
    """

    first_link: Any
    xipos: Any
    xmat: Any
    cvel: Any
    subtree_com: Any
    cdof: Any
    qpos: Any
    qfrc_passive: Any
    geom_size: Any
    jnt_stiffness: Any
    qpos_spring: Any
    body_dofadr: Any
    body_dofnum: Any
    geoms: Any
    hinges: Any
    time: Any


@compiled
def device_of(world, arrays):
    """`laws.device.Device` of a world."""
    first = arrays.first_link
    last = first + len(arrays.geoms)
    return DeviceState(
        arrays.xipos[world, first:last],
        arrays.xmat[world, first:last],
        arrays.cvel[world, first:last],
        arrays.subtree_com[world, first:last],
        arrays.geom_size[world % len(arrays.geom_size)],
        arrays.geoms,
        arrays.body_dofadr,
        arrays.body_dofnum,
        arrays.cdof[world],
        arrays.qpos[world],
        arrays.qfrc_passive[world],
        arrays.jnt_stiffness[world % len(arrays.jnt_stiffness)],
        arrays.qpos_spring[world % len(arrays.qpos_spring)],
        arrays.hinges[0],
        arrays.hinges[1],
        arrays.hinges[2],
    )


class Given(NamedTuple):
    """Inputs of a law.

    Attributes:
        parameters: Parameters of the law, of arrays (N, ...).
        arrays: `Arrays`.
        memory: `laws.springs.Scratch` of arrays (N, ...).
    """

    parameters: Any
    arrays: Arrays
    memory: Any


@compiled
def add_drag(world, scratch, all_given):
    """Adds the drag of blood, see `laws.blood`.

    Args:
        world: Its number.
        scratch: Not used.
        all_given: `Given`.
    """
    given = all_given.parameters
    blood = Blood(
        given.density[world],
        given.viscosity[world],
        given.peak[world],
        given.rate[world],
        given.phase[world],
        given.velocity[world],
        given.delay[world],
        given.friction[world],
        given.space_velocity[world],
    )
    time = float(all_given.arrays.time[world])
    drag(blood, time, device_of(world, all_given.arrays))


@compiled
def add_springs(world, scratch, all_given):
    """Adds to the hinge springs the torques of the device's shape, see `laws.springs`.

    Args:
        world: Its number.
        scratch: Not used.
        all_given: `Given`.
    """
    given, memory = all_given.parameters, all_given.memory
    bends = Bends(memory.bends.bends[world], memory.bends.twists[world])
    own = Scratch(memory.angles[world], bends, memory.free[world])
    springs = Springs(given.rest[world], given.compliance[world])
    shape_torques(springs, device_of(world, all_given.arrays), own)


class PassiveForces:
    """Forces of the laws of a task's effects in N worlds."""

    def __init__(
        self, device: Device, places: Places, effects: Iterable[Effect], count: int
    ):
        """Takes the effects that have a law.

        Args:
            device: Device of Warp's arrays.
            places: Indices of the links and hinges in the model.
            effects: Effects, bound to their worlds.
            count: N.

        Raises:
            NotImplementedError: if there is a law that is not simulated on Warp.
        """
        self._device, self._places, self._count = device, places, count
        # The last entry of each: whether its parameters change within an episode.
        self._laws: list[tuple[Any, Any, Any, bool]] = []
        for effect in effects:
            if effect.adapter not in ("blood", "springs"):
                has_law = effect.law is not None or effect.adapter is not None
                if not has_law or effect.adapter in _OF_CONTACTS:
                    continue
                raise NotImplementedError(
                    f"the law of {type(effect).__qualname__} is not simulated on "
                    "Warp; take the device 'cpu'"
                )
            given = effect.world.parameters
            there = type(given)._make(device.constant(np.array(each)) for each in given)
            law = add_drag if effect.adapter == "blood" else add_springs
            changes = law is add_springs or isinstance(effect, Flow)
            self._laws.append((law, given, there, changes))

    def bind(self, model: Any, data: Any, host: mujoco.MjModel) -> None:
        """Binds to the arrays of Warp's model and data, which must not be replaced."""
        view, constant, places = self._device.view, self._device.constant, self._places
        links = slice(places.first_link, places.first_link + len(places.geoms))
        rows = view(data.xmat)
        names = ("cvel", "subtree_com", "cdof", "qpos", "qfrc_passive")
        fields = ("geom_size", "jnt_stiffness", "qpos_spring")
        joints = places.hinges.shape[1] // 2
        bends = (
            np.zeros((self._count, joints), complex),
            np.zeros((self._count, joints)),
        )
        memory = Scratch(
            constant(np.zeros((self._count, 2 * joints))),
            Bends._make(map(constant, bends)),
            constant(np.zeros((self._count, joints, 2))),
        )
        arrays = Arrays._make(
            [
                places.first_link,
                view(data.xipos),
                rows.reshape((*rows.shape[:2], 9)),
                *(view(getattr(data, name)) for name in names),
                *(view(getattr(model, name)) for name in fields),
                constant(host.body_dofadr[links]),
                constant(host.body_dofnum[links]),
                constant(places.geoms.astype(np.int64)),
                constant(places.hinges.astype(np.int64)),
                view(data.time),
            ]
        )
        self._calls = [
            (law, Given(there, arrays, memory)) for law, _, there, _ in self._laws
        ]

    def write(self, whole: bool) -> None:
        """Copies the parameters from the host to the device.

        Args:
            whole: Whether also to copy those that are constant within an episode.
        """
        for _, given, there, changes in self._laws:
            if not (whole or changes):
                continue
            for values, array in zip(given, there, strict=True):
                self._device.write(array, values)

    def __call__(self, model: Any, data: Any) -> None:
        """Adds the forces of all laws; mujoco_warp's callback after its own ones."""
        del model, data
        for law, given in self._calls:
            self._device.launch(law, self._count, NONE, given)
