"""Take-offs, where a route leaves one vessel for a narrower one, and their bends."""

import numpy as np

from cathsim_dmc.tasks.route import ROUTE_SPACING, Route

# At a take-off, the radius of a lumen of at least `_WIDE`, m, falls below `_SHARE` of
# itself within `_WITHIN`, m, at a bend of more than `_BEND`, rad, and more than
# `_APART`, m, past the last take-off. In narrower vessels all devices follow the wall.
_WIDE, _SHARE, _WITHIN, _BEND, _APART = 4.5e-3, 0.75, 10e-3, 0.6, 15e-3
CLOSE = 30e-3  # m from one take-off to the next
_BEND_WAY = 20e-3  # m, over which directions before and after a place are measured


def take_offs(route: Route) -> list[float]:
    """Returns the arc lengths, m, of the take-offs of a route, at least one.

    A take-off is where the lumen narrows fastest at a bend. If there is none, it is
    where the whole route narrows fastest.
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
    """Finds the last take-off of the close series that begins with the first one.

    Returns:
        Its arc length, m, and whether it differs from the first.
    """
    first, *others = take_offs(route)
    last = first
    for place in others:
        last = place if place < last + CLOSE else last
    return last, last != first


def last_apart(route: Route) -> float:
    """Finds the last of several take-offs, if the second is not close to the first.

    Returns:
        Its arc length, m; infinite if there is only one, or the second one is close.
    """
    places = take_offs(route)
    apart = len(places) > 1 and places[1] >= places[0] + CLOSE
    return places[-1] if apart else float("inf")


def bend(route: Route, place: float) -> tuple[float, float]:
    """Turn of a route at a place, rad, and cosine between its plane and that before.

    Args:
        place: arc length, m.
    """
    points = route.at(place + _BEND_WAY * np.array([-2.0, -1.0, 0.0, 1.0]))
    ways = np.diff(points, axis=0)
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    turn = float(np.arccos(np.clip(ways[1] @ ways[2], -1.0, 1.0)))
    planes = np.cross(ways[:2], ways[1:])
    planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), 1e-9)
    return turn, abs(float(planes[0] @ planes[1]))
