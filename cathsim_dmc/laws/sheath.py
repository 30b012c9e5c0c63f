"""Sheath: the hinges of the links in it are so stiff that they stay on its axis.

A frictionless sheath fixes place and direction of its mouth, and passes axial forces
on, whatever line it follows before. It is simulated as a straight one: a joint has the
compliance of the part of the rod about it that is out of the sheath.
"""

from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.compiled import compiled

# Share of its compliance that a joint keeps in the sheath. With 1e-3 the part in the
# sheath bends as a cantilever, and a tip that stands 40 mm out of 260 mm of sheath is
# 18 % too soft, with 1e-6 it is 1 % too soft.
LEAST = 1e-6


class Hinges(NamedTuple):
    """Hinges about x and y of J joints, (J, 2), or all of a model, MuJoCo's arrays.

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
        joint, dof, qpos: (J, 2), places of the hinges about x and y among `Hinges` of
            the model.
        place: (J,), m past the mouth of the sheath at insertion 0.
        behind, ahead: (J,), lengths of the rod before and beyond the joint that it
            stands for, m.
        distal: (J,), fraction of its compliance that is that of the rod beyond it.
    """

    joint: Any
    dof: Any
    qpos: Any
    place: Any
    behind: Any
    ahead: Any
    distal: Any


def held_stiffness(stiffness, out):
    """Stiffness, N·m/rad, of joints of whose compliance a fraction is in no sheath."""
    return stiffness / np.maximum(out, LEAST)


@compiled
def hold(joints, insertion, free, hinges, out):
    """Writes the hinges of a chain of which a part is in the sheath.

    Args:
        joints: `Joints`.
        insertion: Of the chain, m.
        free: `Hinges` of the joints without a sheath.
        hinges: `Hinges` of the model, which are written.
        out: (J,), fraction of each joint's compliance that is out of the sheath,
            written.
    """
    for j in range(len(out)):
        place, ahead = joints.place[j] + insertion, joints.ahead[j]
        before = min(max(place / joints.behind[j], 0.0), 1.0)
        beyond = min(max((place + ahead) / ahead, 0.0), 1.0)
        out[j] = joints.distal[j] * beyond + (1 - joints.distal[j]) * before
        kept = max(out[j], LEAST)
        for axis in range(2):
            joint, dof = joints.joint[j, axis], joints.dof[j, axis]
            hinges.stiffness[joint] = free.stiffness[j, axis] / kept
            hinges.damping[dof] = free.damping[j, axis] / kept
            hinges.rest[joints.qpos[j, axis]] = free.rest[j, axis] * out[j]
