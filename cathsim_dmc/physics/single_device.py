"""One device of N simulations, moved by the actions: drives, sheath and tip motors."""

from typing import Any, NamedTuple

import numpy as np
from numpy.random import RandomState

from cathsim_dmc import rows
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.robot import pose
from cathsim_dmc.laws import sheath
from cathsim_dmc.laws.hinges import Bends
from cathsim_dmc.laws.springs import Springs
from cathsim_dmc.physics import held
from cathsim_dmc.physics.device_points import BEHIND
from cathsim_dmc.physics.drives import Drives
from cathsim_dmc.physics.effects import Draw, Effect, World
from cathsim_dmc.physics.readings import CoaxialReadings, Readings


class Steering(NamedTuple):
    """Data to turn motor commands from untwisted frames into those of the links.

    Attributes:
        places: (2 J,), indices of the hinges in `qpos`, in the order of the chain.
        bends: `laws.hinges.Bends`, scratch.
    """

    places: Any
    bends: Any


class SingleDevice(Effect):
    """One device, moved by its own motors.

    Attributes:
        slipped: (N, D), slip of the clamp of each drive in the episode, m and rad.
    """

    data_fields: tuple[str, ...] = ("act",)
    model_fields: tuple[str, ...] = held.FIELDS
    step_fields: tuple[str, ...] = held.FIELDS
    state = ("slipped", "told", "_free")

    def __init__(self, chain: Chain, holds: bool = True):
        """Takes the entity of the device.

        Args:
            holds: Whether stiff hinges hold the links in the sheath, instead of contact
                with its bore.
        """
        self._device, self._holds = chain.device, holds
        self._behind = BEHIND / float(chain.link_lengths[0])  # lengths of a link
        if self._device.tip_shape:
            self.parameters = Springs
            self.acts_in, self.adapter = "passive", "springs"

    def bind(self, world: World) -> None:
        """Finds the drives and the hinges in the model."""
        super().bind(world)
        self._drives = Drives(world.model, world.arrays, world.index.driven)
        self.slipped, self.told = self._drives.slipped, self._drives.told
        model, places = world.model, world.index.bends_qpos
        joints, self._steering = len(places), None
        if world.chain.tip_motors:
            bends = Bends(np.empty(joints, complex), np.empty(joints))
            self._steering = Steering(np.sort(places, axis=None), bends)
        hinges_x = np.searchsorted(model.jnt_qposadr, places[:, 0])
        # The shape lies in the plane of x and z.
        rest = model.qpos_spring[places[:, 1]]
        self._springs = Springs(rest, 1 / model.jnt_stiffness[hinges_x])
        self._held = held.Held(model, world.chain, places)
        self._sheathed = held.Sheathed(
            joints=self._held.joints,
            depths=self._held.ends + world.start_depth[:, None],
            insertion=world.arrays.qpos[:, world.index.insertion_qpos],
            free=np.stack([self._held.nominal] * world.num_simulations),
            places=np.zeros((world.num_simulations, len(held.FIELDS)), np.int64),
            out=np.ones((world.num_simulations, joints)),
        )
        self._free = self._sheathed.free
        self._hinged: list[Any] = [None] * world.num_simulations
        turned = world.index.rotation_qpos
        rotation = -1 if turned is None else turned
        self._base = np.array([world.index.insertion_qpos, rotation])

    def enter(self, index: int, anatomy: Anatomy) -> None:
        """Takes the place of the sheath's mouth in the anatomy of one simulation."""
        depths = self._held.ends + self.world.start_depth[index]
        self._sheathed.depths[index] = depths

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Holds the base of one simulation in place, and its links in the sheath."""
        self._drives.hold(index)
        if self.parameters is Springs:
            self.world.parameters.rest[index] = self._springs.rest
            self.world.parameters.compliance[index] = self._springs.compliance
        if not self._holds:
            return
        from cathsim_dmc.physics import adapters  # late, as numba takes long

        self._find_hinges(index)
        self._free[index] = self._held.read(self._hinged[index])
        adapters.hold_links(self._sheathed, index, index + 1)
        self._soften(slice(index, index + 1))

    def _find_hinges(self, index: int) -> None:
        fields = held.fields_of(lambda name: self.world.field(index, name))
        self._hinged[index] = fields  # keeps the arrays at these addresses alive
        self._sheathed.places[index] = held.addresses(fields)

    def _soften(self, rows: slice) -> None:
        """Writes the springs of pre-shaped devices that are partly in the sheath."""
        if self.parameters is Springs:
            free, out = self._free[rows, 0, :, 0], self._sheathed.out[rows]
            self.world.parameters.rest[rows] = self._springs.rest * out
            stiffness = free / np.maximum(out, sheath.LEAST)
            self.world.parameters.compliance[rows] = 1 / stiffness

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Updates the drives, turns motors against the twist, and poses the robot."""
        from cathsim_dmc.physics import adapters  # late, as numba takes long

        load = state.push_force[:, None]
        if self._drives.slipped.shape[1] > 1:
            load = np.stack([state.push_force, state.push_torque], axis=1)
        control, sheathed = action.copy(), self._sheathed if self._holds else None
        drives, steering = self._drives.bound, self._steering
        robot = self._base, self.world.index.robot_qpos

        def move(own: slice) -> None:
            memory = steering
            if memory is not None:
                bends = Bends._make(map(np.empty_like, memory.bends))
                memory = memory._replace(bends=bends)
            held_ = sheathed and sheathed.of(own)
            adapters.act(drives.of(own), held_, memory, robot, load[own], control[own])

        if len(control) < rows.MANY:
            adapters.act(drives, sheathed, steering, robot, load, control)
        else:
            rows.each(len(control), move)
        if self._holds:
            self._soften(slice(None))
        return control

    def pose_robot(self) -> None:
        """Poses the robot that holds the devices."""
        index = self.world.index
        pose(self.world.arrays.qpos, self._base, index.robot_qpos)

    def courses(self, line: np.ndarray) -> list[tuple[Device, np.ndarray]]:
        """The devices and their points (N, n, 3) on a line (N, L + 1, 3), m.

        From the innermost outwards; the points begin `BEHIND` behind the base.
        """
        first = line[:, :1] + self._behind * (line[:, :1] - line[:, 1:2])
        return [(self._device, np.concatenate([first, line], axis=1))]

    def read(self, readings: Readings) -> CoaxialReadings | None:
        """State of coaxial devices at some readings; None for a single device."""
        return None
