"""Parametric aortic arches: the figures, the tree they give, presets, a sampler.

Built in the patient frame LPS with the inlet of the ascending aorta at the
origin. The ascending aorta runs straight up (+z), the arch is half an ellipse
in a vertical plane, the descending aorta runs straight down. Three branches
leave the outer curve: brachiocephalic (bca), left common carotid (lcca) and
left subclavian artery (lsa).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from cathsim_dmc.anatomy.centreline import Array, Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.phantom import Anatomy, End, Goal, Inlet

# Polyline steps, m: the chord of 2 mm on a 34 mm arch departs 0.015 mm from it.
_STRAIGHT_STEP = 5e-3
_CURVED_STEP = 2e-3
_FLARE_STEP = 0.5e-3
# Two lumens side by side need this much wall between them, m.
MINIMUM_SEPTUM = 1e-3
# Range of the BCA drop in LCCA diameters for each type of arch (class by the
# vertical distance from the BCA origin to the top of the arch).
DROP_RANGES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"I": (0.0, 1.0), "II": (1.0, 2.0), "III": (2.0, 3.0)}
)


def _check(name: str, value: float, low: float, high: float, unit: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ValueError(
            f"{name} is {value:g} {unit}; allowed is {low:g} to {high:g} {unit}."
        )


@dataclass(frozen=True)
class BranchParameters:
    """Figures of one branch of the arch (metres, radians).

    Attributes:
        radius: lumen radius at the origin, before the flare of the ostium.
        end_radius: lumen radius at the distal end; the taper is linear.
        take_off: angle of the first part from the vertical in the plane of the
            arch, positive upstream (towards the ascending aorta).
        length: from the ostium to the distal end.
        bend_radius: radius of curvature after the straight first part.
        bend_azimuth: direction of the bend: 0 downstream in the plane of the arch,
            pi upstream, pi/2 out of the plane to the patient's right and back.
        goal_depth: distance of the goal beyond the ostium, along the branch.
    """

    radius: float
    end_radius: float
    take_off: float
    length: float = 45e-3
    bend_radius: float = 100e-3
    bend_azimuth: float = 0.0
    goal_depth: float = 27e-3

    def __post_init__(self) -> None:
        _check("branch radius", self.radius, 1.5e-3, 12e-3, "m")
        _check("branch end_radius", self.end_radius, 1.0e-3, 12e-3, "m")
        _check("branch take_off", self.take_off, -1.3, 1.3, "rad")
        _check("branch length", self.length, 40e-3, 150e-3, "m")
        _check("branch bend_radius", self.bend_radius, 40e-3, 10.0, "m")
        _check("branch bend_azimuth", self.bend_azimuth, -2 * math.pi, 2 * math.pi, "")
        _check("branch goal_depth", self.goal_depth, 5e-3, self.length - 5e-3, "m")


@dataclass(frozen=True)
class ArchParameters:
    """Every figure of an aortic arch (metres, radians).

    Attributes:
        ascending_radius, bca_level_radius, lcca_level_radius, lsa_level_radius,
            descending_radius: lumen radius of the aorta at five levels.
        ascending_length: straight part from the inlet to the start of the arch.
        descending_length: straight part from the end of the arch to the cap.
        arch_radius: half the distance between the axes of the two limbs.
        arch_height: from the end of the straight limbs to the top of the arch's
            centreline; equal to arch_radius for a circular arch.
        plane_rotation: angle of the plane of the arch from the sagittal plane,
            positive when the descending aorta lies to the left of the ascending.
        bca_drop: height of the top of the arch above the BCA ostium, in LCCA
            diameters (type I below 1, II from 1 to 2, III above 2).
        bca_lcca_spacing, lcca_lsa_spacing: between ostium centres along the outer
            curve of the arch.
        bca, lcca, lsa: the branches.
        fillet: by how much the radius of a branch grows at its ostium, at most.
        descending_goal_depth: distance of the goal "descending" from the cap.
        bovine: the LCCA leaves the BCA `bca_lcca_spacing` above the BCA's ostium
            (measured along the BCA) instead of leaving the arch.
    """

    bca: BranchParameters
    lcca: BranchParameters
    lsa: BranchParameters
    ascending_radius: float = 14.75e-3
    bca_level_radius: float = 14.3e-3
    lcca_level_radius: float = 13.55e-3
    lsa_level_radius: float = 12.65e-3
    descending_radius: float = 11.95e-3
    ascending_length: float = 62.6e-3
    descending_length: float = 100e-3
    arch_radius: float = 34e-3
    arch_height: float = 34e-3
    plane_rotation: float = math.radians(50.3)
    bca_drop: float = 0.5
    bca_lcca_spacing: float = 21.8e-3
    lcca_lsa_spacing: float = 14.3e-3
    fillet: float = 2.5e-3
    descending_goal_depth: float = 30e-3
    bovine: bool = False

    def __post_init__(self) -> None:
        for level in ("ascending", "bca_level", "lcca_level", "lsa_level"):
            name = f"{level}_radius"
            _check(name, getattr(self, name), 7e-3, 25e-3, "m")
        _check("descending_radius", self.descending_radius, 6e-3, 22e-3, "m")
        _check("ascending_length", self.ascending_length, 20e-3, 150e-3, "m")
        _check("descending_length", self.descending_length, 40e-3, 400e-3, "m")
        _check("arch_radius", self.arch_radius, 20e-3, 70e-3, "m")
        _check("arch_height", self.arch_height, 15e-3, 90e-3, "m")
        _check("plane_rotation", self.plane_rotation, -math.pi, math.pi, "rad")
        _check("bca_drop", self.bca_drop, 0.0, 4.0, "LCCA diameters")
        _check("fillet", self.fillet, 0.0, 5e-3, "m")
        _check(
            "descending_goal_depth",
            self.descending_goal_depth,
            5e-3,
            self.descending_length,
            "m",
        )
        widest = max(
            getattr(self, field.name)
            for field in fields(self)
            if field.name.endswith("_radius") and field.name != "arch_radius"
        )
        tightest = min(
            self.arch_radius**2 / self.arch_height,
            self.arch_height**2 / self.arch_radius,
        )
        if tightest < 1.25 * widest:
            raise ValueError(
                f"the arch (arch_radius {self.arch_radius:g} m, arch_height "
                f"{self.arch_height:g} m) bends with a radius of {tightest:g} m; it "
                f"must be at least 1.25 times the widest lumen radius ({widest:g} m). "
                "Enlarge arch_radius and arch_height or bring them closer together."
            )
        pairs = [("lcca_lsa_spacing", self.lcca, self.lsa)]
        if not self.bovine:
            pairs.append(("bca_lcca_spacing", self.bca, self.lcca))
        for name, first, second in pairs:
            need = first.radius + second.radius + MINIMUM_SEPTUM
            _check(name, getattr(self, name), need, 80e-3, "m")
        if self.bovine:
            # Leave the ostium before branching, and keep the branch on the trunk.
            low = self.lcca.radius + 2e-3
            _check("bca_lcca_spacing", self.bca_lcca_spacing, low, 25e-3, "m")
            if self.lcca.radius > 0.8 * self.bca.radius:
                raise ValueError(
                    f"a bovine LCCA of radius {self.lcca.radius:g} m needs a BCA of "
                    f"radius {self.lcca.radius / 0.8:g} m or more."
                )


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
        lcca = bca + (0.5 * p.bca_lcca_spacing if p.bovine else p.bca_lcca_spacing)
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
    tilt = math.acos(
        np.clip(direction @ outward / np.linalg.norm(outward), -1.0, 1.0)
    )
    if tilt > math.radians(65.0):
        raise ValueError(
            f"branch {name!r} leaves at {math.degrees(tilt):.0f} degrees from the "
            "normal of its parent's wall; at most 65 degrees are allowed. Change its "
            "take_off."
        )
    # The flare reaches inwards until the whole ring is inside the parent, so that
    # the wall is convex along the branch wherever it exists.
    wide = p.radius + fillet
    parent_radius = float(place.radius)
    if wide > 0.95 * parent_radius:
        raise ValueError(
            f"branch {name!r} with its fillet has radius {wide:g} m at the ostium; its "
            f"parent's lumen radius is {parent_radius:g} m. Make the branch smaller."
        )
    sag = parent_radius - math.sqrt(parent_radius**2 - wide**2)
    reach = wide * math.tan(tilt)
    flare_start = max(exit_length - sag - reach, 0.1 * exit_length)
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
        "lsa": params.lcca_lsa_spacing - params.lcca.radius - params.lsa.radius,
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


def anatomy_frame(tree: VesselTree) -> tuple[Inlet, tuple[End, ...]]:
    """Inlet at the root's first point, and every flat end of the tree."""
    root = tree.root
    first = root.centreline.at(0.0)
    inlet = Inlet(root.name, first.position, first.tangent, float(first.radius))
    ends = [End(root.name, first.position, -first.tangent, inlet.radius, True)]
    for vessel in tree.vessels.values():
        last = vessel.centreline.at(vessel.centreline.length)
        ends.append(
            End(vessel.name, last.position, last.tangent, float(last.radius), False)
        )
    return inlet, tuple(ends)


