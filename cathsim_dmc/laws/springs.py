"""Springs of a device with a shape: torques that those of an engine lack.

The springs of the hinges have the rest angles of the unloaded device. Bent and twisted,
its isotropic energy has others (`hinges.free_hinges`); the difference is a passive
force. Taken once in a control step, it lags behind the hinges and pumps energy into
them.
"""

from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.hinges import free_hinges
from cathsim_dmc.laws.parameters import Array


class Springs(NamedTuple):
    """The joints of a device whose shape lies in the plane of x and z.

    Attributes:
        rest: (J,), angles about y, rad.
        compliance: (J,), rad/(N·m).
    """

    rest: Any = Array("joints")
    compliance: Any = Array("joints")


class Scratch(NamedTuple):
    """Memory of the law.

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
    """Adds the torques that the springs of the hinges lack.

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
