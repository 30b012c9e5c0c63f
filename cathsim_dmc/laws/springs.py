"""Springs of a pre-shaped device: torques that an engine's hinge springs lack.

The engine's springs have the rest angles of the unloaded device. In a bent and twisted
device, the isotropic energy has other rest angles (`hinges.free_hinges`). The
difference acts as a passive torque in every physics step: updated once per control
step, it would lag behind the hinges and add energy to them.
"""

from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.hinges import free_hinges
from cathsim_dmc.laws.parameters import Array


class Springs(NamedTuple):
    """Joints of a device whose shape lies in the x-z plane.

    Attributes:
        rest: (J,), rest angles about y, rad.
        compliance: (J,), rad/(N·m).
    """

    rest: Any = Array("joints")
    compliance: Any = Array("joints")


class Scratch(NamedTuple):
    """Scratch arrays of the law.

    Attributes:
        angles: (2 J,), rad.
        bends: `hinges.Bends`.
        free: (J, 2), rad.
    """

    angles: Any
    bends: Any
    free: Any


@compiled
def shape_torques(springs, device, scratch):
    """Adds to `qfrc_passive` the torques that the hinge springs lack.

    Args:
        springs: `Springs`.
        device: `device.Device`.
        scratch: `Scratch`.
    """
    angles, free = scratch.angles, scratch.free
    for hinge in range(len(angles)):
        angles[hinge] = device.qpos[device.hinge_qpos[hinge]]
    free_hinges(springs.rest, springs.compliance, angles, scratch.bends, free)
    for j in range(len(free)):
        for axis in range(2):
            # The hinge about x comes first in every other joint.
            hinge = 2 * j + (axis + j) % 2
            lack = free[j, axis] - device.qpos_spring[device.hinge_qpos[hinge]]
            stiffness = device.jnt_stiffness[device.hinge_joints[hinge]]
            device.qfrc_passive[device.hinge_dofs[hinge]] += stiffness * lack
