"""Parametric aortic arches: presets, sets of random ones, and their anatomies.

The inlet of the ascending aorta is at the origin of the patient frame LPS. The presets
of types I and II are idealised: straight limbs in a vertical plane. Type III and bovine
curve in space.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.arch.parameters import (
    INLET_TUBE,
    ArchParameters,
    BranchParameters,
)
from cathsim_dmc.anatomy.arch.sampler import VARIANTS, kind_at, sample
from cathsim_dmc.anatomy.arch.tree import arch_tree
from cathsim_dmc.anatomy.builder import ACCESSES, GOAL_DEPTH, VesselPlace

_FROM_CAP = 30e-3  # m, distance of the goal "descending" from the end of the aorta


@lru_cache(maxsize=32)
def build_arch(
    params: ArchParameters, name: str = "arch", *, access: str = "ascending"
) -> Anatomy:
    """Anatomy of an arch: tree, wall, surface, inlet and goals.

    Takes less than half a second. The last 32 results are cached: equal parameters
    give the same object.

    Args:
        access: end of the aorta that is open for the device, "ascending" or
            "descending"; the other one is capped.

    Raises:
        ValueError: if the parameters give no valid arch.
    """
    bounds.choice("access", access, ACCESSES)
    tree = arch_tree(bounds.instance("params", params, ArchParameters))
    inlet = VesselPlace(tree.root.name, 0.0 if access == "ascending" else math.inf)
    goals = {
        branch: VesselPlace(branch, GOAL_DEPTH, past_ostium=True)
        for branch, vessel in tree.vessels.items()
        if vessel.parent is not None
    }
    arc = tree.root.centreline.length - _FROM_CAP
    goals["descending"] = VesselPlace(tree.root.name, arc)
    return Anatomy.from_tree(tree, name, inlet=inlet, goals=goals)


# The published Type-I phantom, as measured: outer width 91 mm, 186 mm from the end
# of the descending aorta to the top of the branches, lumen radii 9.1 (descending),
# 13.8 (arch), 4.4 (BCA) and 3.1 mm (LCCA), targets 15 mm apart and about 130 mm
# from a tip at the inlet. Spacings are the anatomical means, scaled like the branch
# radii; take-offs and lengths are chosen so that the measured figures come out.
TYPE_I = ArchParameters(
    bca=BranchParameters(4.4e-3, 4.2e-3, math.radians(12.0), 43e-3),
    lcca=BranchParameters(3.1e-3, 2.9e-3, math.radians(12.0), 43e-3),
    lsa=BranchParameters(
        3.7e-3, 3.4e-3, math.radians(-20.0), 41e-3, bend_azimuth=math.pi
    ),
    ascending_radius=13.8e-3,
    bca_level_radius=13.8e-3,
    lcca_level_radius=13.0e-3,
    lsa_level_radius=11.5e-3,
    descending_radius=9.1e-3,
    ascending_length=INLET_TUBE + 57e-3,
    descending_length=96.5e-3,
    bca_drop=0.5,
    bca_lcca_spacing=15e-3,
    lcca_lsa_spacing=12e-3,
)
# Anatomical means (61 healthy aortas, 217 and 118 CT studies); the LCCA tapers to
# the mid common carotid. Arch radius as in the measured phantom.
TYPE_II = ArchParameters(
    bca=BranchParameters(6.25e-3, 5.5e-3, math.radians(44.9), 44e-3),
    lcca=BranchParameters(4.14e-3, 3.15e-3, math.radians(25.7), 50e-3),
    lsa=BranchParameters(
        5.2e-3, 4.5e-3, math.radians(-28.8), 45e-3, bend_azimuth=math.pi
    ),
    bca_drop=1.5,
)


def _bent(
    branch: BranchParameters, lean: float, radius: float, azimuth: float
) -> BranchParameters:
    """A branch that leaves the plane of the arch, bends, and bends back half way."""
    return replace(
        branch,
        lean=math.radians(lean),
        length=50e-3,
        bend_radius=radius,
        bend_azimuth=azimuth,
        second_bend_radius=radius,
        second_bend_azimuth=azimuth - math.pi,
    )


# Arches that curve in space, as the sampler's do: sizes are the same anatomical means,
# the limb turns by the sampler's mean, branches lean and bend as far as those of the
# measured phantoms, and root and BCA are 62.6 and 66 mm apart (mean 62.6 ± 11.4). The
# LCCA is one standard deviation steeper than the mean: at the mean of 26 degrees
# upstream it obstructs a device that slides over the top of the arch.
TYPE_III = replace(
    TYPE_II,
    bca=_bent(TYPE_II.bca, 8.0, 45e-3, 0.6),
    lcca=_bent(replace(TYPE_II.lcca, take_off=math.radians(10.0)), 14.0, 40e-3, 0.6),
    lsa=_bent(TYPE_II.lsa, 10.0, 43e-3, math.pi + 0.6),
    bca_drop=2.391,
    ascending_length=45.6e-3,
    descending_length=115e-3,
    ascending_bend=math.radians(30.0),
    sway=4e-3,
)
# The LCCA off the BCA, on an arch nearly as steep; the LSA leans back by half a
# standard deviation more than the mean.
BOVINE = replace(
    TYPE_III,
    lcca=_bent(TYPE_II.lcca, 14.0, 40e-3, 0.6),
    lsa=replace(TYPE_III.lsa, take_off=math.radians(-36.0)),
    bca_drop=2.166,
    ascending_length=43.76e-3,
    bca_lcca_spacing=10e-3,
    lcca_lsa_spacing=36.1e-3,
    bovine=True,
)
ARCHES: Mapping[str, ArchParameters] = {
    "simple1": TYPE_I,
    "simple2": TYPE_II,
    "type3": TYPE_III,
    "bovine": BOVINE,
}


@dataclass(frozen=True)
class ArchSeed:
    """One arch of a set: kind and seed.

    Attributes:
        seed: seed of the `RandomState` that draws the arch.
        arch_type: "I", "II" or "III".
        variant: one of `VARIANTS`.
        neck: whether it has the arteries of neck and arms.
    """

    seed: int
    arch_type: str
    variant: str = "normal"
    neck: bool = False

    @property
    def name(self) -> str:
        """Name of the arch, such as "arch-II-2000049"."""
        variant = "" if self.variant == "normal" else f"-{self.variant}"
        kind = "neck" if self.neck else "arch"
        return f"{kind}-{self.arch_type}{variant}-{self.seed}"

    def parameters(self) -> ArchParameters:
        """Parameters of the arch; the same at every call."""
        source = np.random.RandomState(self.seed)
        return sample(source, self.arch_type, variant=self.variant, neck=self.neck)


_FIRST_SEEDS = {
    "train": 1_000_000,
    "test": 2_000_000,
    "test_variants": 3_000_000,
    "neck": 4_000_000,
    "test_neck": 5_000_000,
}
SETS = tuple(_FIRST_SEEDS)
TRAIN_SIZE = 1000
TEST_SIZE = 98
_VARIANT_SIZE = 12  # of each kind in `test_variants`
_NECK_SIZES = {"neck": 300, "test_neck": 28}
_BOVINE_SHARE, _BOVINE_TRUNK_SHARE = 0.20, 0.78


@lru_cache
def arch_set(name: str) -> tuple[ArchSeed, ...]:
    """The arches of a set; sets are disjoint and never change.

    "train" holds 1,000 arches of all types by prevalence, a fifth of them bovine.
    "test" holds 98 normal arches, 49 of type I and 49 of type II. "test_variants"
    holds 12 each of type III, of both bovine variants and with an aberrant right
    subclavian (which have no BCA: their goals are rcca, lcca, lsa and rsa). "neck" and
    "test_neck" hold 300 and 28 arches drawn as those of "train", with the arteries of
    neck and arms: both carotids, subclavian and vertebral arteries are goals, too.

    Raises:
        ValueError: if there is no such set.
    """
    first = _FIRST_SEEDS[bounds.choice("set of arches", name, SETS)]
    if name == "test":
        kinds = [(kind, "normal") for kind in ("I", "II") * (TEST_SIZE // 2)]
    elif name == "test_variants":
        four = [("III", "normal"), *(("II", one) for one in VARIANTS[1:])]
        kinds = four * _VARIANT_SIZE
    else:
        source = np.random.RandomState(first)
        kinds = []
        for _ in range(_NECK_SIZES.get(name, TRAIN_SIZE)):
            kind, bovine, trunk = source.uniform(size=3)
            variant = "normal"
            if bovine < _BOVINE_SHARE:
                is_trunk = trunk < _BOVINE_TRUNK_SHARE
                variant = "bovine_trunk" if is_trunk else "bovine_branch"
            kinds.append((kind_at(kind), variant))
    return tuple(
        ArchSeed(first + index, kind, variant, name in _NECK_SIZES)
        for index, (kind, variant) in enumerate(kinds)
    )


def build_seed(seed: ArchSeed, *, access: str = "ascending") -> Anatomy:
    """Anatomy of one arch of a set; the same at every call, see `build_arch`."""
    return build_arch(seed.parameters(), seed.name, access=access)
