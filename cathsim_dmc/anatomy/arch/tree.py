"""Geometry of parametric aortic arches: from their figures to a vessel tree."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cathsim_dmc.anatomy.arch.parameters import (
    MINIMUM_SEPTUM,
    ArchParameters,
    BranchParameters,
)
from cathsim_dmc.anatomy.centreline import Array, Centreline, Vessel, VesselTree

# Polyline steps, m: the chord of 2 mm on a 34 mm arch departs 0.015 mm from it.
_STRAIGHT_STEP = 5e-3
_CURVED_STEP = 2e-3
_FLARE_STEP = 0.5e-3
# A branch must leave its parent within this angle of the wall's normal, rad, and
# within this multiple of the parent's radius along its axis: an ostium more
# oblique than that is a slit.
_MOST_OBLIQUE = math.radians(60.0)
_LONGEST_EXIT = 2.2


def _smooth_interpolation(s: Array, stations: Array, values: Array) -> Array:
    """C1 interpolation, monotone between stations, constant outside them."""
    index = np.clip(np.searchsorted(stations, s) - 1, 0, len(stations) - 2)
    t = (s - stations[index]) / (stations[index + 1] - stations[index])
    t = np.clip(t, 0.0, 1.0)
    t = t * t * (3.0 - 2.0 * t)
    return values[index] * (1.0 - t) + values[index + 1] * t


def _aorta_points(p: ArchParameters) -> Array:
    """Centreline (n, 2) of the aorta in its plane: along the arch, and up."""
    rise = np.arange(round(p.ascending_length / _STRAIGHT_STEP)) * _STRAIGHT_STEP
    rise *= p.ascending_length / (len(rise) * _STRAIGHT_STEP)
    angle = np.linspace(0.0, math.pi, 2001)
    ellipse = np.stack(
        [
            p.arch_radius * (1.0 - np.cos(angle)),
            p.ascending_length + p.arch_height * np.sin(angle),
        ],
        axis=1,
    )
    # Equal steps along the ellipse.
    arc = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(ellipse, axis=0), axis=1))]
    )
    even = np.linspace(0.0, arc[-1], round(arc[-1] / _CURVED_STEP) + 1)
    ellipse = np.stack([np.interp(even, arc, ellipse[:, i]) for i in (0, 1)], axis=1)
    count = round(p.descending_length / _STRAIGHT_STEP)
    fall = np.linspace(0.0, p.descending_length, count + 1)[1:]
    return np.concatenate(
        [
            np.stack([np.zeros_like(rise), rise], axis=1),
            ellipse,
            np.stack(
                [np.full_like(fall, 2 * p.arch_radius), p.ascending_length - fall],
                axis=1,
            ),
        ]
    )


@dataclass(frozen=True)
class _Plane:
    """The vertical plane of the arch: `along` the arch, up, and its `normal`."""

    along: Array
    normal: Array

    @classmethod
    def rotated(cls, rotation: float) -> _Plane:
        along = np.array([math.sin(rotation), math.cos(rotation), 0.0])
        return cls(along, np.cross([0.0, 0.0, 1.0], along))

    def to_world(self, flat: Array) -> Array:
        """World coordinates (..., 3) of in-plane ones (..., 2)."""
        return flat[..., :1] * self.along + flat[..., 1:] * np.array([0.0, 0.0, 1.0])


def _outer_curve(p: ArchParameters) -> tuple[Array, Array, Array, dict[str, float]]:
    """Aorta in its plane: points (n, 2), radii (n,), outer curve, branch levels.

    The levels are arc lengths on the centreline. They depend on the outer curve,
    which depends on the radii, which depend on the levels: iterate.
    """
    points = _aorta_points(p)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    tangent = np.gradient(points, s, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    outward = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    top = s[points[:, 1].argmax()]
    levels = {"bca": top - 15e-3, "lcca": top, "lsa": top + 12e-3}
    arch_end = float(s[-1] - p.descending_length)
    for _ in range(8):
        stations = np.array([0.5 * p.ascending_length, *levels.values(), arch_end])
        if np.any(np.diff(stations) <= 1e-3):
            raise ValueError(
                f"the branches lie at {np.round(stations[1:4] * 1e3, 1).tolist()} mm "
                "along the aorta, which does not fit between the middle of the "
                f"ascending ({stations[0] * 1e3:.1f} mm) and the end of the arch "
                f"({arch_end * 1e3:.1f} mm); reduce bca_drop or the spacings, or "
                "enlarge the arch."
            )
        radii = _smooth_interpolation(
            s,
            stations,
            np.array(
                [
                    p.ascending_radius,
                    p.bca_level_radius,
                    p.lcca_level_radius,
                    p.lsa_level_radius,
                    p.descending_radius,
                ]
            ),
        )
        outer = points + radii[:, None] * outward
        arc = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(outer, axis=0), axis=1))]
        )
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
        levels = {
            name: float(np.interp(place, arc, s))
            for name, place in (("bca", bca), ("lcca", lcca), ("lsa", lsa))
        }
    return points, radii, outer, levels


def _branch(
    name: str,
    p: BranchParameters,
    parent: Vessel,
    ostium: Array,
    direction: Array,
    plane: _Plane,
    fillet: float,
) -> Vessel:
    """Branch through `ostium` (3,) on the parent's surface along `direction` (3,)."""
    line = parent.centreline
    # Start where the axis, followed back into the parent, is nearest to the
    # parent's centreline; then aim from there at the ostium.
    back = np.linspace(0.0, 4.0, 400)[:, None] * float(line.project(ostium).radius)
    crossing = line.project(ostium - back * direction)
    place = line.at(crossing.arc_length[crossing.distance.argmin()])
    origin = place.position
    direction = ostium - origin
    exit_length = float(np.linalg.norm(direction))
    direction = direction / exit_length
    outward = ostium - line.at(line.project(ostium).arc_length).position
    tilt = math.acos(np.clip(direction @ outward / np.linalg.norm(outward), -1.0, 1.0))
    parent_radius = float(place.radius)
    if tilt > _MOST_OBLIQUE or exit_length > _LONGEST_EXIT * parent_radius:
        raise ValueError(
            f"branch {name!r} leaves at {math.degrees(tilt):.0f} degrees from the "
            f"normal of its parent's wall, {exit_length * 1e3:.0f} mm from its "
            f"centreline; at most {math.degrees(_MOST_OBLIQUE):.0f} degrees and "
            f"{_LONGEST_EXIT * parent_radius * 1e3:.0f} mm are allowed. Change its "
            "take_off."
        )
    # The flare reaches inwards until the whole ring is inside the parent, so that
    # the wall is convex along the branch wherever it exists.
    wide = p.radius + fillet
    if wide > 0.95 * parent_radius:
        raise ValueError(
            f"branch {name!r} with its fillet has radius {wide:g} m at the ostium; its "
            f"parent's lumen radius is {parent_radius:g} m. Make the branch smaller."
        )
    sag = parent_radius - math.sqrt(parent_radius**2 - wide**2)
    reach = wide * math.tan(tilt)
    # A bent parent needs more than this estimate for a straight one.
    inwards = 1.25 * (sag + reach) + 1e-3
    flare_start = max(exit_length - inwards, 0.1 * exit_length)
    flare_end = exit_length + 2.0 * fillet + p.radius * math.tan(tilt)
    bend_start = flare_end + 6e-3
    length = exit_length + p.length
    s = np.unique(
        np.concatenate(
            [
                np.linspace(0.0, flare_start, 4),
                np.linspace(
                    flare_start,
                    flare_end,
                    2 + int((flare_end - flare_start) / _FLARE_STEP),
                ),
                np.linspace(
                    flare_end, length, 2 + int((length - flare_end) / _CURVED_STEP)
                ),
            ]
        )
    )
    in_plane = np.cross(plane.normal, direction)
    in_plane /= np.linalg.norm(in_plane)
    if in_plane @ plane.along < 0.0:
        in_plane = -in_plane
    side = np.cross(direction, in_plane)
    side *= np.sign(side @ plane.normal) or 1.0
    bend = math.cos(p.bend_azimuth) * in_plane + math.sin(p.bend_azimuth) * side
    turn = np.maximum(s - bend_start, 0.0) / p.bend_radius
    points = (
        origin
        + (np.minimum(s, bend_start) + p.bend_radius * np.sin(turn))[:, None]
        * direction
        + (p.bend_radius * (1.0 - np.cos(turn)))[:, None] * bend
    )
    progress = np.clip((s - exit_length) / p.length, 0.0, 1.0)
    # Quadratic from the full fillet where the ring is inside the parent to none.
    u = np.clip((s - flare_start) / (flare_end - flare_start), 0.0, 1.0)
    radii = p.radius + (p.end_radius - p.radius) * progress + fillet * (1.0 - u) ** 2
    return Vessel(name, Centreline(points, radii), parent.name, exit_length)


