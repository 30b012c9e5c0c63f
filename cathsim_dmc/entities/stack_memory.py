"""Allocation of what the laws of coaxial devices write, and of their scratch."""

import numpy as np

from cathsim_dmc.laws import coaxial, sliding, torsion
from cathsim_dmc.laws.coaxial import Links, Overlap, Tables
from cathsim_dmc.laws.hinges import Bends


def overlap(tables: Tables) -> Overlap:
    """Allocates an `Overlap` of devices, zeros."""
    devices, joints = len(tables.edges), len(tables.lengths) - 1
    return Overlap(
        compliance=np.zeros(joints),
        rest=np.zeros((devices, joints)),
        coupling=np.zeros((devices * (devices - 1) // 2, joints)),
        stiffness=np.zeros((devices, joints)),
        moment=np.zeros((devices, joints)),
        outermost=np.zeros((devices, joints + 1)),
        present=np.zeros((devices, joints + 1)),
    )


def links(tables: Tables) -> Links:
    """Allocates the `Links` of a chain, zeros."""
    radius, friction, mass, buoyancy = np.zeros((4, len(tables.lengths)))
    inertia = np.zeros((len(tables.lengths), 2))
    return Links(radius, friction, mass, buoyancy, inertia)


def scratch(tables: Tables) -> coaxial.Scratch:
    """Allocates the scratch of the laws of `coaxial`."""
    devices, joints = len(tables.edges), len(tables.lengths) - 1
    return coaxial.Scratch(
        places=np.zeros(tables.edges.size + 1),
        devices=np.zeros((2, devices)),
        pulls=np.zeros(devices, complex),
        joints=np.zeros((2, joints), complex),
    )


def rod_scratch(segments: int) -> torsion.Scratch:
    """Allocates the scratch of `torsion.turned` for rods of `segments` segments."""
    return torsion.Scratch._make(np.zeros((8, segments)))


def chain(tables: Tables) -> sliding.Chain:
    """Allocates the `Chain` of devices, zeros."""
    rest = np.zeros((len(tables.lengths) - 1, 2))
    return sliding.Chain(overlap(tables), rest, links(tables))


def settling(tables: Tables) -> sliding.Scratch:
    """Allocates the scratch of `sliding.settle`."""
    devices, segments = len(tables.edges), len(tables.lengths)
    joints = segments - 1
    return sliding.Scratch(
        coaxial=scratch(tables),
        torsion=rod_scratch(segments),
        bends=Bends(np.zeros(joints, complex), np.zeros(joints)),
        rods=torsion.Rods(np.zeros((devices, segments)), np.zeros(devices)),
        turns=np.zeros((2, devices, joints)),
        loads=np.zeros((3, devices, joints)),
        borne=np.zeros((3, devices, segments)),
        slopes=np.zeros((devices, joints)),
        pressure=np.zeros((devices - 1, joints)),
        gaps=np.zeros((2, devices)),
        shape=np.zeros(joints, complex),
    )
