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


class Given(NamedTuple):
    """Arguments of a law.

    Attributes:
        parameters: Parameters of the law, of arrays (N, ...).
        first_link: Number of the first link among the bodies.
        device: `laws.device.Device` of Warp's arrays (1 or N, ...), of all bodies.
        time: (N,) s, Warp's.
        memory: `laws.springs.Scratch` of arrays (N, ...).
    """

    parameters: Any
    first_link: int
    device: DeviceState
    time: Any
    memory: Any


@compiled
def device_of(world, given):
    """`laws.device.Device` of a world."""
    first, device = given.first_link, given.device
    last = first + len(device.geoms)
    return DeviceState(
        device.xipos[world, first:last],
        device.xmat[world, first:last],
        device.cvel[world, first:last],
        device.subtree_com[world, first:last],
        device.geom_size[world % len(device.geom_size)],
        device.geoms,
        device.body_dofadr,
        device.body_dofnum,
        device.cdof[world],
        device.qpos[world],
        device.qfrc_passive[world],
        device.jnt_stiffness[world % len(device.jnt_stiffness)],
        device.qpos_spring[world % len(device.qpos_spring)],
        device.hinge_joints,
        device.hinge_qpos,
        device.hinge_dofs,
    )


@compiled
def add_drag(world, scratch, all_given):
    """Adds the drag of blood in a world of `Given`, see `laws.blood`."""
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
    drag(blood, float(all_given.time[world]), device_of(world, all_given))


@compiled
def add_springs(world, scratch, all_given):
    """Adds torques of the device's shape in a world of `Given`, see `laws.springs`."""
    given, memory = all_given.parameters, all_given.memory
    bends = Bends(memory.bends.bends[world], memory.bends.twists[world])
    own = Scratch(memory.angles[world], bends, memory.free[world])
    springs = Springs(given.rest[world], given.compliance[world])
    shape_torques(springs, device_of(world, all_given), own)


_LAWS = {"blood": add_drag, "springs": add_springs}  # by the adapter of an effect


class _Law(NamedTuple):
    """A law of an effect.

    Attributes:
        act: Thread function.
        given: Its parameters on the host, arrays (N, ...).
        parameters: Their copy on the device.
        changes: Whether they change within an episode.
    """

    act: Any
    given: Any
    parameters: Any
    changes: bool


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
        self._laws: list[_Law] = []
        for effect in effects:
            act = _LAWS.get(effect.adapter or "")
            if act is not None:
                given = effect.world.parameters
                changes = act is add_springs or isinstance(effect, Flow)
                self._laws.append(_Law(act, given, device.constant(given), changes))
            elif effect.adapter not in _OF_CONTACTS and (effect.adapter or effect.law):
                raise NotImplementedError(
                    f"the law of {type(effect).__qualname__} is not simulated on "
                    "Warp; take the device 'cpu'"
                )

    def bind(self, model: Any, data: Any, host: mujoco.MjModel) -> None:
        """Binds to the arrays of Warp's model and data, which must not be replaced."""
        view, constant, places = self._device.view, self._device.constant, self._places
        links = slice(places.first_link, places.first_link + len(places.geoms))
        hinges = places.hinges.astype(np.int64)
        turns, joints = view(data.xmat), hinges.shape[1] // 2
        device = self._device.views(
            DeviceState,
            data,
            xmat=turns.reshape((*turns.shape[:2], 9)),
            geom_size=view(model.geom_size),
            geoms=constant(places.geoms.astype(np.int64)),
            body_dofadr=constant(host.body_dofadr[links]),
            body_dofnum=constant(host.body_dofnum[links]),
            jnt_stiffness=view(model.jnt_stiffness),
            qpos_spring=view(model.qpos_spring),
            hinge_joints=constant(hinges[0]),
            hinge_qpos=constant(hinges[1]),
            hinge_dofs=constant(hinges[2]),
        )
        shape = self._count, joints
        bends = Bends(np.zeros(shape, complex), np.zeros(shape))
        own = Scratch(np.zeros((shape[0], 2 * joints)), bends, np.zeros((*shape, 2)))
        first, time, memory = places.first_link, view(data.time), constant(own)
        self._calls = [
            (law.act, Given(law.parameters, first, device, time, memory))
            for law in self._laws
        ]

    def write(self, whole: bool) -> None:
        """Copies the parameters from the host to the device.

        Args:
            whole: Whether also to copy those that are constant within an episode.
        """
        for law in self._laws:
            if whole or law.changes:
                self._device.write(law.parameters, law.given)

    def __call__(self, model: Any, data: Any) -> None:
        """Adds the forces of all laws; mujoco_warp's callback after its own ones."""
        del model, data
        for law, given in self._calls:
            self._device.launch(law, self._count, NONE, given)
