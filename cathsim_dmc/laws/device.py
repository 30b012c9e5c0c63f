"""State of a device that laws read, and forces that they add to: NamedTuples of views.

L links, J joints of two hinges. World frame, SI units, float64; names are MuJoCo's.
"""

from typing import Any, NamedTuple


class Links(NamedTuple):
    """Links of a device in a physics step, the argument of a law in "control".

    Attributes:
        xipos: (L, 3), centres of mass.
        ximat: (L, 9), orientations of the principal axes, row by row.
        xmat: (L, 9), orientations of the bodies, row by row.
        cvel: (L, 6), rotational and translational velocity about the centre of mass of
            the kinematic tree.
        subtree_com: (L, 3), centres of mass of the subtrees; the first row is that of
            the kinematic tree.
        xfrc_applied: (L, 6), force and torque on the centres of mass, N and N·m. Laws
            add to it; it is 0 before the first law of a physics step.
    """

    xipos: Any
    ximat: Any
    xmat: Any
    cvel: Any
    subtree_com: Any
    xfrc_applied: Any


class Device(NamedTuple):
    """A device in a physics step, the argument of a law in "passive".

    Attributes:
        xipos: (L, 3), centres of mass of the links.
        xmat: (L, 9), orientations of the links, row by row.
        cvel: (L, 6), as of `Links`.
        subtree_com: (L, 3), as of `Links`.
        geom_size: (ngeom, 3), radius and half length of capsules, m.
        geoms: (L,) int64, geoms of the links.
        body_dofadr: (L,) int32, first degree of freedom of each link.
        body_dofnum: (L,) int32, number of degrees of freedom of each link.
        cdof: (nv, 6), motion axis of each degree of freedom about the tree's centre of
            mass, rotation first.
        qpos: (nq,), positions of the joints, m and rad.
        qfrc_passive: (nv,), generalised forces, N and N·m; laws add to them.
        jnt_stiffness: (njnt,), stiffness of the joints' springs, N·m/rad.
        qpos_spring: (nq,), rest positions of these springs, rad.
        hinge_joints: (2 J,) int64, joints of the hinges in the order of the chain.
        hinge_qpos: (2 J,) int64, indices of these joints in `qpos`.
        hinge_dofs: (2 J,) int64, their degrees of freedom.
    """

    xipos: Any
    xmat: Any
    cvel: Any
    subtree_com: Any
    geom_size: Any
    geoms: Any
    body_dofadr: Any
    body_dofnum: Any
    cdof: Any
    qpos: Any
    qfrc_passive: Any
    jnt_stiffness: Any
    qpos_spring: Any
    hinge_joints: Any
    hinge_qpos: Any
    hinge_dofs: Any


class Contact(NamedTuple):
    """A contact of the device with the wall, the argument of a law in "contact".

    Attributes:
        pos: (3), position, m.
        frame: (9), rows: normal from the device into the wall, and two tangents.
        solimp: (5,), impedance of the contact.
        solref: (2,), negative stiffness and damping of the contact; a law changes it.
    """

    pos: Any
    frame: Any
    solimp: Any
    solref: Any
