"""Geometry of parametric aortic arches: from their figures to a vessel tree."""

import math

import numpy as np

from cathsim_dmc.anatomy.arch.branch import Plane, branch_vessel
from cathsim_dmc.anatomy.arch.parameters import (
    LEVELS,
    MINIMUM_SEPTUM,
    ArchParameters,
    BranchParameters,
)
from cathsim_dmc.anatomy.centreline import (
    Array,
    Centreline,
    Vessel,
    VesselTree,
    arc_lengths,
)
from cathsim_dmc.anatomy.curves import check_septa

# Polyline steps, m: the chord of 2 mm on a 34 mm arch departs 0.015 mm from it.
_STRAIGHT_STEP = 5e-3
_CURVED_STEP = 2e-3


def _smooth_interpolation(s: Array, stations: Array, values: Array) -> Array:
    """C1 interpolation, monotone between stations, constant outside them."""
    index = np.clip(np.searchsorted(stations, s) - 1, 0, len(stations) - 2)
    t = (s - stations[index]) / (stations[index + 1] - stations[index])
    t = np.clip(t, 0.0, 1.0)
    t = t * t * (3.0 - 2.0 * t)
    return values[index] * (1.0 - t) + values[index + 1] * t


def _limb(length: float, bend: float, heading: float) -> Array:
    """Points (n, 2) m of a limb from 0 on that turns to the right by `bend`, rad."""
    step = _STRAIGHT_STEP if abs(bend) < 1e-9 else _CURVED_STEP
    # Whole steps, of which the parametric arches have always had `length / step`.
    count = max(1, round(length / step))
    s = np.linspace(0.0, length, count + 1)
    if abs(bend) < 1e-9:
        return s[:, None] * np.array([math.sin(heading), math.cos(heading)])
    radius = length / bend
    angle = heading + s / radius
    return radius * np.stack(
        [math.cos(heading) - np.cos(angle), np.sin(angle) - math.sin(heading)], axis=1
    )


def _aorta_points(p: ArchParameters) -> Array:
    """Centreline (n, 2) of the aorta in its plane: along the arch, and up."""
    rise = _limb(p.ascending_length, p.ascending_bend, -p.ascending_bend)
    angle = np.linspace(0.0, math.pi, 2001)
    ellipse = rise[-1] + np.stack(
        [p.arch_radius * (1.0 - np.cos(angle)), p.arch_height * np.sin(angle)], axis=1
    )
    # Equal steps along the ellipse.
    arc = arc_lengths(ellipse)
    even = np.linspace(0.0, arc[-1], round(arc[-1] / _CURVED_STEP) + 1)
    ellipse = np.stack([np.interp(even, arc, ellipse[:, i]) for i in (0, 1)], axis=1)
    fall = ellipse[-1] + _limb(p.descending_length, p.descending_bend, math.pi)
    return np.concatenate([rise[:-1], ellipse, fall[1:]])


