"""Geometry of parametric aortic arches: from parameters to a vessel tree."""

import math

import numpy as np

from cathsim_dmc.anatomy.arch.neck import with_courses
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
    interpolate,
)
from cathsim_dmc.anatomy.curves import check_septa, flare_begin

# Polyline steps, m: the chord of 2 mm on a 34 mm arch departs 0.015 mm from it.
_STRAIGHT_STEP, _CURVED_STEP, _FLARE_STEP = 5e-3, 2e-3, 0.5e-3
_FILLET = 2.5e-3  # m, largest increase of a branch radius at its ostium
# Largest angle of a branch from the wall's normal, and largest distance of its ostium
# from the parent's centreline in parent radii; beyond them the ostium is a slit.
_MOST_OBLIQUE, _LONGEST_EXIT = math.radians(60.0), 2.2
_BLEND = 8e-3  # m, over which the first bend changes into the second
_INTEGRATION_STEP = 0.5e-3  # m
_UPRIGHT = np.array([0.0, 0.0, 1.0])


class Plane:
    """Plane of the arch: unit vectors `along`, `up`, and `normal` (right and back)."""

    def __init__(self, rotation: float, tilt: float):
        self.along = np.array([math.sin(rotation), math.cos(rotation), 0.0])
        side = np.cross(_UPRIGHT, self.along)
        self.up = math.cos(tilt) * _UPRIGHT + math.sin(tilt) * side
        self.normal = np.cross(self.up, self.along)

    def to_world(self, flat: Array) -> Array:
        """World coordinates (..., 3) of in-plane coordinates (..., 2), along and up."""
        return flat[..., :1] * self.along + flat[..., 1:] * self.up


def _smooth_interpolation(s: Array, stations: Array, values: Array) -> Array:
    """C1 interpolation, monotone between stations, constant outside them."""
    index = np.clip(np.searchsorted(stations, s) - 1, 0, len(stations) - 2)
    t = (s - stations[index]) / (stations[index + 1] - stations[index])
    t = np.clip(t, 0.0, 1.0)
    t = t * t * (3.0 - 2.0 * t)
    return values[index] * (1.0 - t) + values[index + 1] * t


def _limb(length: float, bend: float, heading: float) -> Array:
    """Points (n, 2), m, of a limb from the origin that turns right by `bend`, rad."""
    step = _STRAIGHT_STEP if abs(bend) < 1e-9 else _CURVED_STEP
    s = np.linspace(0.0, length, max(1, round(length / step)) + 1)
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
    ellipse = interpolate(even, arc, ellipse)
    fall = ellipse[-1] + _limb(p.descending_length, p.descending_bend, math.pi)
    return np.concatenate([rise[:-1], ellipse, fall[1:]])


