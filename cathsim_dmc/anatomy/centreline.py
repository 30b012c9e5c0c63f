"""Centrelines with radii, vessels, and the tree of vessels they form.

All lengths are metres, all points are in the patient frame LPS (+x patient
left, +y posterior, +z superior).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.segments import Array, Segments, arc_lengths, as_points

# Points x segments handled at once while projecting: stays within the L2 cache.
_CHUNK_ELEMENTS = 64_000

# Points this little (m) beyond a flat end still lie in the vessel.
_END_PLANE = 1e-9


class CentrelinePoint(NamedTuple):
    """A place on a centreline: position (..., 3), radius (...), tangent (..., 3)."""

    position: Array
    radius: Array
    tangent: Array


class Projection(NamedTuple):
    """Nearest place of a centreline: arc length, distance and lumen radius there.

    All three have the leading shape of the projected points and are in metres.
    """

    arc_length: Array
    distance: Array
    radius: Array


def _readonly(values: ArrayLike) -> Array:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class Centreline:
    """A polyline with the lumen radius at each of its points.

    Attributes:
        points: (n, 3) float64, metres, LPS; n >= 2, consecutive points distinct.
        radii: (n,) float64, metres, positive.

    Raises:
        ValueError: if a shape or a value is not as stated.
    """

    points: Array
    radii: Array

    def __post_init__(self) -> None:
        points = _readonly(bounds.array("centreline points", self.points))
        radii = _readonly(bounds.array("centreline radii", self.radii))
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
            raise ValueError(
                f"centreline points have shape {points.shape}; give (n, 3), n >= 2."
            )
        if radii.shape != (len(points),):
            raise ValueError(
                f"centreline radii have shape {radii.shape}; give one radius for "
                f"each of the {len(points)} points."
            )
        if radii.min() <= 0.0:
            raise ValueError(
                f"smallest centreline radius is {radii.min():g} m; radii must be > 0."
            )
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if steps.min() <= 0.0:
            raise ValueError(
                f"centreline points {int(steps.argmin())} and "
                f"{int(steps.argmin()) + 1} coincide; drop repeated points."
            )
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "radii", radii)

    @cached_property
    def arc_length(self) -> Array:
        """Arc length (n,) of each point from the first, metres."""
        return _readonly(arc_lengths(self.points))

    @property
    def length(self) -> float:
        """Length of the polyline, metres."""
        return float(self.arc_length[-1])

    @cached_property
    def _segments(self) -> Segments:
        return Segments(self.points[:-1], self.points[1:])

    def at(self, s: ArrayLike) -> CentrelinePoint:
        """Interpolate linearly at arc length `s` (...), clamped to the polyline."""
        s = np.clip(np.asarray(s, dtype=np.float64), 0.0, self.length)
        index = np.searchsorted(self.arc_length, s, side="right") - 1
        index = np.clip(index, 0, len(self.points) - 2)
        lengths = self._segments.length[index]
        t = (s - self.arc_length[index]) / lengths
        direction = self._segments.direction[index]
        return CentrelinePoint(
            position=self.points[index] + t[..., None] * direction,
            radius=self.radii[index] * (1.0 - t) + self.radii[index + 1] * t,
            tangent=direction / lengths[..., None],
        )

    def project(self, points: ArrayLike) -> Projection:
        """Nearest point of the polyline to each of `points` (..., 3), metres."""
        points = as_points(points)
        flat = points.reshape(-1, 3)
        out = np.empty((3, len(flat)))
        segments = self._segments
        chunk = max(1, _CHUNK_ELEMENTS // len(segments.length))
        for first in range(0, len(flat), chunk):
            part = flat[first : first + chunk]
            squared, raw = segments.squared_distance(part)
            index = squared.argmin(axis=1)
            t = np.clip(raw[np.arange(len(part)), index], 0.0, 1.0)
            nearest = segments.start[index] + t[:, None] * segments.direction[index]
            offset = part - nearest
            out[:, first : first + chunk] = (
                self.arc_length[index] + t * segments.length[index],
                np.sqrt(np.einsum("nj,nj->n", offset, offset)),
                self.radii[index] * (1.0 - t) + self.radii[index + 1] * t,
            )
        return Projection(*(values.reshape(points.shape[:-1]) for values in out))

    def resampled(self, spacing: float) -> "Centreline":
        """Same curve with equal steps of about `spacing` (m), ends kept."""
        if not spacing > 0.0:
            raise ValueError(f"spacing is {spacing:g} m; it must be > 0.")
        count = max(1, round(self.length / spacing))
        place = self.at(np.linspace(0.0, self.length, count + 1))
        return Centreline(place.position, place.radius)

    def slice(self, s0: float, s1: float) -> "Centreline":
        """Part from `s0` to `s1` (m), maybe backwards; ValueError if it is empty."""
        low, high = sorted((float(s0), float(s1)))
        low, high = max(low, 0.0), min(high, self.length)
        # Vertices closer than a nanometre to a cut would repeat the cut point.
        gap = 1e-9
        if high - low <= gap:
            raise ValueError(
                f"slice from {s0:g} to {s1:g} m is empty; the centreline spans "
                f"0 to {self.length:g} m."
            )
        inner = (self.arc_length > low + gap) & (self.arc_length < high - gap)
        s = np.concatenate([[low], self.arc_length[inner], [high]])
        if s0 > s1:
            s = s[::-1]
        place = self.at(s)
        return Centreline(place.position, place.radius)


@dataclass(frozen=True, eq=False)
class Vessel:
    """A named tapered tube around a centreline.

    A branch's centreline starts on its parent's centreline; `ostium` (m) is the
    arc length at which it leaves the parent's lumen (0 for the root).
    """

    name: str
    centreline: Centreline
    parent: str | None = None
    ostium: float = 0.0

    def __post_init__(self) -> None:
        bounds.text("vessel name", self.name)
        if self.parent is not None:
            bounds.text(f"parent of vessel {self.name!r}", self.parent)
        bounds.number(f"ostium of vessel {self.name!r}", self.ostium)
        if not 0.0 <= self.ostium < self.centreline.length:
            raise ValueError(
                f"ostium of vessel {self.name!r} is {self.ostium:g} m; it must lie on "
                f"its own centreline, 0 <= ostium < {self.centreline.length:g} m."
            )


@dataclass(frozen=True, eq=False)
class VesselTree:
    """Vessels by name, parents before children; the first is the root.

    The lumen is the union of the vessels' tapered tubes, each cut flat at the
    ends of its centreline.

    Raises:
        ValueError: if there is no single root, a parent is missing or comes
            after its child, or a key differs from its vessel's name.
    """

    vessels: Mapping[str, Vessel]

    def __post_init__(self) -> None:
        vessels = dict(self.vessels)
        seen: set[str] = set()
        for key, vessel in vessels.items():
            if key != vessel.name:
                raise ValueError(f"vessel {vessel.name!r} is filed under {key!r}.")
            if (vessel.parent is None) != (not seen):
                raise ValueError(
                    f"vessel {key!r} has parent {vessel.parent!r}; the first vessel, "
                    "and only the first, has no parent."
                )
            if vessel.parent is not None and vessel.parent not in seen:
                raise ValueError(
                    f"parent {vessel.parent!r} of vessel {key!r} is not among "
                    f"{sorted(seen)}; list parents before their children."
                )
            seen.add(key)
        if not seen:
            raise ValueError("a vessel tree needs at least one vessel.")
        object.__setattr__(self, "vessels", MappingProxyType(vessels))

    def __reduce__(self) -> tuple:
        # A mapping proxy cannot be pickled; worker processes need trees.
        return (VesselTree, (dict(self.vessels),))

    @property
    def root(self) -> Vessel:
        """The vessel without a parent."""
        return next(iter(self.vessels.values()))

    def vessel(self, name: str) -> Vessel:
        """Vessel called `name`; ValueError lists those that there are."""
        try:
            return self.vessels[name]
        except KeyError:
            raise ValueError(
                f"no vessel {name!r}; there are {', '.join(self.vessels)}."
            ) from None

    def depths(self, points: ArrayLike) -> dict[str, Array]:
        """Radius less distance (m) of `points` (..., 3) in each vessel's own tube.

        Both are taken at the nearest point of the vessel's centreline: not the
        distance to the wall, but > 0 inside. The flat ends are open; beyond one the
        value is at most minus the distance to its plane.
        """
        points = as_points(points)
        depths = {}
        for name, vessel in self.vessels.items():
            line = vessel.centreline
            near = line.project(points)
            depth = near.radius - near.distance
            for s, outward in ((0.0, -1.0), (line.length, 1.0)):
                end = line.at(s)
                beyond = outward * ((points - end.position) @ end.tangent)
                # Rounding must not put the end plane itself outside.
                cut = np.isclose(near.arc_length, s) & (beyond > _END_PLANE)
                depth = np.where(cut, np.minimum(depth, -beyond), depth)
            depths[name] = depth
        return depths

    def _lineage(self, name: str) -> list[str]:
        """Names from `name` up to the root."""
        names = [self.vessel(name).name]
        while (parent := self.vessels[names[-1]].parent) is not None:
            names.append(parent)
        return names

    def origin(self, name: str) -> float:
        """Arc length (m) on the parent's centreline where branch `name` starts."""
        vessel = self.vessel(name)
        if vessel.parent is None:
            raise ValueError(f"vessel {name!r} is the root and has no origin.")
        parent = self.vessels[vessel.parent].centreline
        return float(parent.project(vessel.centreline.points[0]).arc_length)

    def route(
        self,
        start: str,
        goal: str,
        goal_arc_length: float | None = None,
        *,
        start_arc_length: float | None = None,
    ) -> Centreline:
        """Polyline from a place in vessel `start` to a place in vessel `goal`.

        Args:
            start: vessel the device enters by.
            goal: vessel to reach.
            goal_arc_length: place (m) on the goal's centreline, its end if None.
            start_arc_length: place (m) on the start's centreline; if None its
                free end, which is the first point of the root and the last point
                of a branch.

        Raises:
            ValueError: if a name is unknown, or start and goal are one place.
        """
        up, down = self._lineage(start), self._lineage(goal)
        if goal_arc_length is None:
            goal_arc_length = self.vessels[goal].centreline.length
        here = start_arc_length
        if here is None:
            root = self.vessels[start].parent is None
            here = 0.0 if root else self.vessels[start].centreline.length
        common = next(name for name in up if name in down)
        legs: list[tuple[str, float, float]] = []
        for name in up[: up.index(common)]:
            legs.append((name, here, 0.0))
            here = self.origin(name)
        for name in reversed(down[: down.index(common) + 1]):
            child = down.index(name) - 1
            there = goal_arc_length if child < 0 else self.origin(down[child])
            legs.append((name, here, there))
            here = 0.0
        parts = [
            self.vessels[name].centreline.slice(s0, s1)
            for name, s0, s1 in legs
            if abs(s1 - s0) > 1e-6
        ]
        if not parts:
            raise ValueError(f"route from {start!r} to {goal!r} has no length.")
        points = np.concatenate([part.points for part in parts])
        radii = np.concatenate([part.radii for part in parts])
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        keep = np.concatenate([[True], steps > 1e-9])
        return Centreline(points[keep], radii[keep])
