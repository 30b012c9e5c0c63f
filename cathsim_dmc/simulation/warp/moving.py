"""Walls that move, in the contacts of MuJoCo Warp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.simulation.warp.contact_kernels import Scene, Written
from cathsim_dmc.simulation.warp.devices import Device
from cathsim_dmc.simulation.warp.moving_kernels import (
    SCRATCH,
    Carried,
    MovingScene,
    Vessels,
    carry,
    find_moving,
)


class MovingWalls:
    """The motion of the walls of N worlds.

    The velocity of a wall enters the reference of a contact's constraint. On the CPU it
    is a column of the contact's Jacobian, see `physics.adapters.motion`.
    """

    def __init__(self, device: Device, effect: Effect, bore: int):
        """Takes the arguments of `WallContacts.move`."""
        self._device, self._given, self._bore = device, effect.world.parameters, bore
        count = effect.world.num_simulations
        self._places, self._sizes = np.zeros((count, 1, 3)), np.zeros((count, 3))
        self._turns = np.zeros((count, 1, 3, 3))
        everyone, model = np.arange(count), effect.world.model
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self.enter(everyone, model, data)

    def enter(
        self,
        worlds: Sequence[int] | np.ndarray,
        model: mujoco.MjModel,
        data: mujoco.MjData,
    ) -> None:
        """Finds the sheath of some worlds (K,) in a model and its kinematics."""
        if self._bore >= 0:
            self._places[worlds, 0] = data.geom_xpos[self._bore]
            self._turns[worlds, 0] = data.geom_xmat[self._bore].reshape(3, 3)
            self._sizes[worlds] = model.geom_size[self._bore]

    def bind(self, model: Any, data: Any, scene: Scene, written: Written) -> None:
        """Binds to Warp's arrays and to those of the contacts."""
        constant, view = self._device.constant, self._device.view
        given = [constant(np.array(each)) for each in self._given]
        self._vessels = Vessels(
            time=view(data.time),
            parameters=type(self._given)._make(given),
            places=constant(self._places),
            turns=constant(self._turns),
            sizes=constant(self._sizes),
        )
        self._scene = MovingScene(scene, self._vessels)
        self._carried = Carried(
            scene.links, scene.walls, self._vessels, written.out, written.counts,
            written.starts, scene.fields.timestep, view(data.efc.vel),
            view(data.efc.aref),
        )  # fmt: skip

    def place(self) -> None:
        """Copies poses and sizes of the sheaths from the host to the device."""
        self._device.write(self._vessels.places, self._places)
        self._device.write(self._vessels.turns, self._turns)
        self._device.write(self._vessels.sizes, self._sizes)

    def write(self) -> None:
        """Copies the parameters of the motion from the host to the device."""
        for values, array in zip(self._given, self._vessels.parameters, strict=True):
            self._device.write(array, values)

    def find(self, threads: int) -> None:
        """Finds the contacts in a number of threads."""
        self._device.launch(find_moving, threads, SCRATCH, self._scene)

    def carry(self, worlds: int) -> None:
        """Adds the velocities of walls to the rows of constraints."""
        self._device.launch(carry, worlds, SCRATCH, self._carried)