def _outer_curve(p: ArchParameters) -> tuple[Array, Array, Array, list[float]]:
    """Aorta in its plane: points (n, 2), radii (n,), outer curve, branch levels (m)."""
    points = _aorta_points(p)
    s = arc_lengths(points)
    tangent = np.gradient(points, s, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    outward = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    top = s[points[:, 1].argmax()]
    levels = [top - 15e-3, top, top + 12e-3]
    arch_end = float(s[-1] - p.descending_length)
    radii_of = np.array([getattr(p, f"{level}_radius") for level in LEVELS])
    # Iterates: levels depend on the outer curve, the curve on radii, radii on levels.
    for _ in range(8):
        stations = np.array([0.5 * p.ascending_length, *levels[:3], arch_end])
        if np.any(np.diff(stations) <= 1e-3):
            raise ValueError(
                f"the branches lie at {np.round(stations[1:4] * 1e3, 1).tolist()} mm "
                f"along the aorta, and must between {stations[0] * 1e3:.1f} and "
                f"{arch_end * 1e3:.1f} mm; reduce bca_drop or spacings, or enlarge it"
            )
        radii = _smooth_interpolation(s, stations, radii_of)
        outer = points + radii[:, None] * outward
        arc = arc_lengths(outer)
        summit = outer[:, 1].argmax()
        height = outer[summit, 1] - p.bca_drop * 2.0 * p.lcca.radius
        bca = np.interp(height, outer[: summit + 1, 1], arc[: summit + 1])
        lcca = bca + (0.0 if p.bovine else p.bca_lcca_spacing)
        lsa = lcca + p.lcca_lsa_spacing
        if p.bovine:  # no LCCA ostium: its level of the aorta is half-way to the LSA
            lcca = 0.5 * (bca + lsa)
        places = [bca, lcca, lsa, lsa + p.lsa_aberrant_spacing][: len(p.branches)]
        levels = [float(np.interp(place, arc, s)) for place in places]
    return points, radii, outer, levels


def arch_tree(params: ArchParameters) -> VesselTree:
    """Vessels of an arch; ValueError if branches do not fit or intersect."""
    plane = Plane(params.plane_rotation, params.plane_tilt)
    points, radii, outer, levels = _outer_curve(params)
    s = arc_lengths(points)
    phase = math.pi * s / s[-1]
    aside = params.bow * np.sin(phase) + params.sway * np.sin(2.0 * phase)
    line = plane.to_world(points) + aside[:, None] * plane.normal
    aorta = Vessel("aorta", Centreline(line, radii))
    vessels = {"aorta": aorta}
    for (name, branch), level, septum in zip(
        params.branches.items(), levels, _septa(params), strict=True
    ):
        upstream, lean = math.tan(branch.take_off), math.tan(branch.lean)
        side = np.cross(_UPRIGHT, plane.along)
        direction = _UPRIGHT - upstream * plane.along + lean * side
        direction = direction / np.linalg.norm(direction)
        fillet = min(_FILLET, 0.4 * max(septum - MINIMUM_SEPTUM, 0.0))
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
        vessels[name] = _branch_vessel(
            name, branch, parent, ostium, direction, plane, max(float(fillet), 0.0)
        )
    tree = with_courses(VesselTree(vessels), params.neck)
    check_septa(tree)
    return tree


def _ostium(
    points: Array, outer: Array, level: float, aorta: Vessel, plane: Plane, lean: float
) -> Array:
    """Ostium (3,), m, on the aorta's surface at `lean`, rad, from its outer curve."""
    flat, numbers = arc_lengths(points), np.arange(len(points))
    index = float(np.interp(level, flat, numbers))
    # The curve in space is a little longer than the one in the plane.
    s = float(np.interp(index, numbers, aorta.centreline.arc_length))
    outward = plane.to_world(interpolate(level, flat, outer - points))
    place = aorta.centreline.at(s)
    outward = outward - (outward @ place.tangent) * place.tangent
    outward /= np.linalg.norm(outward)
    aside = np.cross(outward, place.tangent)
    aside *= np.sign(aside @ plane.normal) or 1.0
    around = math.cos(lean) * outward + math.sin(lean) * aside
    return place.position + float(place.radius) * around


def _septa(params: ArchParameters) -> list[float]:
    """Wall (m) between each ostium, without flare, and the nearest other ostium."""
    radii = [branch.radius for branch in params.branches.values()]
    before, last = math.inf, math.inf
    after = params.lcca_lsa_spacing - radii[0 if params.bovine else 1] - radii[2]
    if not params.bovine:  # a bovine LCCA leaves the BCA
        before = params.bca_lcca_spacing - radii[0] - radii[1]
    if params.aberrant is not None:
        last = params.lsa_aberrant_spacing - radii[2] - radii[3]
    septa = [before, min(before, after), min(after, last), last]
    return septa[: len(radii)]


def _branch_vessel(
    name: str,
    p: BranchParameters,
    parent: Vessel,
    ostium: Array,
    direction: Array,
    plane: Plane,
    fillet: float,
) -> Vessel:
    """Branch through an ostium (3,), m, with its direction (3,) and fillet (m)."""
    # The branch starts where its axis, extended back into the parent, is nearest to the
    # parent's centreline, and its direction is from there to the ostium.
    line = parent.centreline
    back = np.linspace(0.0, 4.0, 400)[:, None] * float(line.project(ostium).radius)
    crossing = line.project(ostium - back * direction)
    place = line.at(crossing.arc_length[crossing.distance.argmin()])
    direction = ostium - place.position
    exit_length = float(np.linalg.norm(direction))
    direction = direction / exit_length
    outward = ostium - line.at(line.project(ostium).arc_length).position
    tilt = math.acos(np.clip(direction @ outward / np.linalg.norm(outward), -1.0, 1.0))
    wide, parent_radius = p.radius + fillet, float(place.radius)
    longest = _LONGEST_EXIT * parent_radius
    if tilt > _MOST_OBLIQUE or exit_length > longest:
        raise ValueError(
            f"branch {name!r} leaves at {math.degrees(tilt):.0f} degrees, "
            f"{exit_length * 1e3:.0f} mm from its parent's centreline; at most "
            f"{math.degrees(_MOST_OBLIQUE):.0f} degrees and {longest * 1e3:.0f} mm are "
            "allowed: mend take_off"
        )
    if wide > 0.95 * parent_radius:
        raise ValueError(
            f"branch {name!r} has a radius of {wide:g} m at its ostium, more than 0.95 "
            f"of its parent's, {parent_radius:g} m; make it smaller"
        )
    flare_start = flare_begin(wide, parent_radius, tilt, exit_length)
    flare_end = exit_length + 2.0 * fillet + p.radius * math.tan(tilt)
    length = exit_length + p.length
    flare = 2 + int((flare_end - flare_start) / _FLARE_STEP)
    beyond = 2 + int((length - flare_end) / _CURVED_STEP)
    parts = (
        np.linspace(0.0, flare_start, 4),
        np.linspace(flare_start, flare_end, flare),
        np.linspace(flare_end, length, beyond),
    )
    s = np.unique(np.concatenate(parts))
    points = place.position + _path(p, s, direction, plane, flare_end + 6e-3, length)
    progress = np.clip((s - exit_length) / p.length, 0.0, 1.0)
    # The fillet falls quadratically from where the cross-section is in the parent.
    u = np.clip((s - flare_start) / (flare_end - flare_start), 0.0, 1.0)
    radii = p.radius + (p.end_radius - p.radius) * progress + fillet * (1.0 - u) ** 2
    return Vessel(name, Centreline(points, radii), parent.name, exit_length)


def _path(
    p: BranchParameters, s: Array, direction: Array, plane: Plane,
    bend_start: float, length: float,
) -> Array:  # fmt: skip
    """Points (n, 3), m, at arc lengths `s` of a branch that starts at the origin."""
    in_plane = np.cross(plane.normal, direction)
    in_plane /= np.linalg.norm(in_plane)
    if in_plane @ plane.along < 0.0:
        in_plane = -in_plane
    side = np.cross(direction, in_plane)
    side *= np.sign(side @ plane.normal) or 1.0
    bend = math.cos(p.bend_azimuth) * in_plane + math.sin(p.bend_azimuth) * side
    if p.second_bend_radius is None:
        turn = np.maximum(s - bend_start, 0.0) / p.bend_radius
        along = np.minimum(s, bend_start) + p.bend_radius * np.sin(turn)
        aside = p.bend_radius * (1.0 - np.cos(turn))
        return along[:, None] * direction + aside[:, None] * bend
    # Integrates the curvature in a twist-free frame.
    count = max(2, math.ceil(length / _INTEGRATION_STEP))
    fine = np.linspace(0.0, length, count)
    middle = 0.5 * (bend_start + length)
    later = np.clip((fine - middle) / _BLEND + 0.5, 0.0, 1.0)
    first = (fine >= bend_start) * (1.0 - later) / p.bend_radius
    second = later / p.second_bend_radius
    azimuth, angle = p.bend_azimuth, p.second_bend_azimuth
    curls_u = first * math.cos(azimuth) + second * math.cos(angle)
    curls_v = first * math.sin(azimuth) + second * math.sin(angle)
    tangent, u, v, step = direction, in_plane, side, fine[1] - fine[0]
    tangents = np.empty((len(fine), 3))
    for i, (curl_u, curl_v) in enumerate(zip(curls_u, curls_v, strict=True)):
        tangents[i] = tangent
        tangent = tangent + step * (curl_u * u + curl_v * v)
        tangent = tangent / math.sqrt(tangent @ tangent)
        u = u - (u @ tangent) * tangent
        u = u / math.sqrt(u @ u)
        v = v - (v @ tangent) * tangent - (v @ u) * u
        v = v / math.sqrt(v @ v)
    steps = 0.5 * step * (tangents[1:] + tangents[:-1])
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return interpolate(s, fine, points)