def _goals(params: ArchParameters, tree: VesselTree) -> dict[str, Goal]:
    goals = {}
    for name in ("bca", "lcca", "lsa"):
        vessel = tree.vessel(name)
        arc = vessel.ostium + getattr(params, name).goal_depth
        goals[name] = Goal(name, name, vessel.centreline.at(arc).position, arc)
    aorta = tree.root.centreline
    arc = aorta.length - params.descending_goal_depth
    goals["descending"] = Goal("descending", "aorta", aorta.at(arc).position, arc)
    return goals


@lru_cache(maxsize=32)
def build_arch(params: ArchParameters, name: str = "arch") -> Anatomy:
    """Anatomy of an arch: tree, wall, surface, inlet and goals.

    Results are kept in memory, so equal parameters give the same object.

    Raises:
        ValueError: if the parameters give no valid arch.
    """
    from cathsim_dmc.anatomy.surface import lumen_surface
    from cathsim_dmc.anatomy.wall import build_wall

    tree = arch_tree(params)
    inlet, ends = anatomy_frame(tree)
    return Anatomy(
        name=name,
        tree=tree,
        surface=lumen_surface(tree),
        wall=build_wall(tree),
        inlet=inlet,
        goals=_goals(params, tree),
        ends=ends,
    )


TYPE_I = ArchParameters(
    bca=BranchParameters(4.4e-3, 4.2e-3, math.radians(20.0)),
    lcca=BranchParameters(3.1e-3, 3.0e-3, math.radians(10.0)),
    lsa=BranchParameters(4.0e-3, 3.6e-3, math.radians(-15.0)),
    ascending_radius=13.8e-3, bca_level_radius=13.8e-3, lcca_level_radius=13.0e-3,
    lsa_level_radius=11.5e-3, descending_radius=9.1e-3, ascending_length=50e-3,
    bca_lcca_spacing=15e-3, lcca_lsa_spacing=13e-3,
)
