"""Drives of the base: position servos that follow the command until their clamp slips.

The actuator integrates its command to the place where the servo pulls, MuJoCo's `act`.
Its force is limited to that at which the clamp slips, like Coulomb friction. Once in a
control step `act` is set to where the servo, under the load that it bears, holds the
base at the place that it has been told; where the clamp has slipped, that place is
where the base stands.
"""

from __future__ import annotations

import types
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP


class Drives:
    """The D drives of N simulations: translation, and rotation if there is one.

    Attributes:
        slipped: (N, D), way by which each clamp has slipped in the episode, m and rad.
        told: (N, D), place to which each base has been told to go, m and rad.
    """

    def __init__(self, model: mujoco.MjModel, arrays: Any):
        """Finds the servos.

        Args:
            arrays: `qpos`, `qvel` and `act` (N, ...), views.
        """
        found = np.flatnonzero(
            model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR.value
        )
        joints = model.actuator_trnid[found, 0]
        self._arrays = arrays
        # Whole numbers of the size that numpy indexes with: others are cast each time.
        self._places = model.actuator_actadr[found].astype(np.intp)
        self._qpos = model.jnt_qposadr[joints].astype(np.intp)
        self._dofs = model.jnt_dofadr[joints].astype(np.intp)
        self._gain = model.actuator_gainprm[found, 0]
        self._stiffness = -model.actuator_biasprm[found, 1]
        self._damping = -model.actuator_biasprm[found, 2]
        self._limit = model.actuator_forcerange[found, 1]
        count = len(arrays.qpos)
        self.slipped = np.zeros((count, len(found)))
        self.told = np.zeros((count, len(found)))

    def hold(self, index: int) -> None:
        """Sets the command of one simulation to where its base stands."""
        place = self._arrays.qpos[index, self._qpos]
        self._arrays.act[index, self._places] = place * self._stiffness / self._gain
        self.told[index] = place
        self.slipped[index] = 0.0

    def follow(self, command: np.ndarray) -> np.ndarray:
        """Corrects the servos for their loads, before a control step.

        Args:
            command: (N, D) in [-1, 1], of the control step to come.

        Returns:
            Way (N, D) by which the clamps have slipped in the last one, m and rad.
        """
        place = self._arrays.qpos[:, self._qpos]
        brake = self._damping * self._arrays.qvel[:, self._dofs]
        effort = self._gain * self._arrays.act[:, self._places]
        effort -= self._stiffness * place + brake
        slips = np.abs(effort) >= self._limit
        slip = np.zeros_like(place)
        if np.count_nonzero(slips):  # which is rare, and takes long to work out
            slip[slips] = (self.told - place)[slips]
            self.told -= slip
            self.slipped += np.abs(slip)
            effort = np.clip(effort, -self._limit, self._limit)
        pulled = self._stiffness * self.told + effort + brake
        self._arrays.act[:, self._places] = pulled / self._gain
        self.told += command * (self._gain / self._stiffness * CONTROL_TIMESTEP)
        return slip


def hold(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Sets the commands of all drives to where their bases stand."""
    arrays = {name: getattr(data, name)[None] for name in ("qpos", "qvel", "act")}
    Drives(model, types.SimpleNamespace(**arrays)).hold(0)
