"""Random aortic arches from anatomical distributions."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import measures
from cathsim_dmc.anatomy.arch.draws import Random, normal, uniform
from cathsim_dmc.anatomy.arch.neck import sample_neck
from cathsim_dmc.anatomy.arch.parameters import ArchParameters, BranchParameters
from cathsim_dmc.anatomy.arch.tree import arch_tree
from cathsim_dmc.anatomy.centreline import VesselTree

# Range of the BCA drop in LCCA diameters for each type of arch.
DROP_RANGES = {"I": (0.0, 1.0), "II": (1.0, 2.0), "III": (2.0, 3.0)}
# How the branches leave the arch. Bovine: a common trunk of BCA and LCCA (78 %), or
# the LCCA off the BCA further on (22 %). Aberrant: the right subclavian artery leaves
# last and passes behind; the right carotid leaves first.
VARIANTS = ("normal", "bovine_trunk", "bovine_branch", "aberrant")
_PREVALENCE = (0.336, 0.434, 0.230)  # of types I, II and III in a published cohort
# Mean and standard deviation of the lumen diameters of the aorta, m (61 aortas).
AORTA_DIAMETERS = {
    "ascending_radius": (29.5e-3, 3.9e-3),
    "bca_level_radius": (28.6e-3, 3.9e-3),
    "lcca_level_radius": (27.1e-3, 3.2e-3),
    "lsa_level_radius": (25.3e-3, 3.0e-3),
    "descending_radius": (23.9e-3, 3.3e-3),
}
# The same for branch diameters at the origin, m (217 CT angiographies) ...
BRANCH_DIAMETERS = {
    "bca": (12.5e-3, 1.95e-3),
    "lcca": (8.28e-3, 1.51e-3),
    "lsa": (10.4e-3, 2.2e-3),
}
# ... and take-off angles, degrees, upstream positive (118 CT studies).
TAKE_OFFS = {"bca": (44.9, 15.9), "lcca": (25.7, 15.5), "lsa": (-28.8, 14.5)}
# From the root to the BCA along the centreline, m; angle of the plane of the arch from
# the sagittal plane, degrees (BCA-LSA line).
ASCENDING_LENGTH = (62.6e-3, 11.4e-3)
PLANE_ROTATION = (50.3, 13.8)
# Spacing of the ostia BCA-LCCA and LCCA-LSA, m; least wall between flared ostia, m.
SPACINGS = (21.8e-3, 14.3e-3)
_WALL = 2e-3
# Assumed, as no table gives them: spread around the two measured phantoms.
ASCENDING_BEND = (30.0, 12.0)  # degrees
_PLANE_TILT = (0.0, 6.0)  # degrees
_SWAY = (4e-3, 3e-3)  # m
_BOW = (0.0, 3e-3)  # m
_LEAN = (5.0, 12.0)  # degrees
_TIGHTEST_BRANCH_BEND = 4.0  # lumen radii
_WIDEST_BRANCH_BEND = 65e-3  # m
_DESCENDING_BEND = (0.0, 5.0)  # degrees
_ARCH_RADIUS = (34e-3, 3.4e-3)  # m
_ARCH_ASPECT = (0.9, 1.15)
_DESCENDING_LENGTH = (105e-3, 125e-3)  # m, below the arch
_AORTA_CORRELATION = 0.8  # of the levels of one aorta; an assumption
_ATTEMPTS = 1000
_CORRECTIONS = 5  # at most, of drop and ascending length towards the drawn values
_LENGTH_TOLERANCE, _DROP_TOLERANCE = 2e-3, 0.05  # m; LCCA diameters
_SHORTEST_LIMB = 6e-3  # m
_LIMB_BEND = 1.4  # least radius of a limb's bend, in widest radii of the lumen


def sample(
    random_state: Random,
    arch_type: str,
    *,
    variant: str = "normal",
    neck: bool = False,
) -> ArchParameters:
    """Random arch from the anatomical distributions whose measured type is `arch_type`.

    The same random state gives the same arch.

    Args:
        random_state: Source of all draws.
        arch_type: "I", "II" or "III".
        variant: One of `VARIANTS`.
        neck: Whether to draw the arteries of neck and arms; not with "aberrant".

    Raises:
        ValueError: if there is no such type or variant, or neck with "aberrant".
        RuntimeError: if no attempt gives a valid arch.
    """
    if neck and variant == "aberrant":
        raise ValueError("an aberrant arch has no neck; leave out one of the two")
    bounds.choice("arch_type", arch_type, DROP_RANGES)
    bounds.choice("variant", variant, VARIANTS)
    for _ in range(_ATTEMPTS):
        # Independent draws occasionally give branches that intersect: draw again.
        drop = uniform(random_state, DROP_RANGES[arch_type])
        try:
            params = _draw(random_state, drop, variant)
            length = normal(random_state, ASCENDING_LENGTH)
            params, tree = _corrected(params, drop, length)
            if neck:
                params = replace(params, neck=sample_neck(random_state, tree))
        except ValueError:
            continue
        return params
    raise RuntimeError(f"no valid arch of type {arch_type} in {_ATTEMPTS} attempts.")


def kind_at(share: float) -> str:
    """Type of arch at a quantile (0 to 1) of the cohort, ordered by type."""
    place = np.searchsorted(np.cumsum(_PREVALENCE), share)
    return list(DROP_RANGES)[min(int(place), 2)]


def _corrected(
    params: ArchParameters, drop: float, ascending: float
) -> tuple[ArchParameters, VesselTree]:
    """Corrects an arch until its measured drop and ascending length are those drawn.

    Returns:
        The corrected parameters and their tree.

    Raises:
        ValueError: if the corrections do not converge, or the arch is measured as
            another type.
    """
    bend = params.ascending_bend
    for _ in range(_CORRECTIONS):
        tree = arch_tree(params)
        found = measures.bca_drop(tree)
        first = next(one for one in tree.vessels.values() if one.parent)
        short = ascending - tree.root.centreline.locate(first.mouth.position)
        low = drop - found
        if abs(short) < _LENGTH_TOLERANCE and abs(low) < _DROP_TOLERANCE:
            break
        limb = max(params.ascending_length + short, _SHORTEST_LIMB)
        widest = float(tree.root.centreline.radii.max())
        params = replace(
            params,
            bca_drop=max(params.bca_drop + low, 0.0),
            ascending_length=limb,
            ascending_bend=min(bend, limb / (_LIMB_BEND * widest)),
        )
    else:
        raise ValueError(f"no arch of the drop {drop:.2f} and so long")
    if measures.arch_type(drop) != measures.arch_type(found):
        raise ValueError(f"an arch of the drop {drop:.2f} is measured as {found:.2f}")
    return params, tree


def _draw(source: Random, drop: float, variant: str) -> ArchParameters:
    share, common = math.sqrt(_AORTA_CORRELATION), normal(source)
    own = math.sqrt(1.0 - _AORTA_CORRELATION)
    aorta: dict[str, Any] = {
        name: 0.5 * (mean + deviation * (share * common + own * normal(source)))
        for name, (mean, deviation) in AORTA_DIAMETERS.items()
    }
    branches = {name: _branch(source, name) for name in BRANCH_DIAMETERS}
    aberrant = None
    if variant == "aberrant":
        # The first branch is the right carotid, as wide as the left one.
        radius = 0.5 * normal(source, BRANCH_DIAMETERS["lcca"])
        branches["bca"] = replace(
            branches["bca"], radius=radius, end_radius=min(radius, 3.15e-3)
        )
        # The aberrant artery leaves the back of the arch, to the right and up.
        aberrant = replace(
            _branch(source, "lsa"),
            take_off=math.radians(source.uniform(-10.0, 20.0)),
            lean=math.radians(source.uniform(35.0, 60.0)),
        )
    radii = {name: branch.radius for name, branch in branches.items()}
    first, second = _spacings(source, radii, variant)
    arch_radius = normal(source, _ARCH_RADIUS)
    last = aberrant.radius if aberrant else 0.0
    return ArchParameters(
        **branches,
        **aorta,
        ascending_length=40e-3,  # corrected to the drawn length up to the BCA
        descending_length=uniform(source, _DESCENDING_LENGTH),
        arch_radius=arch_radius,
        arch_height=arch_radius * uniform(source, _ARCH_ASPECT),
        plane_rotation=math.radians(normal(source, PLANE_ROTATION)),
        bca_drop=drop,
        bca_lcca_spacing=first,
        lcca_lsa_spacing=second,
        bovine=variant.startswith("bovine"),
        ascending_bend=max(0.0, math.radians(normal(source, ASCENDING_BEND))),
        descending_bend=math.radians(normal(source, _DESCENDING_BEND)),
        plane_tilt=math.radians(normal(source, _PLANE_TILT)),
        bow=normal(source, _BOW),
        sway=normal(source, _SWAY),
        aberrant=aberrant,
        lsa_aberrant_spacing=radii["lsa"] + last + source.uniform(2e-3, 6e-3),
    )


def _spacings(
    source: Random, radii: Mapping[str, float], variant: str
) -> tuple[float, float]:
    """Spacings of the ostia BCA-LCCA and LCCA-LSA, m, of branches with radii, m."""
    first = max(SPACINGS[0], radii["bca"] + radii["lcca"] + _WALL)
    second = max(SPACINGS[1], radii["lcca"] + radii["lsa"] + _WALL)
    if not variant.startswith("bovine"):
        return first, second
    # The LSA keeps its place. The LCCA leaves just above the ostium of a common trunk,
    # or 10 to 18 mm up the BCA (both lengths are assumptions).
    least = radii["lcca"] + 2.2e-3
    along = least + source.uniform(0.0, 2e-3)
    if variant == "bovine_branch":
        along = max(source.uniform(10e-3, 18e-3), least)
    return along, first + second


def _branch(source: Random, name: str) -> BranchParameters:
    radius = 0.5 * normal(source, BRANCH_DIAMETERS[name])
    # Taper: the LCCA narrows to the 6.3 mm of a mid common carotid, others by a tenth.
    end = min(radius, 3.15e-3) if name == "lcca" else 0.9 * radius
    # BCA and LCCA lean upstream and first bend downstream; the LSA does the opposite.
    towards = math.pi if name == "lsa" else 0.0
    turn = source.uniform(-math.pi / 2, math.pi / 2)
    bends = (_TIGHTEST_BRANCH_BEND * radius, _WIDEST_BRANCH_BEND)
    return BranchParameters(
        radius=radius,
        end_radius=end,
        take_off=math.radians(normal(source, TAKE_OFFS[name])),
        length=source.uniform(45e-3, 55e-3),
        bend_radius=uniform(source, bends),
        bend_azimuth=towards + turn,
        lean=math.radians(normal(source, _LEAN)),
        second_bend_radius=uniform(source, bends),
        # Most turn back, as arteries that go up the neck do.
        second_bend_azimuth=math.remainder(
            towards + turn + math.pi + normal(source, (0.0, 0.8)), 2.0 * math.pi
        ),
    )
