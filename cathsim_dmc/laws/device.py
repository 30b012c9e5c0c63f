"""State of a device that laws read, and forces that they add to: NamedTuples of views.

L links, J joints of two hinges. World frame, SI units, float64; names are MuJoCo's.
"""

from typing import Any, NamedTuple


class Links(NamedTuple):
    """The links of a device in a physics step, of a law that acts in "control".

    Attributes:
        xipos: (L, 3), centres of mass.
        ximat: (L, 9), orientations of the principal axes, row by row.
        xmat: (L, 9), orientations of the bodies, row by row.
        cvel: (L, 6), rotational and translational velocity about the centre of mass of
            the kinematic tree.
        subtree_com: (L, 3), that centre is the first row.
        xfrc_applied: (L, 6), force and torque on the centres of mass, N and N·m, 0
            before the first law of a physics step, to be added to.
    """

    xipos: Any
    ximat: Any
    xmat: Any
    cvel: Any
    subtree_com: Any
    xfrc_applied: Any


class Device(NamedTuple):
    """A device in a physics step, of a law that acts in "passive".

    Attributes:
        xipos: (L, 3), centres of mass of the links.
        xmat: (L, 9), orientations of the links, row by row.
        cvel: (L, 6), as of `Links`.
        subtree_com: (L, 3), as of `Links`.
        geom_size: (ngeom, 3), radius and half length of capsules, m.
        geoms: (L,) int64, geoms of the links.
        body_dofadr: (L,) int32, first degree of freedom of each link.
        body_dofnum: (L,) int32, how many it has.
        cdof: (nv, 6), motion of each degree of freedom about the tree's centre of mass.
        qpos: (nq,), positions of the joints, m and rad.
        qfrc_passive: (nv,), generalised forces, N and N·m, to be added to.
        jnt_stiffness: (njnt,), of the springs of the joints, N·m/rad.
        qpos_spring: (nq,), positions at which these have no torque, rad.
        hinge_joints: (2 J,) int64, joints of the hinges in the order of the chain.
        hinge_qpos: (2 J,) int64, their places in `qpos`.
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
    """A contact of the device with the wall, of a law that acts in "contact".

    Attributes:
        pos: (3), place, m.
        frame: (9), rows: normal from the device into the wall, and two tangents.
        solimp: (5,), impedance of the contact.
        solref: (2,), stiffness and damping of the contact, to be changed.
    """

    pos: Any
    frame: Any
    solimp: Any
    solref: Any