def _outer_curve(p: ArchParameters) -> tuple[Array, Array, Array, list[float]]:
    """Aorta in its plane: points (n, 2), radii (n,), outer curve, branch levels.

    The levels are arc lengths on the centreline. They depend on the outer curve,
    which depends on the radii, which depend on the levels: iterate.
    """
    points = _aorta_points(p)
    s = arc_lengths(points)
    tangent = np.gradient(points, s, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    outward = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    top = s[points[:, 1].argmax()]
    levels = [top - 15e-3, top, top + 12e-3]
    arch_end = float(s[-1] - p.descending_length)
    radii_of = np.array([getattr(p, f"{level}_radius") for level in LEVELS])
    for _ in range(8):
        stations = np.array([0.5 * p.ascending_length, *levels[:3], arch_end])
        if np.any(np.diff(stations) <= 1e-3):
            raise ValueError(
                f"the branches lie at {np.round(stations[1:4] * 1e3, 1).tolist()} mm "
                "along the aorta, which does not fit between the middle of the "
                f"ascending ({stations[0] * 1e3:.1f} mm) and the end of the arch "
                f"({arch_end * 1e3:.1f} mm); reduce bca_drop or the spacings, or "
                "enlarge the arch."
            )
        radii = _smooth_interpolation(s, stations, radii_of)
        outer = points + radii[:, None] * outward
        arc = arc_lengths(outer)
        summit = outer[:, 1].argmax()
        height = outer[summit, 1] - p.bca_drop * 2.0 * p.lcca.radius
        bca = np.interp(height, outer[: summit + 1, 1], arc[: summit + 1])
        if p.bovine:
            # No LCCA ostium: its level of the aorta is half-way to the LSA.
            lsa = bca + p.lcca_lsa_spacing
            lcca = 0.5 * (bca + lsa)
        else:
            lcca = bca + p.bca_lcca_spacing
            lsa = lcca + p.lcca_lsa_spacing
        places = [bca, lcca, lsa, lsa + p.lsa_aberrant_spacing]
        places = places[: len(p.branches)]
        levels = [float(np.interp(place, arc, s)) for place in places]
    return points, radii, outer, levels


def _in_space(p: ArchParameters, plane: Plane, flat: Array) -> Array:
    """World points (n, 3) of the aorta's in-plane ones: with bow and sway."""
    s = arc_lengths(flat)
    phase = math.pi * s / s[-1]
    aside = p.bow * np.sin(phase) + p.sway * np.sin(2.0 * phase)
    return plane.to_world(flat) + aside[:, None] * plane.normal


def _direction(branch: BranchParameters, plane: Plane) -> Array:
    upright = np.array([0.0, 0.0, 1.0])
    aside = np.cross(upright, plane.along)
    upstream, lean = math.tan(branch.take_off), math.tan(branch.lean)
    direction = upright - upstream * plane.along + lean * aside
    return direction / np.linalg.norm(direction)


def arch_tree(params: ArchParameters) -> VesselTree:
    """Vessels of an arch; ValueError if branches do not fit or meet each other."""
    plane = Plane.turned(params.plane_rotation, params.plane_tilt)
    points, radii, outer, levels = _outer_curve(params)
    aorta = Vessel("aorta", Centreline(_in_space(params, plane, points), radii))
    vessels = {"aorta": aorta}
    for (name, branch), level, septum in zip(
        params.branches.items(), levels, _septa(params), strict=True
    ):
        direction = _direction(branch, plane)
        fillet = min(params.fillet, 0.4 * max(septum - MINIMUM_SEPTUM, 0.0))
        parent = aorta
        if name == "lcca" and params.bovine:
            parent = vessels["bca"]
            trunk = parent.centreline.at(parent.ostium + params.bca_lcca_spacing)
            across = np.cross(plane.normal, trunk.tangent)
            across *= np.sign(across @ plane.along) / np.linalg.norm(across)
            tilt = math.radians(40.0)
            direction = math.cos(tilt) * across + math.sin(tilt) * trunk.tangent
            ostium = trunk.position + trunk.radius * across
            fillet = min(fillet, 0.9 * trunk.radius - branch.radius, 1e-3)
        else:
            ostium = _ostium(points, outer, level, aorta, plane, branch.lean)
        vessels[name] = branch_vessel(
            name, branch, parent, ostium, direction, plane, max(float(fillet), 0.0)
        )
    tree = VesselTree(vessels)
    check_septa(tree)
    return tree


def _ostium(
    points: Array, outer: Array, level: float, aorta: Vessel, plane: Plane, lean: float
) -> Array:
    """Point (3,) on the aorta's surface, `lean` round it from its outer curve."""
    flat, numbers = arc_lengths(points), np.arange(len(points))
    index = float(np.interp(level, flat, numbers))
    # The curve in space is a little longer than the one in the plane.
    s = float(np.interp(index, numbers, aorta.centreline.arc_length))
    way = [np.interp(level, flat, axis) for axis in (outer - points).T]
    outward = plane.to_world(np.array(way))
    place = aorta.centreline.at(s)
    outward = outward - (outward @ place.tangent) * place.tangent
    outward /= np.linalg.norm(outward)
    aside = np.cross(outward, place.tangent)
    aside *= np.sign(aside @ plane.normal) or 1.0
    around = math.cos(lean) * outward + math.sin(lean) * aside
    return place.position + float(place.radius) * around


def _septa(params: ArchParameters) -> list[float]:
    """Wall (m) between the ostium of each branch, without its flare, and the nearest.

    That of a bovine LCCA is on the BCA.
    """
    radii = [branch.radius for branch in params.branches.values()]
    before, last = math.inf, math.inf
    after = params.lcca_lsa_spacing - radii[0 if params.bovine else 1] - radii[2]
    if not params.bovine:
        before = params.bca_lcca_spacing - radii[0] - radii[1]
    if params.aberrant is not None:
        last = params.lsa_aberrant_spacing - radii[2] - radii[3]
    septa = [before, min(before, after), min(after, last), last]
    return septa[: len(radii)]
