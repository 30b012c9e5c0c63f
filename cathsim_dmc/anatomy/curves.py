"""Vessel trees from measured centrelines: splines, ostia, flares; m."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.centreline import (
    Array,
    Centreline,
    Vessel,
    VesselTree,
    arc_lengths,
)

# RMS residuals of the splines through measured positions and radii, m: below the
# resolution of a 0.5 mm lattice.
_SMOOTHING, _RADIUS_SMOOTHING = 0.35e-3, 0.15e-3
_FLARE = 1e-3  # m, increase of a radius at its ostium, if the parent is wide enough
_STEP = 1e-3  # m, between the points of a built centreline
_FINE = 0.25e-3  # m, step of the search for an ostium
_LEAST_BEND = 1.05  # least bend radius in lumen radii; below it the lumen folds
_WIDEST_OSTIUM = 0.95  # of the parent's radius
_FLARE_MARGIN = 1.25  # of a straight branch's flare
_LEAST_WALL = 0.2e-3  # m, between two lumens side by side
_LONGEST_JUNCTION = 8.0  # radii past the ostium over which a branch joins its parent


@dataclass(frozen=True, eq=False)
class Curve(Centreline):
    """A measured centreline; ValueError if a shape or a value is not as stated.

    Attributes:
        points: (n, 3) float64, metres; n >= 2. A branch begins inside its parent and
            runs away from it.
        radii: (n,) float64, metres: radius of the vessel's own lumen. Those of a
            branch inside its parent are ignored.
        parent: name of the vessel that it leaves; None for the root.
    """

    parent: str | None = None


def smooth_tree(curves: Mapping[str, Curve]) -> VesselTree:
    """Vessel tree through measured centrelines by name, parents before their children.

    Each vessel is a cubic smoothing spline. A branch starts on its parent's
    centreline; its ostium is where its centreline leaves the parent's lumen, and its
    radius grows towards the ostium.

    Raises:
        ValueError: if a branch does not begin in its parent or never leaves it, if a
            vessel bends more sharply than its lumen allows, or if two vessels
            intersect; names the vessel and the place.
    """
    vessels: dict[str, Vessel] = {}
    for name, curve in bounds.instance("tree", curves, Mapping).items():
        bounds.instance(f"vessel {name!r}", curve, Curve)
        if curve.parent is None:
            dense = _smooth(curve.points, _STEP)
            line = Centreline(dense, np.ones(len(dense)))
            places, fresh = _places(line, curve.points)
            radii = _radii(places[fresh], curve.radii[fresh], line.arc_length)
            vessels[name] = Vessel(name, Centreline(dense, radii))
        else:
            before = bounds.choice(f"the parent before {name!r}", curve.parent, vessels)
            vessels[name] = _branch(name, curve, vessels[before])
        _check_bends(vessels[name])
    tree = VesselTree(vessels)
    check_septa(tree)
    return tree


def _smooth(points: Array, step: float, first_weight: float = 1.0) -> Array:
    """Points (n, 3), m, of a smoothing spline at equal steps of about `step` (m)."""
    from scipy import interpolate  # slow to import

    chord = arc_lengths(points)
    weights = np.ones(len(points))
    weights[0] = first_weight
    # In millimetres, the scale that fitpack's tolerances suit.
    degree, miss = min(3, len(points) - 1), len(points) * (1e3 * _SMOOTHING) ** 2
    (knots, coefficients, _), _ = interpolate.splprep(
        1e3 * points.T, u=chord, w=weights, k=degree, s=miss
    )
    spline = interpolate.BSpline(knots, 1e-3 * np.array(coefficients).T, degree)
    end = float(chord[-1])
    parameter = np.linspace(0.0, end, max(20, 10 * math.ceil(end / step)))
    arc = arc_lengths(spline(parameter))
    count = max(2, math.ceil(arc[-1] / step) + 1)
    # Evaluates the spline: interpolation between points would disturb the curvature.
    return spline(np.interp(np.linspace(0.0, arc[-1], count), arc, parameter))


def _radii(places: Array, values: Array, at: Array) -> Array:
    """Smoothed radii (m) at arc lengths `at` (m); constant outside the measurements."""
    from scipy import interpolate

    if len(places) < 4:
        return np.interp(at, places, values)
    miss = len(values) * (1e3 * _RADIUS_SMOOTHING) ** 2
    spline = interpolate.splrep(places, 1e3 * values, s=miss)
    smooth = 1e-3 * interpolate.splev(np.clip(at, places[0], places[-1]), spline)
    # A spline may overshoot where the calibre changes abruptly.
    return np.clip(smooth, 0.9 * values.min(), 1.1 * values.max())


def _places(line: Centreline, points: Array) -> tuple[Array, np.ndarray]:
    """Non-decreasing arc lengths (n,), m, of points, and a mask of those that grow."""
    places = np.maximum.accumulate(line.project(points).arc_length)
    return places, np.append(True, np.diff(places) > 1e-6)


def _branch(name: str, curve: Curve, parent: Vessel) -> Vessel:
    start = _onto_parent(name, curve.points, parent)
    # The weight holds the start, which is not measured, on the parent's centreline.
    dense = _smooth(start, _FINE, first_weight=100.0)
    dense[0] = start[0]
    fine = Centreline(dense, np.ones(len(dense)))
    ostium = ostium_of(name, fine, parent)
    place = fine.at(ostium)
    line = parent.centreline
    foot = line.at(line.locate(place.position))
    outward = place.position - foot.position
    outward /= np.linalg.norm(outward)
    tilt = math.acos(float(np.clip(place.tangent @ outward, -1.0, 1.0)))
    places, own = _places(fine, curve.points)
    own &= places >= ostium
    if not own.any():
        raise ValueError(f"branch {name!r} has no point past its ostium; give it more")
    calibre = float(curve.radii[own][0])
    origin = line.at(line.locate(fine.points[0]))
    parent_radius = max(float(origin.radius), float(foot.radius))
    room = _WIDEST_OSTIUM * parent_radius - calibre
    if room < 0.0:
        raise ValueError(
            f"branch {name!r} has a radius of {calibre * 1e3:.1f} mm at its ostium, "
            f"and may have {_WIDEST_OSTIUM:g} of its parent's, which is "
            f"{parent_radius * 1e3:.1f} mm; give that of its own lumen"
        )
    wide = calibre + min(_FLARE, room)
    tilt = min(tilt, math.radians(60.0))
    begin = flare_begin(wide, parent_radius, tilt, ostium)
    over = ostium + 2.0 * max(wide - calibre, 0.5e-3) + calibre * math.tan(tilt)
    s = np.linspace(0.0, fine.length, max(2, math.ceil(fine.length / _STEP) + 1))
    fine_s = np.arange(begin, over, 0.5e-3)
    s = np.unique(np.concatenate([s[(s < begin) | (s > over)], fine_s, [over]]))
    s = s[np.append(True, np.diff(s) > 0.1e-3)]
    u = np.clip((s - begin) / (over - begin), 0.0, 1.0)
    radii = _radii(places[own], curve.radii[own], s)
    radii = radii + (wide - calibre) * (1.0 - u) ** 2
    return Vessel(name, Centreline(fine.at(s).position, radii), parent.name, ostium)


def flare_begin(wide: float, parent_radius: float, tilt: float, ostium: float) -> float:
    """Arc length (m) at which the flare of a branch begins.

    The branch has the radius `wide` (m) at its ostium and the angle `tilt` (rad) to
    the normal of the parent's wall.
    """
    sag = parent_radius - math.sqrt(parent_radius**2 - min(wide, parent_radius) ** 2)
    inwards = _FLARE_MARGIN * (sag + wide * math.tan(tilt)) + 1e-3
    return max(ostium - inwards, 0.1 * ostium)


def _onto_parent(name: str, points: Array, parent: Vessel) -> Array:
    """Points (n, 3), m, of a branch that start on its parent's centreline."""
    line = parent.centreline
    first = line.project(points[0])
    if first.distance > first.radius:
        raise ValueError(
            f"branch {name!r} begins {first.distance * 1e3:.1f} mm from the centreline "
            f"of {parent.name!r}, outside its radius of {first.radius * 1e3:.1f} mm; "
            "let it begin in its parent, or name another"
        )
    foot = line.at(first.arc_length).position
    # Points near the foot are dropped, as they would make a sharp turn.
    near = np.linalg.norm(points - foot, axis=1) < max(0.25 * first.radius, 1e-3)
    kept = points[np.argmin(near) :] if not near.all() else points[-1:]
    return np.concatenate([foot[None], kept])


