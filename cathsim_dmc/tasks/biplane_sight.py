"""The route's observation, reconstructed from two X-ray planes in N simulations.

Device, goal and route are reconstructed from the images (`imaging.biplane`). The frame
of the tip also needs the orientation of the handle, which is known from its drive.
"""

import functools
from collections.abc import Sequence

import numpy as np
from numpy.random import RandomState

from cathsim_dmc.anatomy.centreline import arc_lengths, interpolate
from cathsim_dmc.imaging import biplane
from cathsim_dmc.imaging import biplane_loops as loops
from cathsim_dmc.imaging.angiograph import Planes
from cathsim_dmc.imaging.biplane import Biplane
from cathsim_dmc.imaging.options import NO_ERRORS, RoadmapErrors
from cathsim_dmc.tasks.common_chain import TRACKED_PLACES
from cathsim_dmc.tasks.route import Route, into_frame, locate, look_ahead

# Fewest points of a reconstructed device; with fewer it counts as lost.
_FEWEST = 7
# The direction of the head is that of the chord from this point to the marker.
_CHORD = 2
_OUT = -1e-3  # m, depth outside the outline from which the device is in its sheath
# Errors of the outlines shift centreline and radius of a narrow branch, and so the
# deviation of the head, which is therefore divided by at least this radius, m.
_LEAST_TUBE = 10e-3


class BiplaneSight:
    """Reconstructs device, goal and route; keeps each simulation's device and route."""

    state = ("_routes", "_lines")  # see `snapshot`

    def __init__(self, num_simulations: int, errors: RoadmapErrors = NO_ERRORS):
        """Prepares N simulations, of which no image has been seen.

        Args:
            errors: Sizes of the errors of the roadmaps; each episode draws its own.
        """
        self._errors = errors
        if errors.any:
            self.state += ("_seeds",)
        self._seeds = np.zeros(num_simulations, np.int64)
        self._routes: list[Route | None] = [None] * num_simulations
        self._lines = [np.zeros((0, 3))] * num_simulations
        self._machines: dict[int, Biplane] = {}

    def changed(self, numbers: np.ndarray) -> None:
        """Drops the machines of some simulations (K,), whose planes have changed."""
        for number in numbers.tolist():
            self._machines.pop(number, None)

    def draw(self, numbers: np.ndarray, random_states: Sequence[RandomState]) -> None:
        """Draws the errors of new episodes of some simulations (K,)."""
        if self._errors.any:
            for number in numbers.tolist():
                self._seeds[number] = random_states[number].randint(2**31)

    def see(
        self,
        planes: list[tuple[Planes, Planes]],
        images: np.ndarray,
        pixels: np.ndarray,
        handles: np.ndarray,
        numbers: np.ndarray,
        fresh: bool,
        last: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Returns the entries of the observation, and "place", of K simulations.

        "place" (K, 1) is the arc length of the heads' places on their routes, m.

        Args:
            planes: For each simulation, its two planes and its further roadmaps.
            images: (K, rows, columns, 2) uint8, live images.
            pixels: (K, 2, 2), goal marker in each plane, (column, row).
            handles: (K, 3, 3), orientation of the handle, its axes in columns.
            numbers: (K,) of the simulations.
            fresh: Whether they begin an episode.
            last: (K,), last arc lengths of the heads, m, see `route.locate`.
        """
        rows = []
        for k, number in enumerate(numbers.tolist()):
            if fresh or number not in self._machines:
                seed = int(self._seeds[number])
                two, third = planes[k]
                self._machines[number] = _machine(two, third, self._errors, seed)
            machine = self._machines[number]
            line = machine.device(images[k])
            if len(line) >= _FEWEST or not len(self._lines[number]) or fresh:
                self._lines[number] = line
            line = self._lines[number]
            if len(line) < _FEWEST:
                # Lost in the first image: assume a straight device along the handle.
                line = _along(handles[k], line, machine)
            goal = machine.point(pixels[k])
            if fresh or self._routes[number] is None:
                self._routes[number] = _route(machine, line, goal)
            route = self._routes[number]
            least = _LEAST_TUBE * self._errors.any
            rows.append(_seen(line, handles[k], route, goal, last[k : k + 1], least))
        return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


# Episodes in the same anatomy share a machine, which holds a megabyte.
_machine = functools.lru_cache(maxsize=64)(Biplane)


def _along(handle: np.ndarray, line: np.ndarray, machine: Biplane) -> np.ndarray:
    """A straight device behind its first point, or behind the isocentre, (n, 3), m."""
    first = line[0] if len(line) else machine.isocentre
    ways = biplane.TRACE_SPACING * np.arange(_FEWEST)
    return first - ways[:, None] * handle[:, 2]


def _route(machine: Biplane, line: np.ndarray, goal: np.ndarray) -> Route:
    """The route to the goal from the point where the device enters the vessel."""
    out = np.flatnonzero(machine.depth(line) < _OUT)
    first = max(int(out[0]) - 1, 0) if len(out) else len(line) - 1
    points = machine.route(line[first], goal)
    return Route(points, machine.radii(points), arc_lengths(points))


def _seen(
    line: np.ndarray,
    handle: np.ndarray,
    route: Route,
    goal: np.ndarray,
    last: np.ndarray,
    least: float,
) -> dict[str, np.ndarray]:
    ways = biplane.TRACE_SPACING * np.arange(len(line))
    direction = line[0] - line[_CHORD]
    direction = direction / np.linalg.norm(direction)
    head = line[0] + biplane.MARKER_TO_HEAD * direction
    frame = loops.carried(np.ascontiguousarray(handle), line, direction)
    places = TRACKED_PLACES[:-1] - biplane.MARKER_TO_HEAD
    # Behind the last point that is seen, the device is taken as straight.
    beyond = np.maximum(places - ways[-1], 0.0)[:, None]
    back = (line[-1] - line[-2]) / biplane.TRACE_SPACING
    device = interpolate(places, ways, line) + beyond * back
    place = locate(route, head[None], last)
    radius = np.interp(place.arc_length, route.arc_length, route.radii)
    share = np.where(place.excess > 0.0, radius / np.maximum(radius, least), 1.0)
    place = place._replace(excess=place.excess * share)
    ahead = look_ahead([route], np.zeros(1, int), place, head[None], frame[None])
    return {
        "points": ahead.points.ravel(),
        "radii": ahead.radii[0],
        "goal": into_frame((goal - head)[None], frame)[0],
        "device": into_frame(device - head, frame).ravel(),
        "deviation": ahead.excess,
        "place": place.arc_length,
    }
