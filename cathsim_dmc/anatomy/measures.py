"""Measures of an arch: type, sizes, take-offs, curvature, places of the ostia.

Computed from centrelines and radii, so alike for generated, measured and imported
anatomies. Lengths are metres and angles radians; the vertical is +z (superior).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import Array, Centreline, Vessel, VesselTree

# A branch is measured this far (m) past its ostium, where the mouth's funnel is over,
# and its direction is that of the chord up to there.
BRANCH_LEVEL = 10e-3
# Direction of an end of the aorta: the chord over this length, m.
_END_CHORD = 30e-3
# The same where the aorta's turn begins: it bends most at the root.
_START_CHORD = 15e-3
# Where a branch stands out of the plane of the arch: this far (m) past its ostium.
_OUT_OF_PLANE_AT = 40e-3
# Bends are measured between tangents this far (m) apart.
_BEND_CHORD = 15e-3


@dataclass(frozen=True)
class BranchMeasures:
    """One branch of the aorta, or of another branch.

    Attributes:
        parent: vessel that it leaves.
        diameter: of the lumen 10 mm past the ostium, m.
        narrowest: least diameter of its lumen, m.
        length: from the ostium to the free end, m.
        take_off: angle of its first 10 mm from the vertical in the plane of the
            arch, positive upstream, towards the ascending aorta.
        lean: the same out of that plane, positive to the patient's right and back.
        out_of_plane: distance (m) from the vertical plane through its ostium along
            the arch, 40 mm on or at its end; signed like `lean`.
        tortuosity: length over the chord from ostium to end, at least 1.
        axis_offset: distance (m) of the ostium from the axis of the inlet.
        axis_angle: angle between that axis and the way from the inlet to the ostium.
    """

    parent: str
    diameter: float
    narrowest: float
    length: float
    take_off: float
    lean: float
    out_of_plane: float
    tortuosity: float
    axis_offset: float
    axis_angle: float


@dataclass(frozen=True)
class ArchMeasures:
    """An aorta with its branches.

    Attributes:
        arch_type: "I", "II" or "III" by `drop`; None without a BCA and an LCCA.
        drop: vertical distance from the BCA's ostium to the top of the arch over the
            diameter of the LCCA; None without them.
        diameters: of the aorta, m: "ascending", one level per branch, "descending".
        span: widest horizontal distance between two points of its centreline, m.
        height: of the top of its centreline over its first point, m.
        plane: angle of the plane of the arch from the sagittal plane.
        ascending_tilt: angle of its first 30 mm from the vertical.
        ascending_turn: angle between its first 15 mm and its axis at the BCA (or
            first branch).
        bend_radius: length up to there over that turn, m.
        tightest_bend: least radius of its bends over 15 mm, m.
        branches: by name.
    """

    arch_type: str | None
    drop: float | None
    diameters: Mapping[str, float]
    span: float
    height: float
    plane: float
    ascending_tilt: float
    ascending_turn: float
    bend_radius: float
    tightest_bend: float
    branches: Mapping[str, BranchMeasures] = field(default_factory=dict)


def arch_type(drop: float) -> str:
    """Type of an arch whose BCA lies `drop` LCCA diameters below its top."""
    return "I" if drop < 1.0 else "II" if drop <= 2.0 else "III"


def measure(
    tree: VesselTree, start: Array | None = None, axis: Array | None = None
) -> ArchMeasures:
    """Measure a tree whose root is an aorta with its ascending end first.

    Args:
        start: (3,) m, where a device enters; the root's first point if None.
        axis: (3,) unit vector of its first direction; that of the root's first 30 mm
            if None.
    """
    aorta = tree.root.centreline
    first_chord = _chord(aorta, 0.0, _END_CHORD)
    origin = aorta.points[0] if start is None else np.asarray(start, float)
    axis = first_chord if axis is None else axis
    along, normal = _arch_plane(aorta)
    branches = {
        name: _branch(vessel, origin, axis, along, normal)
        for name, vessel in tree.vessels.items()
        if vessel.parent is not None
    }
    drop = None
    # With an aberrant right subclavian the right carotid stands in the BCA's place.
    first_branch = "bca" if "bca" in branches else "rcca"
    if {first_branch, "lcca"} <= branches.keys():
        height = _top_of_arch(aorta) - tree.vessel(first_branch).mouth.position[2]
        drop = float(height / branches["lcca"].diameter)
    levels = {
        name: aorta.locate(vessel.mouth.position)
        for name, vessel in tree.vessels.items()
        if vessel.parent == tree.root.name
    }
    first = min(levels.values(), default=0.5 * aorta.length)
    last = max(levels.values(), default=0.5 * aorta.length)
    # Half-way to the branches on one side and to the end on the other.
    end = 0.5 * (last + aorta.length)
    stations = {"ascending": 0.5 * first, **levels, "descending": end}
    turn = _angle(_chord(aorta, 0.0, _START_CHORD), aorta.at(first).tangent)
    flat = aorta.resampled(2e-3).points[:, :2]
    return ArchMeasures(
        arch_type=None if drop is None else arch_type(drop),
        drop=drop,
        diameters={
            name: 2.0 * float(aorta.at(place).radius)
            for name, place in stations.items()
        },
        span=float(np.linalg.norm(flat[:, None] - flat[None], axis=-1).max()),
        height=float(aorta.points[:, 2].max() - aorta.points[0, 2]),
        plane=math.atan2(along[0], along[1]),
        ascending_tilt=_angle(first_chord, np.array([0.0, 0.0, 1.0])),
        ascending_turn=turn,
        bend_radius=first / max(turn, 1e-9),
        tightest_bend=_tightest_bend(aorta),
        branches=branches,
    )


def inlet_axis(anatomy: Anatomy) -> Array:
    """First direction (3,) of a device: the chord over 30 mm from the inlet."""
    line = anatomy.tree.vessel(anatomy.inlet.vessel).centreline
    s = line.locate(anatomy.inlet.position)
    way = line.at(s + _END_CHORD).position - line.at(s).position
    back = line.at(s - _END_CHORD).position - line.at(s).position
    way = max((way, back), key=lambda chord: float(chord @ anatomy.inlet.direction))
    return way / np.linalg.norm(way)


def _top_of_arch(aorta: Centreline) -> float:
    """Height z (m) of the highest point of the aorta's lumen."""
    place = aorta.at(np.linspace(0.0, aorta.length, 400))
    level = np.sqrt(np.clip(1.0 - place.tangent[:, 2] ** 2, 0.0, 1.0))
    return float((place.position[:, 2] + place.radius * level).max())