def arch_tree(params: ArchParameters) -> VesselTree:
    """Vessels "aorta", "bca", "lcca", "lsa" of an arch.

    Raises:
        ValueError: if branches do not fit on the arch or run into each other.
    """
    plane = _Plane.rotated(params.plane_rotation)
    points, radii, outer, levels = _outer_curve(params)
    aorta = Vessel("aorta", Centreline(plane.to_world(points), radii))
    vessels = {"aorta": aorta}
    septa = {
        "bca": math.inf
        if params.bovine
        else params.bca_lcca_spacing - params.bca.radius - params.lcca.radius,
        "lsa": params.lcca_lsa_spacing
        - (params.bca if params.bovine else params.lcca).radius
        - params.lsa.radius,
    }
    septa["lcca"] = min(septa.values())
    s = aorta.centreline.arc_length
    for name in ("bca", "lcca", "lsa"):
        branch: BranchParameters = getattr(params, name)
        heading = np.array([-math.sin(branch.take_off), math.cos(branch.take_off)])
        direction = plane.to_world(heading)
        fillet = min(params.fillet, 0.4 * max(septa[name] - MINIMUM_SEPTUM, 0.0))
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
            at = [np.interp(levels[name], s, outer[:, axis]) for axis in (0, 1)]
            ostium = plane.to_world(np.array(at))
        vessels[name] = _branch(
            name, branch, parent, ostium, direction, plane, max(fillet, 0.0)
        )
    tree = VesselTree(vessels)
    _check_septa(tree)
    return tree


def _check_septa(tree: VesselTree) -> None:
    """Raise ValueError if two lumens touch away from where one leaves the other."""
    for vessel in tree.vessels.values():
        if vessel.parent is None:
            continue
        line = vessel.centreline
        parent_line = tree.vessel(vessel.parent).centreline
        outside = line.slice(vessel.ostium, line.length)
        for other in tree.vessels.values():
            if other is vessel or vessel.name == other.parent:
                continue
            if other.name == vessel.parent:
                # Only beyond the junction: twice the radius past the ostium.
                past = outside.arc_length > 3.0 * outside.radii
                gap = parent_line.project(outside.points[past])
                clear = gap.distance - gap.radius - outside.radii[past]
            else:
                body = other.centreline.slice(other.ostium, other.centreline.length)
                near = body.project(outside.points)
                clear = near.distance - near.radius - outside.radii
            if clear.size and clear.min() < 0.2 * MINIMUM_SEPTUM:
                raise ValueError(
                    f"vessels {vessel.name!r} and {other.name!r} come within "
                    f"{clear.min() * 1e3:.1f} mm of each other; change their take_off, "
                    "bend or spacing so that a wall fits between them."
                )
