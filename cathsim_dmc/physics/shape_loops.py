"""Springs of a single shaped device, compiled; MuJoCo calls it in every physics step.

The springs of the model have the angles of the unloaded device. Bent and twisted, its
isotropic energy has others (`hinge_loops.free_hinges`); the difference is a passive
force. Taken once in a control step, it lags behind the hinges and pumps energy into
them.
"""

import functools

import numpy as np

from cathsim_dmc.collision import callbacks, native
from cathsim_dmc.collision.native import (
    address_of,
    call_before,
    data_field,
    model_field,
)
from cathsim_dmc.collision.own import parameters_of
from cathsim_dmc.entities.hinge_loops import free_hinges

# The first parameter of an effect with a shape; the others are OF_JOINT a joint: rest
# angle, rad; compliance, rad/(N·m); places in `qpos` and degrees of freedom about x, y.
MARK, OF_JOINT = 2718.0, 6
_SYMBOL = "cathsim_shape"
_before = native.symbol(_SYMBOL, 1)


@native.callback("void(int64, int64)")
def _bend(model, data):
    """Adds what the springs lack to the passive forces of a shaped device."""
    call_before(address_of(_SYMBOL), model, data)
    start, user = parameters_of(model, data, MARK), data_field(data, "userdata")
    if start == 0:
        return
    joints, own = (int(user[start - 1]) - 1) // OF_JOINT, user[start + 1 :]
    qpos, passive = data_field(data, "qpos"), data_field(data, "qfrc_passive")
    stiffness = model_field(model, "jnt_stiffness")
    rest, joint_of = model_field(model, "qpos_spring"), model_field(model, "dof_jntid")
    shape, compliance = np.empty(joints, np.complex128), np.empty(joints)
    angles = np.empty(2 * joints)
    for j in range(joints):
        row = own[OF_JOINT * j :]
        shape[j], compliance[j] = row[0], row[1]
        # The hinge about x comes first in every other joint.
        x, y = qpos[int(row[2])], qpos[int(row[3])]
        angles[2 * j + j % 2], angles[2 * j + 1 - j % 2] = x, y
    free = free_hinges(shape, compliance, angles)
    for j in range(joints):
        for axis in range(2):
            place = int(own[OF_JOINT * j + 2 + axis])
            dof = int(own[OF_JOINT * j + 4 + axis])
            lack = free[j, axis] - rest[place]
            passive[dof] += stiffness[joint_of[dof]] * lack


@functools.cache
def install() -> None:
    """Has MuJoCo add the forces where there is a shape; RuntimeError as `follow`."""
    callbacks.follow("mjcb_passive", _bend, _before)