def ostium_of(name: str, line: Centreline, parent: Vessel) -> float:
    """Arc length (m) at which a branch leaves its parent's lumen for good.

    Raises:
        ValueError: if the branch ends inside its parent.
    """
    near = parent.centreline.project(line.points)
    outside = near.distance - near.radius
    if outside[-1] <= 0.0:
        raise ValueError(
            f"branch {name!r} ends inside its parent {parent.name!r}; give more points"
        )
    last = int(np.flatnonzero(outside <= 0.0)[-1])
    share = -outside[last] / (outside[last + 1] - outside[last])
    s = line.arc_length
    return float(s[last] + share * (s[last + 1] - s[last]))


def _check_bends(vessel: Vessel) -> None:
    line = vessel.centreline
    # The bend is taken over one lumen radius; a shorter kink is no bend.
    s = np.arange(vessel.ostium, line.length, 1e-3)
    if len(s) < 3:
        return
    place = line.at(s)
    ahead, behind = (line.at(s + sign * place.radius) for sign in (0.5, -0.5))
    turn = np.arccos(np.clip(np.vecdot(ahead.tangent, behind.tangent), -1.0, 1.0))
    bend = place.radius / np.maximum(turn, 1e-9)
    worst = int((bend / place.radius).argmin())
    if bend[worst] < _LEAST_BEND * place.radius[worst]:
        x, y, z = np.round(place.position[worst] * 1e3, 1)
        raise ValueError(
            f"vessel {vessel.name!r} bends with a radius of {bend[worst] * 1e3:.1f} mm "
            f"at ({x}, {y}, {z}) mm, where its lumen radius is "
            f"{place.radius[worst] * 1e3:.1f} mm; the lumen would fold: mend the points"
        )


