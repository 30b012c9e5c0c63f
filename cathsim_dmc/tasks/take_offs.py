"""Where a route leaves one vessel for a narrower one, and how it turns there."""

import numpy as np

from cathsim_dmc.tasks.route import ROUTE_SPACING, Route

# A take-off: a lumen of this radius, m, or more falls below this share of itself within
# this way, m, at a bend of this angle, rad, and this far, m, behind the last take-off.
# In narrower vessels all devices follow the wall.
_WIDE, _SHARE, _WITHIN, _BEND, _APART = 4.5e-3, 0.75, 10e-3, 0.6, 15e-3
CLOSE = 30e-3  # m from one take-off to the next


def take_offs(route: Route) -> list[float]:
    """Arc lengths, m, where a route leaves one vessel for a narrower one, one or more.

    Each is where the lumen narrows fastest. Where it does not narrow at a bend, it is
    where the route narrows fastest of all.
    """
    radii, way = route.radii, round(_WITHIN / ROUTE_SPACING)
    wide = radii[:-way] >= _WIDE
    narrows = np.flatnonzero(wide & (radii[way:] < _SHARE * radii[:-way]))
    found: list[float] = []
    for run in np.split(narrows, np.flatnonzero(np.diff(narrows) > 1) + 1):
        if len(run):
            steepest = run[0] + np.diff(radii[run[0] : run[-1] + way + 1]).argmin()
            place = float(route.arc_length[steepest])
            far = not found or place > found[-1] + _APART
            if far and bend(route, place)[0] > _BEND:
                found.append(place)
    return found or [route.narrowing]


def followed(route: Route) -> tuple[float, bool]:
    """The last of the take-offs that are close to each other, from the first one on.

    Returns:
        Its arc length, m, and whether it is another than the first.
    """
    first, *others = take_offs(route)
    last = first
    for place in others:
        last = place if place < last + CLOSE else last
    return last, last != first


def last_apart(route: Route) -> float:
    """The last of several take-offs, none of which follows the first one closely.

    Returns:
        Its arc length, m; infinite where there is one alone, or one is close.
    """
    places = take_offs(route)
    apart = len(places) > 1 and places[1] >= places[0] + CLOSE
    return places[-1] if apart else float("inf")


def bend(route: Route, place: float, way: float = 20e-3) -> tuple[float, float]:
    """Turn of a route at a place, rad, and cosine between its plane and that before.

    Args:
        place: arc length, m.
        way: over which the directions before and after the place are measured, m.
    """
    points = route.at(place + way * np.array([-2.0, -1.0, 0.0, 1.0]))
    ways = np.diff(points, axis=0)
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    turn = float(np.arccos(np.clip(ways[1] @ ways[2], -1.0, 1.0)))
    planes = np.cross(ways[:2], ways[1:])
    planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), 1e-9)
    return turn, abs(float(planes[0] @ planes[1]))
