"""Places of N heads on their routes, and the memory of their attempts."""

from collections.abc import Mapping, Sequence

import numpy as np

from cathsim_dmc.physics.device_points import gaps_of
from cathsim_dmc.physics.readings import CoaxialReadings, Readings, part
from cathsim_dmc.tasks import coaxial_ends, observations, retry, take_offs
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.coaxial_ends import CoaxialEnds
from cathsim_dmc.tasks.observation_kind import COAXIAL_ROUTE, ROUTE
from cathsim_dmc.tasks.retry import Memory
from cathsim_dmc.tasks.route import (
    SIDE_AHEAD,
    Ahead,
    Place,
    Route,
    locate_each,
    look_ahead,
)

_NARROW_AHEAD = 10e-3  # m along the route within which a narrow lumen is seen
_ROOM = 1.5  # radii of the device; a lumen with less room is too narrow for it
_SHOWN = ("route_retry", "biplane_retry")


class Progress:
    """Places of the heads on the routes, and the memory of the attempts.

    Attributes:
        shown: Whether policies observe the memory.
        ends: Whether episodes end when the memory gives up.
        settings: Settings of the retries.
        memory: Arrays (N,); None if neither task nor policy needs it.
    """

    def __init__(
        self, names: Sequence[str], cases: Sequence[Case], count: int, ends: bool
    ):
        """Prepares routes and memory, as far as observations or `ends` need them.

        Raises:
            ValueError: if an objective is not `Routed`, two memories are observed, or
                `route_turns` is observed without `route_retry`.
        """
        self._cases, self._count, self.ends = cases, count, ends
        shown = [name for name in _SHOWN if name in names]
        if len(shown) > 1:
            raise ValueError(
                f"observation has {' and '.join(shown)}, but there is one memory of "
                "attempts; leave one of the two out"
            )
        self.shown, self._of_images = bool(shown), shown == ["biplane_retry"]
        self._turns = "route_turns" in names
        if self._turns and shown != ["route_retry"]:
            raise ValueError(
                "observation has route_turns, which belong to an attempt of the memory "
                "of the route; add route_retry, and leave biplane_retry out"
            )
        chain = cases[0].scene.catheter
        self._coaxial, self._radius = chain.coaxial, chain.devices[0].outer_radius
        self.settings = retry.COAXIAL if self._coaxial else retry.SINGLE
        self.memory: Memory | None = None
        self._ends: CoaxialEnds | None = None
        if observations.needs(names, COAXIAL_ROUTE):
            self._ends = CoaxialEnds.of(chain)
        self._observed = observations.needs(names, ROUTE, COAXIAL_ROUTE)
        self._routes: list[Route] = []
        if self._observed:
            self._routes = [Route.of(case.objective) for case in cases]
        # A memory that only a policy needs is not part of the state.
        self.state = ("memory",) if self.shown or ends else ()  # see `snapshot`
        if self.state:
            self._prepare()

    def _prepare(self) -> None:
        """Makes an empty memory, and finds what it needs of the routes."""
        if not self._of_images:  # a policy of images does not know the routes
            self._routes = self._routes or [Route.of(c.objective) for c in self._cases]
        routes = [] if self._of_images else self._routes
        least = _ROOM * self._radius
        tight = [route.arc_length[route.radii < least] for route in routes]
        last = len(self.settings.pattern.leads) - 1
        blunt = [retry.blunt(self.settings, route) for route in routes]
        self._tight, self._first = tight, last * np.array(blunt, int)
        alone = np.inf, False  # for a single device, no take-off counts as close
        ends = [take_offs.followed(r) if self._coaxial else alone for r in routes]
        self._ostium = np.array([end if close else np.inf for end, close in ends])
        far = take_offs.last_apart if self._coaxial else lambda route: np.inf
        self._last = np.array([far(route) for route in routes])
        nowhere = Place(np.full(self._count, np.nan), np.zeros(self._count))
        self.memory = Memory.at(nowhere, np.zeros(self._count))

    def remember(self, chosen: np.ndarray, state: Readings | None) -> Memory:
        """Returns the memory; makes it at the first call if there is none.

        Args:
            chosen: (N,) int, number of the anatomy of each simulation.
            state: Readings mapped to the vessel at rest; None before any episode.

        Raises:
            ValueError: if an objective is not `Routed`.
        """
        if self.memory is None:
            self._prepare()
            if state is not None:
                self.restart(np.arange(self._count), chosen, state)
        assert self.memory is not None
        return self.memory

    @property
    def given_up(self) -> np.ndarray | bool:
        """(N,) bool, or False: whether an episode ends because the memory gives up."""
        return self.ends and self.memory is not None and self.memory.given_up

    def steady(self, rows: np.ndarray, begins: bool) -> np.ndarray:
        """Last arc lengths (N,), m, for `route.locate`; NaN where there is none.

        Args:
            rows: (K,) numbers of the simulations that are observed anew.
            begins: Whether they begin an episode.
        """
        last = np.full(self._count, np.nan)
        if self.memory is not None:
            last = self.memory.steady
            if begins:
                last[rows] = np.nan
        return last

    def see(
        self,
        rows: np.ndarray,
        begins: bool,
        chosen: np.ndarray,
        state: Readings,
        images: Mapping[str, np.ndarray],
    ) -> None:
        """Begins or advances the memory, if there is one, after a control step.

        Args:
            rows: (K,) numbers of the simulations that begin an episode, or of all;
                empty if nothing has moved.
            begins: Whether they begin an episode.
            chosen: (N,) int, number of the anatomy of each simulation.
            state: Readings as policies see them, mapped to the vessel at rest.
            images: Images of the sensors, with "biplane_place" and "biplane_deviation"
                if the memory is that of `biplane_retry`.
        """
        if self.memory is None or not len(rows):
            return
        if self._of_images:
            place = Place(
                images["biplane_place"][:, 0], images["biplane_deviation"][:, 0]
            )
        else:
            last = self.steady(rows, begins)
            place = locate_each(self._routes, chosen, state.head, last)
        if begins:
            self._begin(rows, chosen, place, state.insertion)
        else:
            narrow = self._narrow(chosen, place)
            self.memory = retry.advance(
                self.settings, self.memory, place,
                state.insertion, state.push_force, narrow,
            )  # fmt: skip

    def restart(self, rows: np.ndarray, chosen: np.ndarray, state: Readings) -> None:
        """Restarts a memory that is not part of the state, after a restore.

        Args:
            rows: (K,) numbers of the simulations.
            chosen: (N,) int, number of the anatomy of each simulation.
            state: Readings mapped to the vessel at rest.
        """
        if self.memory is not None and not self.state:
            place = locate_each(self._routes, chosen, state.head)
            self._begin(rows, chosen, place, state.insertion)

    def _begin(
        self, rows: np.ndarray, chosen: np.ndarray, place: Place, insertion: np.ndarray
    ) -> None:
        assert self.memory is not None
        new = Memory.at(place, insertion)
        if len(self._first):
            new = new._replace(
                first=self._first[chosen],
                ostium=self._ostium[chosen],
                last=self._last[chosen],
            )
        begun = np.zeros(self._count, bool)
        begun[rows] = True
        pairs = zip(self.memory, new, strict=True)
        self.memory = Memory._make(np.where(begun, b, a) for a, b in pairs)

    def _narrow(self, chosen: np.ndarray, place: Place) -> np.ndarray:
        """(N,) bool, whether the lumen ahead is narrower than the device."""
        narrow = np.zeros(self._count, bool)
        for number, tight in enumerate(self._tight):
            if len(tight):
                rows = np.flatnonzero(chosen == number)
                where = place.arc_length[rows]
                nearest = np.append(tight, np.inf)[np.searchsorted(tight, where)]
                narrow[rows] = nearest < where + _NARROW_AHEAD
        return narrow

    def ahead(
        self, chosen: np.ndarray, state: Readings, devices: CoaxialReadings | None
    ) -> Ahead | None:
        """Returns the route ahead of the heads; None if no observation needs it.

        It starts at the memory's places of the heads if `route_retry` is observed.

        Args:
            chosen: (N,) int, number of the anatomy of each simulation.
            state: Readings as policies see them, mapped to the vessel at rest.
            devices: State of coaxial devices; None for a single one.
        """
        if not self._observed:
            return None
        if self.shown and not self._of_images and self.memory is not None:
            place = Place(self.memory.arc_length, self.memory.excess)
        else:
            place = locate_each(self._routes, chosen, state.head)
        ahead = look_ahead(self._routes, chosen, place, state.head, state.head_frame)
        if self._ends is None or devices is None:
            return ahead
        ways = self._ways(chosen, place, SIDE_AHEAD, state, devices)
        ahead = ahead._replace(sides=coaxial_ends.sides(ways, devices.tip_rotation))
        return ahead._replace(turns=self._left(chosen, place, state, devices))

    def _ways(
        self,
        chosen: np.ndarray,
        place: Place,
        ahead: np.ndarray | float,
        state: Readings,
        devices: CoaxialReadings,
    ) -> np.ndarray:
        """Vectors (N, K, 3), m, to points of the route, see `CoaxialEnds.directions`.

        Args:
            ahead: (N, 1) or scalar, distance along the route from each end to its
                point, m.
        """
        assert self._ends is not None
        ends = place.arc_length[:, None] - gaps_of(devices.insertion) + ahead
        targets = np.empty((*ends.shape, 3))
        for number in np.unique(chosen).tolist():
            rows = chosen == number
            targets[rows] = self._routes[number].at(ends[rows])
        return self._ends.directions(state, devices.insertion, targets)

    def _left(
        self,
        chosen: np.ndarray,
        place: Place,
        state: Readings,
        devices: CoaxialReadings,
    ) -> np.ndarray | None:
        """Computes `Ahead.turns`; None if it is not observed."""
        if not self._turns:
            return None
        assert self.memory is not None
        ahead = np.empty(self._count)
        for number in np.unique(chosen).tolist():
            rows, route = chosen == number, self._routes[number]
            ahead[rows] = retry.lookahead(
                self.settings, part(self.memory, rows), route, place.arc_length[rows]
            )
        ways = self._ways(chosen, place, ahead[:, None], state, devices)
        error, away = coaxial_ends.turns(ways, devices.tip_rotation)
        error = error + retry.offset(self.settings, self.memory)[:, None]
        return np.stack([coaxial_ends.wrapped(error), away], axis=-1)

    def seen(self, state: Readings) -> np.ndarray | None:
        """Returns the observed memory, see `retry.shown`; None if none is observed."""
        if not self.shown or self.memory is None:
            return None
        return retry.shown(
            self.settings, self.memory,
            state.insertion, state.push_force, self._coaxial,
        )  # fmt: skip