def _angle(first: Array, second: Array) -> float:
    return math.atan2(np.linalg.norm(np.cross(first, second)), float(first @ second))


def _chord(line: Centreline, s0: float, s1: float) -> Array:
    way = line.at(s1).position - line.at(s0).position
    return way / np.linalg.norm(way)


def _arch_plane(aorta: Centreline) -> tuple[Array, Array]:
    """Horizontal unit vectors along the arch, downstream, and normal to it."""
    points = aorta.resampled(2e-3).points
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    _, _, directions = np.linalg.svd(flat, full_matrices=False)
    along = np.array([*directions[0], 0.0])
    if along @ (points[-1] - points[0]) < 0.0:
        along = -along
    return along, np.cross([0.0, 0.0, 1.0], along)


def _tightest_bend(line: Centreline) -> float:
    s = np.arange(0.0, line.length - _BEND_CHORD, 1e-3)
    if not len(s):
        return math.inf
    first, last = line.at(s).tangent, line.at(s + _BEND_CHORD).tangent
    turn = np.arccos(np.clip(np.einsum("nj,nj->n", first, last), -1.0, 1.0))
    return float(_BEND_CHORD / max(turn.max(), 1e-9))


def _branch(
    vessel: Vessel, start: Array, axis: Array, along: Array, normal: Array
) -> BranchMeasures:
    line = vessel.centreline
    ostium = vessel.mouth.position
    own = line.slice(vessel.ostium, line.length)
    level = vessel.ostium + BRANCH_LEVEL
    direction = _chord(line, vessel.ostium, level)
    far = line.at(vessel.ostium + _OUT_OF_PLANE_AT).position
    way = ostium - start
    return BranchMeasures(
        parent=str(vessel.parent),
        diameter=2.0 * float(line.at(level).radius),
        narrowest=2.0 * float(own.radii.min()),
        length=own.length,
        take_off=math.atan2(-float(direction @ along), float(direction[2])),
        lean=math.atan2(float(direction @ normal), float(direction[2])),
        out_of_plane=float((far - ostium) @ normal),
        tortuosity=own.length / float(np.linalg.norm(own.points[-1] - ostium)),
        axis_offset=float(np.linalg.norm(way - (way @ axis) * axis)),
        axis_angle=_angle(axis, way),
    )
