"""Drives of the base: position servos that follow the command until their clamp slips.

The actuator integrates its command to the place where the servo pulls, MuJoCo's `act`,
with the force at which the clamp slips at most. Once in a control step `act` is set to
where the servo, under its load, holds the base at the place that it has been told;
where the clamp has slipped, that place is where the base stands.
"""

import types
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc.compiled import compiled
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
        addresses = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._places = np.stack([*addresses, model.actuator_actadr[found]])
        gain, spring = model.actuator_gainprm[found, 0], model.actuator_biasprm[found]
        stiffness, limit = -spring[:, 1], model.actuator_forcerange[found, 1]
        reach = gain / stiffness * CONTROL_TIMESTEP
        self._constants = np.stack([gain, stiffness, -spring[:, 2], limit, reach])
        self.slipped, self.told = np.zeros((2, len(arrays.qpos), len(found)))

    def hold(self, index: int) -> None:
        """Sets the command of one simulation to where its base stands."""
        qpos, _, act = self._places
        gain, stiffness = self._constants[:2]
        place = self._arrays.qpos[index, qpos]
        self._arrays.act[index, act] = place * stiffness / gain
        self.told[index] = place
        self.slipped[index] = 0.0

    def follow(self, command: np.ndarray) -> np.ndarray:
        """Corrects the servos for their loads, before a control step.

        Args:
            command: (N, D) in [-1, 1], of the control step to come.

        Returns:
            Way (N, D) by which the clamps have slipped in the last one, m and rad.
        """
        state = self._arrays.qpos, self._arrays.qvel, self._arrays.act
        command, slip = np.ascontiguousarray(command), np.zeros_like(self.told)
        servos = self._places, self._constants, self.told, self.slipped
        _follow(*state, *servos, command, slip)
        return slip


def hold(model: mujoco.MjModel, data: mujoco.MjData) -> Drives:
    """The drives of one simulation, whose commands are set to where the bases stand."""
    arrays = {name: getattr(data, name)[None] for name in ("qpos", "qvel", "act")}
    drives = Drives(model, types.SimpleNamespace(**arrays))
    drives.hold(0)
    return drives


@compiled
def _follow(qpos, qvel, act, places, constants, told, slipped, command, slip):
    """Corrects servos, of a control step to come, see `Drives.follow`."""
    for i in range(len(qpos)):
        for k in range(places.shape[1]):
            gain, stiffness, damping, limit, reach = constants[:, k]
            place = qpos[i, places[0, k]]
            brake = damping * qvel[i, places[1, k]]
            effort = gain * act[i, places[2, k]] - (stiffness * place + brake)
            if abs(effort) >= limit:
                slip[i, k] = told[i, k] - place
                told[i, k] -= slip[i, k]
                slipped[i, k] += abs(slip[i, k])
                effort = min(max(effort, -limit), limit)
            act[i, places[2, k]] = (stiffness * told[i, k] + effort + brake) / gain
            told[i, k] += command[i, k] * reach
