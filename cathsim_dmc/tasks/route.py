"""The route to a goal: places of heads on it, and route and lumen ahead of them.

Pure functions of arrays with leading batch axes, written `...`; metres.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.centreline import interpolate
from cathsim_dmc.tasks.objectives import Objective, Routed

ROUTE_SPACING = 1e-3  # m, resolution of the route
# Distances along the route from the place of the head to the points ahead, m.
AHEAD = np.arange(8) * 5e-3
SIDE_AHEAD = 25e-3  # m along the route to the point that a shaped end is turned to
_NEARBY = 10e-3  # m of the route that a head can pass between two control steps


@dataclasses.dataclass(frozen=True, eq=False)
class Route:
    """A route in steps of `ROUTE_SPACING`.

    Attributes:
        points: (P, 3), from the inlet to the goal, m, world frame.
        radii: (P,), of the lumen, m.
        arc_length: (P,), m.
    """

    points: np.ndarray
    radii: np.ndarray
    arc_length: np.ndarray

    @classmethod
    def of(cls, objective: Objective) -> "Route":
        """The route of an objective; ValueError if it is not `Routed`."""
        if not isinstance(objective, Routed):
            raise ValueError(
                f"the objective {type(objective).__name__} has no route, a centreline "
                "from the inlet to the goal, which the observation 'route' and the "
                "expert need; derive it from tasks.objectives.Routed"
            )
        fine = objective.route.resampled(ROUTE_SPACING)
        return cls(fine.points, fine.radii, fine.arc_length)

    @property
    def narrowing(self) -> float:
        """Arc length, m, where the lumen narrows fastest."""
        return float(self.arc_length[np.diff(self.radii).argmin()])

    def at(self, arc_length: np.ndarray) -> np.ndarray:
        """Points (..., 3), m, at arc lengths (...), m; straight on beyond the end."""
        held = interpolate(arc_length, self.arc_length, self.points)
        last = self.points[-1] - self.points[-2]
        last = last / np.linalg.norm(last)
        beyond = np.maximum(arc_length - float(self.arc_length[-1]), 0.0)
        return held + beyond[..., None] * last


class Place(NamedTuple):
    """Place of a head on a route.

    Attributes:
        arc_length: (...), m.
        excess: (...), distance of the head outside the route's tube, in radii of the
            lumen there; negative inside.
    """

    arc_length: np.ndarray
    excess: np.ndarray


def locate(route: Route, head: np.ndarray, last: np.ndarray | None = None) -> Place:
    """Finds the place of a head (..., 3) on the route.

    It is the nearest point of the route that has the head within the radius of its
    lumen, or else the point with the least distance beyond that radius. The nearest
    axis alone is not enough: in the parent vessel beside an ostium, it may be that of
    the branch.

    Where the route turns back into a branch, a head may be within the lumen of both
    parts, and the nearer axis changes with every movement. Points near the last place
    therefore take precedence.

    Args:
        head: (..., 3), m, world frame.
        last: (...), arc length of its place a control step ago, m; NaN or None if that
            is not known.
    """
    offset = head[..., None, :] - route.points
    distance = np.sqrt(np.einsum("...i,...i->...", offset, offset))
    outside = distance - route.radii
    inside = outside <= 0
    # Any inside point beats every outside one.
    rank = np.where(inside, distance - 1.0, np.maximum(outside, 0.0))
    if last is not None:  # an inside point near the last place beats every other
        nearby = np.abs(route.arc_length - last[..., None]) <= _NEARBY
        rank = rank - 1.0 * (inside & nearby)
    index = rank.argmin(-1)
    excess = np.take_along_axis(outside, index[..., None], -1)[..., 0]
    return Place(route.arc_length[index], excess / route.radii[index])


class Ahead(NamedTuple):
    """Route and lumen ahead of N tips, each in the frame of its tip.

    The origin of this frame is the head, its z-axis the direction of the head, its x
    and y the hinge axes of the last link.

    Attributes:
        points: (N, K, 3), points of the route, `AHEAD` of the place of the head, m.
        radii: (N, K), radii of the lumen there, m.
        excess: (N,), `Place.excess` of the head.
        sides: (N, D, 5), directions from D coaxial devices to the route, see
            `coaxial_ends.sides`; None if no observation needs it.
        turns: (N, D, 2), remaining rotations and bend angles to the route at the
            look-ahead, rad, see `coaxial_ends.turns`; None if no observation needs it.
    """

    points: np.ndarray
    radii: np.ndarray
    excess: np.ndarray
    sides: np.ndarray | None = None
    turns: np.ndarray | None = None


def locate_each(
    routes: Sequence[Route],
    chosen: np.ndarray,
    head: np.ndarray,
    last: np.ndarray | None = None,
) -> Place:
    """Places (N,) of heads on their routes.

    Args:
        routes: Routes of the anatomies.
        chosen: (N,) int, number of the anatomy of each simulation.
        head: (N, 3), m, world frame.
        last: (N,), m, see `locate`.
    """
    place = Place(np.empty(len(head)), np.empty(len(head)))
    for number in np.unique(chosen).tolist():
        rows = np.flatnonzero(chosen == number)
        near = None if last is None else last[rows]
        found = locate(routes[number], head[rows], near)
        place.arc_length[rows], place.excess[rows] = found
    return place


def look_ahead(
    routes: Sequence[Route],
    chosen: np.ndarray,
    place: Place,
    head: np.ndarray,
    frame: np.ndarray,
) -> Ahead:
    """Routes and lumens ahead of N tips, which may lie in different anatomies.

    Args:
        routes: Routes of the anatomies.
        chosen: (N,) int, number of the anatomy of each simulation.
        place: Places (N,) of the heads, see `locate_each`.
        head: (N, 3), m, world frame.
        frame: (N, 3, 3), orientation of each tip, its axes in columns.
    """
    points = np.empty((len(head), len(AHEAD), 3))
    radii = np.empty((len(head), len(AHEAD)))
    for number in np.unique(chosen).tolist():
        route, rows = routes[number], np.flatnonzero(chosen == number)
        ways = place.arc_length[rows, None] + AHEAD
        points[rows] = route.at(ways)
        radii[rows] = np.interp(ways, route.arc_length, route.radii)
    return Ahead(into_frame(points - head[:, None], frame), radii, place.excess)


def into_frame(vectors: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Rotates world vectors (..., K, 3) into frames (..., 3, 3), axes in columns.

    It uses no matrix product, whose rounding may depend on the number of simulations.
    """
    x, y, z = (frame[..., None, axis, :] for axis in range(3))
    return vectors[..., :1] * x + vectors[..., 1:2] * y + vectors[..., 2:] * z
