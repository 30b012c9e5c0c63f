"""Measures of an arch: type, sizes, take-offs, curvature, places of the ostia."""

import math
from typing import Any

import numpy as np

from cathsim_dmc.anatomy.centreline import Array, Centreline, Vessel, VesselTree

BRANCH_LEVEL = 10e-3  # m past its ostium, where a branch is measured, past its flare
_END_CHORD = 30e-3  # m, of the direction of an end of the aorta
_START_CHORD = 15e-3  # m, the same at the root, where it bends most
_OUT_OF_PLANE_AT = 40e-3  # m past its ostium, where `out_of_plane_mm` is taken
_BEND_CHORD = 15e-3  # m, between the tangents of a bend


def arch_type(drop: float) -> str:
    """Type of an arch whose BCA lies `drop` LCCA diameters below its top."""
    return "I" if drop < 1.0 else "II" if drop <= 2.0 else "III"


def bca_drop(tree: VesselTree) -> float:
    """Height of the top of the arch over the BCA's ostium, in diameters of the LCCA.

    A right carotid that leaves the arch counts as the BCA. NaN if a branch is missing.
    """
    first, lcca = tree.vessels.get("bca", tree.vessels.get("rcca")), "lcca"
    if first is None or lcca not in tree.vessels:
        return math.nan
    aorta = tree.root.centreline
    place = aorta.at(np.linspace(0.0, aorta.length, 400))
    level = np.sqrt(np.clip(1.0 - place.tangent[:, 2] ** 2, 0.0, 1.0))
    top = float((place.position[:, 2] + place.radius * level).max())
    return float((top - first.mouth.position[2]) / _diameter(tree.vessel(lcca)))


def measure(tree: VesselTree) -> dict[str, Any]:
    """Measure a tree whose root is an aorta with its ascending end first."""
    aorta = tree.root.centreline
    start, axis = aorta.points[0], _chord(aorta, 0.0, _END_CHORD)
    along = _along_arch(aorta)
    plane = along, np.cross([0.0, 0.0, 1.0], along)
    vessels = [one for one in tree.vessels.values() if one.parent is not None]
    levels = {
        vessel.name: aorta.locate(vessel.mouth.position)
        for vessel in vessels
        if vessel.parent == tree.root.name
    }
    first = min(levels.values(), default=0.5 * aorta.length)
    last = max(levels.values(), default=0.5 * aorta.length)
    # Half-way from the start to the first branch, and from the last branch to the end.
    end = 0.5 * (last + aorta.length)
    stations = {"ascending": 0.5 * first, **levels, "descending": end}
    turn = _angle(_chord(aorta, 0.0, _START_CHORD), aorta.at(first).tangent)
    flat = aorta.resampled(2e-3).points[:, :2]
    drop = bca_drop(tree)
    return {
        "arch_type": None if math.isnan(drop) else arch_type(drop),
        "drop": None if math.isnan(drop) else drop,
        # Of the aorta at its ends and branches, mm.
        "diameters": {
            name: _mm(2.0 * aorta.at(place).radius) for name, place in stations.items()
        },
        # Widest horizontal distance between two points of the centreline, and height of
        # its top over its first point.
        "span_mm": _mm(np.linalg.norm(flat[:, None] - flat[None], axis=-1).max()),
        "height_mm": _mm(aorta.points[:, 2].max() - aorta.points[0, 2]),
        # Of the plane of the arch from the sagittal plane.
        "plane_deg": _degrees(math.atan2(along[0], along[1])),
        # Of the first 30 mm from the vertical.
        "ascending_tilt_deg": _degrees(_angle(axis, np.array([0.0, 0.0, 1.0]))),
        # Of the first 15 mm from the axis at the first branch, and length over turn.
        "ascending_turn_deg": _degrees(turn),
        "bend_radius_mm": _mm(first / max(turn, 1e-9)),
        "tightest_bend_mm": _mm(_tightest_bend(aorta)),
        "branches": {one.name: _branch(one, start, axis, plane) for one in vessels},
    }


def _branch(
    vessel: Vessel, start: Array, axis: Array, plane: tuple[Array, Array]
) -> dict[str, Any]:
    line, (along, normal) = vessel.centreline, plane
    ostium = vessel.mouth.position
    own = line.slice(vessel.ostium, line.length)
    direction = _chord(line, vessel.ostium, vessel.ostium + BRANCH_LEVEL)
    far = line.at(vessel.ostium + _OUT_OF_PLANE_AT).position
    way = ostium - start
    return {
        "parent": vessel.parent,
        "diameter_mm": _mm(_diameter(vessel)),
        "narrowest_mm": _mm(2.0 * own.radii.min()),
        # From the ostium to the free end.
        "length_mm": _mm(own.length),
        # From the vertical in the plane of the arch, positive upstream; and out of the
        # plane, positive to the patient's right and back: angle, and offset at 40 mm.
        "take_off_deg": _degrees(math.atan2(-(direction @ along), direction[2])),
        "lean_deg": _degrees(math.atan2(direction @ normal, direction[2])),
        "out_of_plane_mm": _mm((far - ostium) @ normal),
        # Length over the chord from ostium to end.
        "tortuosity": round(own.length / np.linalg.norm(own.points[-1] - ostium), 6),
        # Distance of the ostium from the axis of the first 30 mm of the aorta.
        "axis_offset_mm": _mm(np.linalg.norm(way - (way @ axis) * axis)),
    }


def _diameter(vessel: Vessel) -> float:
    return 2.0 * float(vessel.centreline.at(vessel.ostium + BRANCH_LEVEL).radius)


def _mm(length: Any) -> float:
    return round(1e3 * float(length), 3)


def _degrees(angle: float) -> float:
    return round(math.degrees(angle), 3)


def _angle(first: Array, second: Array) -> float:
    return math.atan2(np.linalg.norm(np.cross(first, second)), float(first @ second))


def _chord(line: Centreline, s0: float, s1: float) -> Array:
    way = line.at(s1).position - line.at(s0).position
    return way / np.linalg.norm(way)


def _along_arch(aorta: Centreline) -> Array:
    """Horizontal unit vector along the arch, downstream."""
    points = aorta.resampled(2e-3).points
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    _, _, directions = np.linalg.svd(flat, full_matrices=False)
    along = np.array([*directions[0], 0.0])
    return along if along @ (points[-1] - points[0]) >= 0.0 else -along


def _tightest_bend(line: Centreline) -> float:
    s = np.arange(0.0, line.length - _BEND_CHORD, 1e-3)
    if not len(s):
        return math.inf
    first, last = line.at(s).tangent, line.at(s + _BEND_CHORD).tangent
    turn = np.arccos(np.clip(np.vecdot(first, last), -1.0, 1.0))
    return float(_BEND_CHORD / max(turn.max(), 1e-9))