def _junction_end(vessel: Vessel, parent: Vessel) -> float:
    """Arc length (m) past the ostium from which two tubes are `_LEAST_WALL` apart."""
    line = vessel.centreline
    s = np.arange(vessel.ostium, line.length, 0.5e-3)
    place = line.at(s)
    near = parent.centreline.project(place.position)
    free = near.distance - near.radius - place.radius >= _LEAST_WALL
    most = _LONGEST_JUNCTION * place.radius[0]
    if not (free & (s - vessel.ostium <= most)).any():
        raise ValueError(
            f"branch {vessel.name!r} does not part from {parent.name!r} within "
            f"{most * 1e3:.0f} mm of its ostium; start it further on, or merge the two"
        )
    return float(s[int(free.argmax())])


def check_septa(tree: VesselTree) -> None:
    """Raise ValueError if two lumens touch other than at a junction."""
    free = {
        name: _junction_end(vessel, tree.vessel(vessel.parent))
        for name, vessel in tree.vessels.items()
        if vessel.parent is not None
    }
    for name, start in free.items():
        vessel = tree.vessel(name)
        line = vessel.centreline
        for other in tree.vessels.values():
            if other is vessel or name == other.parent:
                continue
            is_parent, body = other.name == vessel.parent, other.centreline
            outside = line.slice(start if is_parent else vessel.ostium, line.length)
            if other.name in free and not is_parent:
                body = body.slice(other.ostium, body.length)
            near = body.project(outside.points)
            clear = near.distance - near.radius - outside.radii
            worst = int(clear.argmin())
            if clear[worst] < _LEAST_WALL - 1e-9:
                x, y, z = np.round(outside.points[worst] * 1e3, 1)
                raise ValueError(
                    f"vessels {name!r} and {other.name!r} come within "
                    f"{clear[worst] * 1e3:.1f} mm of each other at ({x}, {y}, {z}) mm; "
                    f"a wall between them needs {_LEAST_WALL * 1e3:.1f} mm."
                )
