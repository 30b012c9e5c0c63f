"""Centrelines with radii, vessels, and their tree: metres, in the patient frame LPS."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cathsim_dmc import bounds

Array = NDArray[np.float64]

_CHUNK_ELEMENTS = 64_000  # points x segments projected at once, within the L2 cache
_GAP = 1e-9  # m; a vertex this near to a cut would coincide with the cut point
_END_PLANE = 1e-9  # m, tolerance of the plane of a flat end


def as_points(points: ArrayLike) -> Array:
    """Points as float64 (..., 3); ValueError if the last axis has another length."""
    array = np.asarray(points, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(
            f"points have shape {array.shape}; give coordinates (x, y, z) in metres "
            "on the last axis, shape (..., 3)."
        )
    return array


def as_rows(points: ArrayLike) -> Array:
    """Points (..., 3) as contiguous float64 rows (n, 3) for compiled loops."""
    # Writable: numba compiles a second version for read-only arrays.
    return np.require(as_points(points).reshape(-1, 3), None, ["C", "W"])


def arc_lengths(points: Array) -> Array:
    """Arc length (n,) of each point (n, k) of a polyline from the first."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def interpolate(at: float | np.ndarray, arc: np.ndarray, points: np.ndarray) -> Array:
    """Points (..., k) of a polyline (n, k) at arc lengths `at` (...), m.

    `arc` (n,) are the arc lengths of its points. Constant outside the polyline.
    """
    return np.stack([np.interp(at, arc, axis) for axis in points.T], axis=-1)


def distinct(points: Array) -> Array:
    """Points (n, k), m, of a polyline without those that repeat the one before."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return points[np.append(True, steps > _GAP)]


def tangents(points: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) along a polyline (n, 3)."""
    step = np.gradient(points, axis=0)
    return step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)


