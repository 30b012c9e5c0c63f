"""Drives of the base: position servos that follow the command until their clamp slips.

`laws.drive` has the law.
"""

import math
import types
from typing import Any, NamedTuple

import mujoco
import numpy as np

from cathsim_dmc.laws import drive
from cathsim_dmc.physics.readings import part
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP


class Bound(NamedTuple):
    """Arguments of `laws.drive` for N simulations.

    Attributes:
        servos: `laws.drive.Servos`.
        state: `laws.drive.State`, views.
        told: `laws.drive.Told`.
    """

    servos: Any
    state: Any
    told: Any

    def of(self, rows: slice) -> "Bound":
        """Returns the arguments for some of the simulations."""
        return Bound(self.servos, part(self.state, rows), part(self.told, rows))


class Drives:
    """The D drives of N simulations: translation, and rotation if there is one.

    Attributes:
        slipped: (N, D), slip of each clamp in the episode, m and rad.
        bound: Servos, state and commanded places, for compiled functions.
        told: (N, D), place at which each base comes to rest without a further command,
            m and rad; a base in motion lags it.
    """

    def __init__(self, model: mujoco.MjModel, arrays: Any, driven: slice = slice(None)):
        """Finds the servos.

        Args:
            arrays: Lasting views (N, ...) of MuJoCo's arrays.
            driven: Actuators of the device; all by default.
        """
        integrator = mujoco.mjtDyn.mjDYN_INTEGRATOR.value
        found = np.arange(model.nu)[driven]
        found = found[model.actuator_dyntype[driven] == integrator]
        joints = model.actuator_trnid[found, 0]
        self._arrays, dofs = arrays, model.jnt_dofadr[joints]
        gain, spring = model.actuator_gainprm[found, 0], model.actuator_biasprm[found]
        stiffness, speed = -spring[:, 1], gain / -spring[:, 1]
        # A step s of the rest place moves a critically damped mass at s √(K/m) / e.
        rise = np.sqrt(stiffness * model.dof_armature[dofs]) * speed * math.e
        servos = drive.Servos(
            qpos=model.jnt_qposadr[joints],
            dof=dofs,
            act=model.actuator_actadr[found],
            gain=gain.copy(),
            stiffness=stiffness,
            damping=model.opt.timestep * stiffness - spring[:, 2],
            limit=model.actuator_forcerange[found, 1],
            reach=speed * CONTROL_TIMESTEP,
            rise=rise,
        )
        self._sensed = np.array([_load_sensor(model, joint) for joint in joints])
        self.slipped, self.told = np.zeros((2, len(arrays.qpos), len(found)))
        self.bound = Bound(
            servos=servos,
            state=drive.State(arrays.qpos, arrays.qvel, arrays.act),
            told=drive.Told(self.told, self.slipped),
        )

    def hold(self, index: int) -> None:
        """Sets the command of one simulation to where its base stands."""
        servos = self.bound.servos
        place = self._arrays.qpos[index, servos.qpos]
        self._arrays.act[index, servos.act] = place * servos.stiffness / servos.gain
        self.told[index] = place
        self.slipped[index] = 0.0

    def resting(self) -> np.ndarray:
        """Places (N, D) at which the bases come to rest after slip, m and rad."""
        slip = np.empty_like(self.told)
        drive.slip(self.bound.servos, self.bound.state, slip)
        return self.told - slip

    def follow(self, command: np.ndarray, load: np.ndarray | None = None) -> np.ndarray:
        """Subtracts slip from the commands, compensates loads, before a control step.

        Args:
            command: (N, D) in [-1, 1], of the control step to come.
            load: (N, D), force of each platform on its device, N and N·m; that of the
                sensors if None.

        Returns:
            Slip (N, D) of the clamps in the last control step, m and rad.
        """
        slip = np.empty_like(self.told)
        if load is None:
            load = self._arrays.sensordata[:, self._sensed]
        command, load = map(np.ascontiguousarray, (command, load))
        bound = self.bound
        drive.follow(bound.servos, bound.state, command, load, bound.told, slip)
        return slip


def hold(
    model: mujoco.MjModel, data: mujoco.MjData, driven: slice = slice(None)
) -> Drives:
    """Returns the drives of one simulation, commanded to hold their bases in place."""
    names = ("qpos", "qvel", "act", "sensordata")
    arrays = {name: getattr(data, name)[None] for name in names}
    drives = Drives(model, types.SimpleNamespace(**arrays), driven)
    drives.hold(0)
    return drives


def _load_sensor(model: mujoco.MjModel, joint: int) -> int:
    """Index in `sensordata` of the force or torque of a platform on its device."""
    slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE.value
    kind = mujoco.mjtSensor.mjSENS_FORCE if slides else mujoco.mjtSensor.mjSENS_TORQUE
    bodies = model.site_bodyid[model.sensor_objid * (model.sensor_type == kind.value)]
    measures = (model.sensor_type == kind.value) & (bodies == model.jnt_bodyid[joint])
    # Its site has the axes of the device, whose z is that of the joint.
    return int(model.sensor_adr[np.flatnonzero(measures)[0]]) + 2
