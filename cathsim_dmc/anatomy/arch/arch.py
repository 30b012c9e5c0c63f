"""Parametric aortic arches: presets, a sampler, and the anatomy they give.

Built in the patient frame LPS with the inlet of the ascending aorta at the
origin. The ascending aorta runs straight up (+z), the arch is half an ellipse
in a vertical plane, the descending aorta runs straight down. Three branches
leave the outer curve: brachiocephalic (bca), left common carotid (lcca) and
left subclavian artery (lsa).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.arch.parameters import (
    INLET_TUBE,
    ArchParameters,
    BranchParameters,
)
from cathsim_dmc.anatomy.arch.tree import arch_tree
from cathsim_dmc.anatomy.builder import Place, access_inlet
from cathsim_dmc.anatomy.centreline import VesselTree

# Range of the BCA drop in LCCA diameters for each type of arch (class by the
# vertical distance from the BCA origin to the top of the arch).
DROP_RANGES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"I": (0.0, 1.0), "II": (1.0, 2.0), "III": (2.0, 3.0)}
)


def _goals(params: ArchParameters, tree: VesselTree) -> dict[str, Place]:
    goals = {
        name: Place(name, past_ostium=getattr(params, name).goal_depth)
        for name in ("bca", "lcca", "lsa")
    }
    arc = tree.root.centreline.length - params.descending_goal_depth
    goals["descending"] = Place("aorta", arc_length=arc)
    return goals


@lru_cache(maxsize=32)
def build_arch(
    params: ArchParameters, name: str = "arch", *, access: str = "ascending"
) -> Anatomy:
    """Anatomy of an arch: tree, wall, surface, inlet and goals.

    Takes a fifth of a second. The last results are kept in memory, so equal
    parameters give the same object.

    Args:
        params: figures of the arch.
        name: what to call the anatomy.
        access: end of the aorta that is open for the device, "ascending" or
            "descending"; the other one is capped.

    Raises:
        ValueError: if the parameters give no valid arch.
    """
    tree = arch_tree(params)
    return Anatomy.from_tree(
        tree, name, inlet=access_inlet(tree, access), goals=_goals(params, tree)
    )


def _degrees(value: float) -> float:
    return math.radians(value)


# The published Type-I phantom, as measured: outer width 91 mm, 186 mm from the end
# of the descending aorta to the top of the branches, lumen radii 9.1 (descending),
# 13.8 (arch), 4.4 (BCA) and 3.1 mm (LCCA), targets 15 mm apart and about 130 mm
# from a tip at the inlet. Spacings are the anatomical means, scaled like the branch
# radii; take-offs and lengths are chosen so that the measured figures come out.
TYPE_I = ArchParameters(
    bca=BranchParameters(
        radius=4.4e-3, end_radius=4.2e-3, take_off=_degrees(12.0), length=43e-3
    ),
    lcca=BranchParameters(
        radius=3.1e-3, end_radius=2.9e-3, take_off=_degrees(12.0), length=43e-3
    ),
    lsa=BranchParameters(
        radius=3.7e-3,
        end_radius=3.4e-3,
        take_off=_degrees(-20.0),
        length=41e-3,
        bend_azimuth=math.pi,
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
    bca=BranchParameters(
        radius=6.25e-3, end_radius=5.5e-3, take_off=_degrees(44.9), length=44e-3
    ),
    lcca=BranchParameters(
        radius=4.14e-3, end_radius=3.15e-3, take_off=_degrees(25.7), length=50e-3
    ),
    lsa=BranchParameters(
        radius=5.2e-3,
        end_radius=4.5e-3,
        take_off=_degrees(-28.8),
        length=45e-3,
        bend_azimuth=math.pi,
    ),
    bca_drop=1.5,
)
TYPE_III = replace(TYPE_II, bca_drop=2.5)
BOVINE = replace(
    TYPE_II, bca_drop=1.0, bca_lcca_spacing=10e-3, lcca_lsa_spacing=30e-3, bovine=True
)
ARCHES: Mapping[str, ArchParameters] = MappingProxyType(
    {"simple1": TYPE_I, "simple2": TYPE_II, "type3": TYPE_III, "bovine": BOVINE}
)

# Share of the types I, II and III (one of the published cohorts).
_PREVALENCE = (0.336, 0.434, 0.230)
# Mean and standard deviation of the lumen diameters of the aorta, m.
_AORTA_DIAMETERS = {
    "ascending_radius": (29.5e-3, 3.9e-3),
    "bca_level_radius": (28.6e-3, 3.9e-3),
    "lcca_level_radius": (27.1e-3, 3.2e-3),
    "lsa_level_radius": (25.3e-3, 3.0e-3),
    "descending_radius": (23.9e-3, 3.3e-3),
}
# The same for branch diameters at the origin, m, and take-off angles, rad.
_BRANCH_DIAMETERS = {
    "bca": (12.5e-3, 1.95e-3),
    "lcca": (8.28e-3, 1.51e-3),
    "lsa": (10.4e-3, 2.2e-3),
}
_TAKE_OFFS = {
    "bca": (_degrees(44.9), _degrees(15.9)),
    "lcca": (_degrees(25.7), _degrees(15.5)),
    "lsa": (_degrees(-28.8), _degrees(14.5)),
}
# Levels of one aorta are wide or narrow together; the share is an assumption.
_AORTA_CORRELATION = 0.8
# Draws stop at this many standard deviations.
_CUT = 2.0
_ATTEMPTS = 1000


def load(name: str, *, access: str = "ascending") -> Anatomy:
    """Anatomy of the arch called `name` in `ARCHES`.

    Raises:
        ValueError: if there is none; the message lists the names.
    """
    if name not in ARCHES:
        raise ValueError(f"no arch {name!r}; there are {', '.join(ARCHES)}.")
    return build_arch(ARCHES[name], name, access=access)


def sample(
    random_state: np.random.RandomState | np.random.Generator,
    arch_type: str | None = None,
    *,
    bovine: bool = False,
) -> ArchParameters:
    """Random arch from the anatomical distributions.

    Args:
        random_state: source of randomness; the same state gives the same arch.
        arch_type: "I", "II" or "III", or None to draw it by prevalence.
        bovine: let the LCCA leave the BCA.

    Raises:
        ValueError: if `arch_type` is unknown.
    """
    if arch_type is None:
        place = np.searchsorted(np.cumsum(_PREVALENCE), random_state.uniform())
        arch_type = list(DROP_RANGES)[min(int(place), 2)]
    if arch_type not in DROP_RANGES:
        raise ValueError(
            f"arch_type is {arch_type!r}; choose one of {', '.join(DROP_RANGES)}."
        )
    for _ in range(_ATTEMPTS):
        # Independent draws now and then give branches that cross: draw again.
        try:
            params = _draw(random_state, arch_type, bovine)
            arch_tree(params)
        except ValueError:
            continue
        return params
    raise RuntimeError(f"no valid arch of type {arch_type} in {_ATTEMPTS} attempts.")


def _draw(
    random_state: np.random.RandomState | np.random.Generator,
    arch_type: str,
    bovine: bool,
) -> ArchParameters:
    def normal(mean: float, deviation: float) -> float:
        z = float(np.clip(random_state.normal(), -_CUT, _CUT))
        return mean + deviation * z

    def uniform(low: float, high: float) -> float:
        return float(random_state.uniform(low, high))

    common = normal(0.0, 1.0)
    own = math.sqrt(1.0 - _AORTA_CORRELATION)
    aorta = {}
    for name, (mean, deviation) in _AORTA_DIAMETERS.items():
        z = math.sqrt(_AORTA_CORRELATION) * common + own * normal(0.0, 1.0)
        aorta[name] = 0.5 * (mean + deviation * float(np.clip(z, -_CUT, _CUT)))
    # Taper: the LCCA narrows to a mid common carotid of 6.3 mm, others by a tenth.
    azimuth = {"bca": 0.0, "lcca": uniform(-math.pi, math.pi), "lsa": math.pi}
    branches = {}
    for name, (mean, deviation) in _BRANCH_DIAMETERS.items():
        radius = 0.5 * normal(mean, deviation)
        end = min(radius, 3.15e-3) if name == "lcca" else 0.9 * radius
        branches[name] = BranchParameters(
            radius=radius,
            end_radius=end,
            take_off=normal(*_TAKE_OFFS[name]),
            length=uniform(40e-3, 50e-3),
            bend_radius=uniform(80e-3, 200e-3),
            bend_azimuth=azimuth[name] + uniform(-1.0, 1.0),
        )
    # Arch radius: that of the measured phantom; its spread of a tenth and that of
    # the height are assumptions.
    arch_radius = normal(34e-3, 3.4e-3)
    drop = uniform(*DROP_RANGES[arch_type])
    radii = {name: branch.radius for name, branch in branches.items()}
    wall = 2e-3
    spacings = {
        "bca_lcca_spacing": max(21.8e-3, radii["bca"] + radii["lcca"] + wall),
        "lcca_lsa_spacing": max(14.3e-3, radii["lcca"] + radii["lsa"] + wall),
    }
    if bovine:
        # The LSA stays where it would be; a common trunk is 8 to 15 mm long (an
        # assumption).
        spacings = {
            "bca_lcca_spacing": uniform(8e-3, 15e-3),
            "lcca_lsa_spacing": sum(spacings.values()),
        }
    return ArchParameters(
        **branches,
        **aorta,
        ascending_length=INLET_TUBE + normal(62.6e-3, 11.4e-3),
        arch_radius=arch_radius,
        arch_height=arch_radius * uniform(0.95, 1.15),
        plane_rotation=normal(_degrees(50.3), _degrees(13.8)),
        bca_drop=drop,
        bovine=bovine,
        **spacings,
    )
