"""Contacts with walls that move, written into the arrays of MuJoCo Warp."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc.collision.fields import Registered
from cathsim_dmc.physics.effects import Effect, of_kind
from cathsim_dmc.physics.motion import Moving
from cathsim_dmc.simulation.warp.contacts import WallContacts
from cathsim_dmc.simulation.warp.devices import Device
from cathsim_dmc.simulation.warp.moving_kernels import (
    SCRATCH,
    Boxes,
    Carried,
    MovingScene,
    Vessels,
    carry,
    find_moving,
)


class MovingContacts(WallContacts):
    """Contacts of the devices of N worlds with walls that move.

    The velocity of a wall enters the reference of a contact's constraint. On the CPU it
    is a column of the contact's Jacobian, see `physics.adapters.motion`.
    """

    def __init__(self, device: Device, model: mujoco.MjModel, num_worlds: int):
        """Takes the arguments of `WallContacts`."""
        kind = mujoco.mjtObj.mjOBJ_GEOM
        self._bore = mujoco.mj_name2id(model, kind, "sheath/bore")
        shapes = Boxes((1, 3), (1, 3, 3), (3,))
        self._boxes = Boxes._make(np.zeros((num_worlds, *each)) for each in shapes)
        super().__init__(device, model, num_worlds)

    def enter(
        self,
        worlds: Sequence[int] | np.ndarray,
        model: mujoco.MjModel,
        data: mujoco.MjData,
    ) -> None:
        """Sets the walls and the sheath of some worlds (K,)."""
        super().enter(worlds, model, data)
        if self._bore >= 0:
            self._boxes.places[worlds, 0] = data.geom_xpos[self._bore]
            self._boxes.turns[worlds, 0] = data.geom_xmat[self._bore].reshape(3, 3)
            self._boxes.sizes[worlds] = model.geom_size[self._bore]

    def take(self, effects: Iterable[Effect]) -> None:
        """Takes the parameters (N,) of the motion."""
        effect: Any = of_kind(effects, Moving)
        self._given = effect.world.parameters

    def bind(self, model: Any, data: Any) -> None:
        """Binds to the arrays of Warp's model and data, which must not be replaced."""
        super().bind(model, data)
        device, view = self._device, self._device.view
        own = device.constant(self._given), device.constant(self._boxes)
        self._vessels = Vessels(view(data.time), own[0], own[1])
        self._moving = MovingScene(self._scene, self._vessels)
        self._carried = Carried(
            links=self._links,
            walls=self._walls,
            vessels=self._vessels,
            contacts=self._written.out,
            counts=self.counts,
            starts=self.starts,
            timestep=view(model.opt.timestep),
            velocity=view(data.efc.vel),
            reference=view(data.efc.aref),
        )

    def _place(self) -> None:
        super()._place()
        self._device.write(self._vessels.boxes, self._boxes)

    def write(self) -> None:
        """Copies the parameters of the motion from the host to the device."""
        self._device.write(self._vessels.parameters, self._given)

    def _find(self) -> None:
        self._device.launch(find_moving, self._threads, SCRATCH, self._moving)

    def carry(self) -> None:
        """Adds velocities of the walls to the rows of constraints, once these exist."""
        self._device.launch(carry, self.num_worlds, SCRATCH, self._carried)

    def _lattice(self, wall: Registered) -> np.ndarray:
        return super()._lattice(wall) if wall.lattice is None else wall.lattice
