"""Limbs of an arch that are no aorta, and branches that turn back beside others."""

import numpy as np
from synthetic_scans import tube

from cathsim_dmc.anatomy.centreline import Vessel, VesselTree
from cathsim_dmc.anatomy.scan.aorta import find_aorta
from cathsim_dmc.anatomy.scan.ends import free_ends
from cathsim_dmc.anatomy.scan.tree import _parent
from cathsim_dmc.anatomy.scan.ways import Ways
from cathsim_dmc.anatomy.surface import lumen_surface
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth


def arch_cut_off(beyond: float) -> VesselTree:
    """An aorta cut off `beyond` (degrees) past the artery of an arm (mm)."""
    angle = np.radians(np.linspace(0.0, 130.0 + beyond, 30))
    bow = [(35 * np.cos(a), 0.0, 100 + 35 * np.sin(a)) for a in angle]
    aorta = tube([*((35, 0, z) for z in range(0, 100, 5)), *bow], [11] * 50)
    mouth = 35 * np.cos(np.radians(130.0)), 0.0, 100 + 35 * np.sin(np.radians(130.0))
    arm = tube([mouth, (-34, 0, 152), (-60, 0, 165), (-130, 0, 160)], [4.5, 4.5, 4, 3])
    neck = tube([(0, 0, 134), (2, 0, 160), (4, 0, 230)], [4, 3.5, 3])
    return VesselTree(
        {
            "aorta": Vessel("aorta", aorta),
            "arm": Vessel("arm", arm, "aorta", 12e-3),
            "neck": Vessel("neck", neck, "aorta", 12e-3),
        }
    )


def test_the_artery_of_an_arm_is_no_limb_of_the_aorta():
    ways = Ways(SurfaceDepth(lumen_surface(arch_cut_off(12.0), 1.5e-3)))
    pair, why = find_aorta(ways, free_ends(ways))
    assert pair is None and "as an artery of the arch does" in why


def test_a_branch_is_no_parent_of_what_leaves_the_trunk_far_from_it():
    """It turns back, so that its end is nearest to where the other one leaves."""
    trunk = tube([(0, 0, 0), (0, 0, 150)], [8, 8])
    first = tube([(0, 0, 120), (15, 0, 120), (30, 0, 80)], [3, 3, 3])
    vessels = {
        "aorta": Vessel("aorta", trunk),
        "first": Vessel("first", first, "aorta", 8e-3),
    }
    way = trunk.points[:121] + (0.6e-3, 0, 0)  # of voxels, beside the middle
    lines = {
        "aorta": trunk.points,
        "first": np.concatenate([way + (0.8e-3, 0, 0), first.points[1:]]),
    }
    out = np.linspace(0.0, 60e-3, 60)[1:, None] * (0.8, 0.0, -0.6)
    curve = np.concatenate([way[:31], way[30] + out])

    def depth(points):
        return np.full(np.shape(points)[:-1], 3e-3)

    parent, at = _parent(curve, lines, vessels, depth)
    assert parent == "aorta" and 28 <= at <= 34