def across(points: np.ndarray) -> np.ndarray:
    """Two unit vectors (n, 2, 3) across a polyline (n, 3), at right angles."""
    tangent = tangents(points)
    u = np.cross(tangent, np.eye(3)[np.abs(tangent).argmin(axis=1)])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([u, np.cross(tangent, u)], axis=1)


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
        points = bounds.array("centreline points", self.points, shape=(-1, 3))
        if len(points) < 2:
            raise ValueError(f"a centreline has {len(points)} points; give 2 or more.")
        shape = (len(points),)
        radii = _readonly(bounds.array("centreline radii", self.radii, shape=shape))
        bounds.number(
            "smallest centreline radius", radii.min(), unit="m", positive=True
        )
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if steps.min() <= 0.0:
            first = int(steps.argmin())
            raise ValueError(f"centreline points {first} and {first + 1} coincide")
        vars(self).update(points=_readonly(points), radii=radii)

    @cached_property
    def arc_length(self) -> Array:
        """Arc length (n,) of each point from the first, metres."""
        return _readonly(arc_lengths(self.points))

    @property
    def length(self) -> float:
        """Length of the polyline, metres."""
        return float(self.arc_length[-1])

    @cached_property
    def _segments(self) -> tuple[Array, Array, Array]:
        """Directions (s, 3) of the segments, not normalised; squares; lengths (s,)."""
        way = self.points[1:] - self.points[:-1]
        squared = np.einsum("sj,sj->s", way, way)
        return way, squared, np.sqrt(squared)

    @cached_property
    def _products(self) -> tuple[Array, Array]:
        """Matrix (3, 2 s) and offset (2 s,) of a product with points p (n, 3).

        It gives p.d/|d|^2 and |p - a|^2 - |p|^2 for every segment from a along d.
        """
        start, (way, squared, _) = self.points[:-1], self._segments
        matrix = np.concatenate([(way / squared[:, None]).T, -2.0 * start.T], axis=1)
        along = -np.einsum("sj,sj->s", start, way) / squared
        return matrix, np.append(along, np.einsum("sj,sj->s", start, start))

    def at(self, s: ArrayLike) -> CentrelinePoint:
        """Interpolate linearly at arc length `s` (...), clamped to the polyline."""
        s = np.clip(np.asarray(s, dtype=np.float64), 0.0, self.length)
        index = np.searchsorted(self.arc_length, s, side="right") - 1
        index = np.clip(index, 0, len(self.points) - 2)
        way, _, lengths = (values[index] for values in self._segments)
        t = (s - self.arc_length[index]) / lengths
        return CentrelinePoint(
            position=self.points[index] + t[..., None] * way,
            radius=self.radii[index] * (1.0 - t) + self.radii[index + 1] * t,
            tangent=way / lengths[..., None],
        )

    def project_rows(self, points: ArrayLike) -> Projection:
        """As `project`, but a point has bitwise the same result alone and among many.

        A matrix product of a single row rounds differently, so a row is appended.
        """
        points = as_points(points)
        flat = points.reshape(-1, 3)
        found = self.project(np.concatenate([flat, flat[-1:]]))
        return Projection._make(
            each[: len(flat)].reshape(points.shape[:-1]) for each in found
        )

    def project(self, points: ArrayLike) -> Projection:
        """Nearest point of the polyline to each of `points` (..., 3), metres."""
        points = as_points(points)
        flat = points.reshape(-1, 3)
        out = np.empty((3, len(flat)))
        (way, squared, lengths), (matrix, offset) = self._segments, self._products
        chunk = max(1, _CHUNK_ELEMENTS // len(lengths))
        for first in range(0, len(flat), chunk):
            part = flat[first : first + chunk]
            product = part @ matrix
            product += offset
            raw, base = product[:, : len(lengths)], product[:, len(lengths) :]
            # |p-a|^2 - 2 t raw |d|^2 + t^2 |d|^2 with t = clip(raw, 0, 1)
            clamped = np.clip(raw, 0.0, 1.0)
            step = clamped - 2.0 * raw
            step *= clamped
            step *= squared
            step += base
            index = step.argmin(axis=1)
            t = clamped[np.arange(len(part)), index]
            away = part - (self.points[index] + t[:, None] * way[index])
            out[:, first : first + chunk] = (
                self.arc_length[index] + t * lengths[index],
                np.sqrt(np.einsum("nj,nj->n", away, away)),
                self.radii[index] * (1.0 - t) + self.radii[index + 1] * t,
            )
        arc, distance, radius = (values.reshape(points.shape[:-1]) for values in out)
        return Projection(arc, distance, radius)

    def locate(self, point: ArrayLike) -> float:
        """Arc length (m) of the place nearest to one point (3,), m."""
        return float(self.project(point).arc_length)

    def resampled(self, spacing: float) -> "Centreline":
        """Same curve with equal steps of about `spacing` (m), ends kept."""
        count = max(1, round(self.length / spacing))
        place = self.at(np.linspace(0.0, self.length, count + 1))
        return Centreline(place.position, place.radius)

    def slice(self, s0: float, s1: float) -> "Centreline":
        """Part from `s0` to `s1` (m), reversed if s0 > s1; ValueError if empty."""
        low, high = sorted((float(s0), float(s1)))
        low, high = max(low, 0.0), min(high, self.length)
        if high - low <= _GAP:
            raise ValueError(f"no slice from {s0:g} to {s1:g} m of {self.length:g} m")
        inner = (self.arc_length > low + _GAP) & (self.arc_length < high - _GAP)
        s = np.concatenate([[low], self.arc_length[inner], [high]])
        place = self.at(s if s0 <= s1 else s[::-1])
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
        last = self.centreline.length - _GAP
        bounds.number(f"ostium of vessel {self.name!r}", self.ostium, 0.0, last, "m")

    @property
    def mouth(self) -> CentrelinePoint:
        """Point of the centreline at the ostium, where it leaves the parent's lumen."""
        return self.centreline.at(self.ostium)


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
        if not self.vessels:
            raise ValueError("a vessel tree needs at least one vessel.")
        seen: list[str] = []
        for key, vessel in self.vessels.items():
            if key != vessel.name:
                raise ValueError(f"vessel {vessel.name!r} is filed under {key!r}.")
            if (vessel.parent is None) != (not seen):
                raise ValueError(
                    f"vessel {key!r} has parent {vessel.parent!r}; the first vessel, "
                    "and only the first, has no parent."
                )
            if seen:
                bounds.choice(f"the parent before {key!r}", vessel.parent, seen)
            seen.append(key)
        vars(self).update(vessels=dict(self.vessels))

    @property
    def root(self) -> Vessel:
        """The vessel without a parent."""
        return next(iter(self.vessels.values()))

    def vessel(self, name: str) -> Vessel:
        """Vessel called `name`; ValueError lists the known names."""
        return self.vessels[bounds.choice("vessel", name, self.vessels)]

    def scaled(self, factor: float) -> "VesselTree":
        """The tree scaled by `factor`."""
        vessels = {}
        for key, vessel in self.vessels.items():
            line = vessel.centreline
            line = Centreline(factor * line.points, factor * line.radii)
            vessels[key] = Vessel(key, line, vessel.parent, factor * vessel.ostium)
        return VesselTree(vessels)

    def depths(self, points: ArrayLike) -> dict[str, Array]:
        """Lumen radius minus distance (m) of `points` (..., 3), m, for each vessel.

        Both are those of the nearest point of the vessel's centreline. The value is
        > 0 inside the tube, but is not the distance to the wall. The flat ends are
        open; beyond one the value is at most minus the distance to its plane.
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
                # The tolerance keeps points of the end plane inside despite rounding.
                cut = np.isclose(near.arc_length, s) & (beyond > _END_PLANE)
                depth = np.where(cut, np.minimum(depth, -beyond), depth)
            depths[name] = depth
        return depths

    def _lineage(self, name: str) -> list[str]:
        """Names from `name` up to the root."""
        parent = self.vessel(name).parent
        return [name] if parent is None else [name, *self._lineage(parent)]

    def origin(self, name: str) -> float:
        """Arc length (m) on the parent's centreline where branch `name` starts."""
        vessel = self.vessel(name)
        return self.vessel(str(vessel.parent)).centreline.locate(
            vessel.centreline.points[0]
        )

    def route(
        self,
        start: str,
        goal: str,
        goal_arc_length: float = math.inf,
        *,
        start_arc_length: float = 0.0,
    ) -> Centreline:
        """Polyline from a place in vessel `start` to a place in vessel `goal`.

        Args:
            start: vessel the device enters by.
            goal: vessel to reach.
            goal_arc_length: arc length (m) on the goal's centreline; inf for its end.
            start_arc_length: arc length (m) on the centreline of `start`.

        Raises:
            ValueError: if a name is unknown, or start and goal coincide.
        """
        up, down = self._lineage(start), self._lineage(goal)
        common = next(name for name in up if name in down)
        here, legs = start_arc_length, []
        for name in up[: up.index(common)]:
            legs.append((name, here, 0.0))
            here = self.origin(name)
        way = down[down.index(common) :: -1]
        stops = [*map(self.origin, way[1:]), goal_arc_length]
        for name, there in zip(way, stops, strict=True):
            legs.append((name, here, there))
            here = 0.0
        parts = [
            self.vessels[name].centreline.slice(s0, s1)
            for name, s0, s1 in legs
            if not math.isclose(s0, s1, rel_tol=0.0, abs_tol=1e-6)
        ]
        if not parts:
            raise ValueError(f"route from {start!r} to {goal!r} has no length.")
        points = np.concatenate([part.points for part in parts])
        radii = np.concatenate([part.radii for part in parts])
        keep = np.append(True, np.diff(arc_lengths(points)) > _GAP)
        return Centreline(points[keep], radii[keep])
