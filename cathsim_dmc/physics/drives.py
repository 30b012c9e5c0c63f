"""Drives of the base: position servos that follow the command until their clamp slips.

`laws.drive` has the law.
"""

import types
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc.laws import drive
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP


class Drives:
    """The D drives of N simulations: translation, and rotation if there is one.

    Attributes:
        slipped: (N, D), way by which each clamp has slipped in the episode, m and rad.
        told: (N, D), place to which each base has been told to go, m and rad.
    """

    def __init__(self, model: mujoco.MjModel, arrays: Any):
        """Finds the servos; the arrays are views, `qpos`, `qvel` and `act` (N, ...)."""
        found = np.flatnonzero(
            model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR.value
        )
        joints = model.actuator_trnid[found, 0]
        self._arrays = arrays
        gain, spring = model.actuator_gainprm[found, 0], model.actuator_biasprm[found]
        stiffness = -spring[:, 1]
        self._servos = drive.Servos(
            qpos=model.jnt_qposadr[joints],
            dof=model.jnt_dofadr[joints],
            act=model.actuator_actadr[found],
            gain=gain.copy(),
            stiffness=stiffness,
            damping=-spring[:, 2],
            limit=model.actuator_forcerange[found, 1],
            reach=gain / stiffness * CONTROL_TIMESTEP,
        )
        self.slipped, self.told = np.zeros((2, len(arrays.qpos), len(found)))

    def hold(self, index: int) -> None:
        """Sets the command of one simulation to where its base stands."""
        servos = self._servos
        place = self._arrays.qpos[index, servos.qpos]
        self._arrays.act[index, servos.act] = place * servos.stiffness / servos.gain
        self.told[index] = place
        self.slipped[index] = 0.0

    def follow(self, command: np.ndarray) -> np.ndarray:
        """Corrects the servos for their loads, before a control step.

        Args:
            command: (N, D) in [-1, 1], of the control step to come.

        Returns:
            Way (N, D) by which the clamps have slipped in the last one, m and rad.
        """
        arrays, slip = self._arrays, np.zeros_like(self.told)
        state = drive.State(arrays.qpos, arrays.qvel, arrays.act)
        told = drive.Told(self.told, self.slipped, slip)
        drive.follow(self._servos, state, np.ascontiguousarray(command), told)
        return slip


def hold(model: mujoco.MjModel, data: mujoco.MjData) -> Drives:
    """The drives of one simulation, whose commands are set to where the bases stand."""
    arrays = {name: getattr(data, name)[None] for name in ("qpos", "qvel", "act")}
    drives = Drives(model, types.SimpleNamespace(**arrays))
    drives.hold(0)
    return drives
