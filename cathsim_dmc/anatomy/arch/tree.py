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
from cathsim_dmc.anatomy.centreline import Array, Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.segments import arc_lengths
from cathsim_dmc.anatomy.septa import check_septa

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


def _outer_curve(p: ArchParameters) -> tuple[Array, Array, Array, dict[str, float]]:
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
    levels = {"bca": top - 15e-3, "lcca": top, "lsa": top + 12e-3}
    arch_end = float(s[-1] - p.descending_length)
    for _ in range(8):
        main = [levels[name] for name in ("bca", "lcca", "lsa")]
        stations = np.array([0.5 * p.ascending_length, *main, arch_end])
        if np.any(np.diff(stations) <= 1e-3):
            raise ValueError(
                f"the branches lie at {np.round(stations[1:4] * 1e3, 1).tolist()} mm "
                "along the aorta, which does not fit between the middle of the "
                f"ascending ({stations[0] * 1e3:.1f} mm) and the end of the arch "
                f"({arch_end * 1e3:.1f} mm); reduce bca_drop or the spacings, or "
                "enlarge the arch."
            )
        levels_of = [getattr(p, f"{level}_radius") for level in LEVELS]
        radii = _smooth_interpolation(s, stations, np.array(levels_of))
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
        places = {"bca": bca, "lcca": lcca, "lsa": lsa}
        if p.aberrant is not None:
            places["rsa"] = lsa + p.lsa_aberrant_spacing
        levels = {
            name: float(np.interp(place, arc, s)) for name, place in places.items()
        }
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
    direction = (
        upright
        - math.tan(branch.take_off) * plane.along
        + math.tan(branch.lean) * aside
    )
    return direction / np.linalg.norm(direction)


def arch_tree(params: ArchParameters) -> VesselTree:
    """Vessels of an arch; ValueError if branches do not fit or meet each other."""
    plane = Plane.turned(params.plane_rotation, params.plane_tilt)
    points, radii, outer, levels = _outer_curve(params)
    aorta = Vessel("aorta", Centreline(_in_space(params, plane, points), radii))
    vessels = {"aorta": aorta}
    first = "bca" if params.aberrant is None else "rcca"
    branches = {first: params.bca, "lcca": params.lcca, "lsa": params.lsa}
    if params.aberrant is not None:
        branches["rsa"] = params.aberrant
    septa = _septa(params)
    for name, branch in branches.items():
        direction = _direction(branch, plane)
        level = "bca" if name == "rcca" else name
        fillet = min(params.fillet, 0.4 * max(septa[level] - MINIMUM_SEPTUM, 0.0))
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
            ostium = _ostium(points, outer, levels[level], aorta, plane, branch.lean)
        vessels[name] = branch_vessel(
            name, branch, parent, ostium, direction, plane, max(float(fillet), 0.0)
        )
    tree = VesselTree(vessels)
    check_septa(tree)
    return tree


def _ostium(
    points: Array,
    outer: Array,
    level: float,
    aorta: Vessel,
    plane: Plane,
    lean: float,
) -> Array:
    """Point (3,) on the aorta's surface, `lean` round it from its outer curve."""
    flat = arc_lengths(points)
    index = float(np.interp(level, flat, np.arange(len(flat))))
    # The curve in space is a little longer than the one in the plane.
    s = float(np.interp(index, np.arange(len(flat)), aorta.centreline.arc_length))
    way = outer - points
    outward = plane.to_world(
        np.array([np.interp(level, flat, way[:, axis]) for axis in (0, 1)])
    )
    place = aorta.centreline.at(s)
    outward = outward - (outward @ place.tangent) * place.tangent
    outward /= np.linalg.norm(outward)
    aside = np.cross(outward, place.tangent)
    aside *= np.sign(aside @ plane.normal) or 1.0
    around = math.cos(lean) * outward + math.sin(lean) * aside
    return place.position + float(place.radius) * around


def _septa(params: ArchParameters) -> dict[str, float]:
    """Wall (m) between each ostium, without its flare, and its nearest neighbour."""
    first = params.bca if params.bovine else params.lcca
    after = params.lcca_lsa_spacing - first.radius - params.lsa.radius
    before = math.inf
    if not params.bovine:
        before = params.bca_lcca_spacing - params.bca.radius - params.lcca.radius
    last = math.inf
    if params.aberrant is not None:
        last = params.lsa_aberrant_spacing - params.lsa.radius - params.aberrant.radius
    return {
        "bca": before,
        "lcca": min(before, after),
        "lsa": min(after, last),
        "rsa": last,
    }
