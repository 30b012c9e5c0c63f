"""Introducer sheath: stiff hinges keep the links inside it on its axis.

A frictionless sheath fixes position and direction of the device at its mouth and
transmits axial forces, whatever its curve. It is therefore simulated as straight: a
joint has the compliance of that part of its rod which is outside the sheath.
"""

from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled

# Fraction of its compliance that a joint keeps in the sheath. A tip that protrudes
# 40 mm from 260 mm of sheath is 18 % too soft with 1e-3, because the part in the sheath
# bends as a cantilever, and 1 % too soft with 1e-6.
LEAST = 1e-6


class Hinges(NamedTuple):
    """Properties of hinges: (J, 2) about x and y of J joints, or MuJoCo's arrays.

    Attributes:
        stiffness: `jnt_stiffness`, N·m/rad.
        damping: `dof_damping`, N·m·s/rad.
        rest: `qpos_spring`, rad.
    """

    stiffness: Any
    damping: Any
    rest: Any


class Joints(NamedTuple):
    """The joints of a chain.

    Attributes:
        joint, dof, qpos: (J, 2), indices of the hinges about x and y in
            `jnt_stiffness`, `dof_damping` and `qpos_spring` of the model.
        behind, ahead: (J,), lengths of rod proximal and distal of the joint that it
            represents, m.
        distal: (J,), fraction of the joint's compliance that belongs to the rod distal
            of it.
    """

    joint: Any
    dof: Any
    qpos: Any
    behind: Any
    ahead: Any
    distal: Any


@compiled
def hold(joints, places, insertion, free, hinges, out):
    """Writes the hinges of a chain that is partly in the sheath.

    Args:
        joints: `Joints`.
        places: (J,), distance of each joint past the mouth of the sheath at insertion
            0, m.
        insertion: Insertion of the chain, m.
        free: `Hinges` of the joints without a sheath.
        hinges: `Hinges` of the model, which are written.
        out: (J,), fraction of each joint's compliance that is out of the sheath,
            written.
    """
    for j in range(len(out)):
        place, ahead = places[j] + insertion, joints.ahead[j]
        before = min(max(place / joints.behind[j], 0.0), 1.0)
        beyond = min(max((place + ahead) / ahead, 0.0), 1.0)
        out[j] = joints.distal[j] * beyond + (1 - joints.distal[j]) * before
        kept = max(out[j], LEAST)
        for axis in range(2):
            joint, dof = joints.joint[j, axis], joints.dof[j, axis]
            hinges.stiffness[joint] = free.stiffness[j, axis] / kept
            hinges.damping[dof] = free.damping[j, axis] / kept
            hinges.rest[joints.qpos[j, axis]] = free.rest[j, axis] * out[j]
