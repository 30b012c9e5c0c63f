"""Biplane reconstruction: device, vessel and route in space from two X-ray images.

The device is followed backwards from the marker at its tip, in the digital subtraction
of live images and mask images. The vessel is the visual hull of its outlines in both
roadmaps; the route to the goal marker keeps to the middle of the hull. If the outlines
have errors, the hull is thin and broken in narrow branches: the route then passes its
gaps, is centred on what all views show around it, and its radii are smoothed.
"""

from dataclasses import replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import distance_transform_edt, gaussian_filter, gaussian_filter1d
from scipy.special import ndtr

from cathsim_dmc.anatomy.centreline import across, arc_lengths, interpolate
from cathsim_dmc.anatomy.geodesic import nearest_cell, search
from cathsim_dmc.imaging import biplane_loops as loops
from cathsim_dmc.imaging import materials
from cathsim_dmc.imaging.carm import CArm
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.imaging.options import NO_ERRORS, RoadmapErrors

# Distance of the points along the device, m, and their number: 0.2 m of it.
TRACE_SPACING = 5e-3
TRACE_POINTS = 41
# With fewer points, other first directions behind the tip are tried, too.
TRACE_ENOUGH = 12
# From the middle of the marker to the end of the device, m.
MARKER_TO_HEAD = 0.5 * materials.MARKER_LENGTH

# Distance of the points at which the hull is known, m, and of those of the route.
HULL_SPACING = 3e-3
_OUTSIDE = -0.5 * HULL_SPACING  # m, least depth of a point that counts as inside
ROUTE_SPACING = 1e-3
# Least depth, m, of a path that leads through a gap of a roadmap, and the factor of its
# cost there.
_THROUGH, _DEAR = -12e-3, 10.0
# Errors of roadmaps, px: correlation length along the outlines, radius of a gap.
_ALONG, _GAP = 4.0, 3.0
# Largest distance by which rays to one point miss each other, px; distance from the
# isocentre, m, at which errors of calibration are added to it.
_WIDEST, _FAR = 2.0, 0.1
# Standard deviation of the Gaussian that smooths the route, m: three points of the
# hull. It cuts corners, so it is smaller between centrings.
_SMOOTHING, _SLIGHTLY = 4e-3, 2e-3
# Depth, m, beyond which the cost of a path is constant.
_WIDE = 12e-3
_SHAFT = 1.6e-3  # m, width of a usual device
# Mean distance of a pixel at the outline from the outline, px.
_EDGE = 0.25
# For outlines with errors: number of centrings of a route; radius of the disc around
# each of its points, in radii of the hull, and its limits, m; standard deviations of
# the smoothing along the route, m, of its centre and of its radii.
_CENTRINGS, _DISC_RADII, _DISC = 8, 1.3, (4e-3, 12e-3)
_POOLED_MIDDLE, _POOLED_LUMEN = 2e-3, 6e-3
_LEAST_ERROR = 0.2  # px
_LEAST_LUMEN = 1e-3, 2e-3  # m, least radius, of outlines without and with errors


class Biplane:
    """Two C-arms before one vessel.

    Attributes:
        matrices: (2, 3, 4), projections of the two planes, see `CArm.matrix`.
        isocentre: point (3,) about which the arms turn, m.
    """

    def __init__(
        self,
        planes: tuple[Fluoroscope, ...],
        third: tuple[Fluoroscope, ...] = (),
        errors: RoadmapErrors = NO_ERRORS,
        seed: int = 0,
    ):
        """Takes the roadmap and the mask image of each plane.

        Args:
            planes: The two planes.
            third: Further views of the vessel alone.
            errors: Errors of the roadmaps and of the calibration of the planes.
            seed: Seed of these errors.
        """
        self._planes, self._roadmaps = planes, (*planes, *third)
        self._errors, self._random = errors, np.random.RandomState(seed)
        self.isocentre = np.asarray(planes[0].carm.isocentre)
        arms = [self._believed(plane.carm) for plane in self._roadmaps]
        self._views = np.array([arm.matrix for arm in arms])
        self.matrices = self._views[:2]
        self._focal = np.array([plane.carm.focal_length for plane in self._roadmaps])
        # Largest distance by which rays of both planes may miss each other, px, with
        # errors of the angles at the distance `_FAR` from the isocentre.
        off = np.deg2rad(errors.calibration) * _FAR * planes[0].carm.focal_length
        self._widest = _WIDEST + float(off) / planes[0].carm.source_isocentre
        # Grey levels without a device, (2, rows, columns).
        self._masks = np.stack([plane.empty for plane in planes]).astype(np.float32)
        self._goal: tuple[np.ndarray, np.ndarray] | None = None

    def _believed(self, arm: CArm) -> CArm:
        """A C-arm with random errors of its angles, up to the error of calibration."""
        most = np.deg2rad(self._errors.calibration)
        if not most:
            return arm
        primary, secondary = self._random.uniform(-most, most, 2).tolist()
        primary, secondary = arm.primary + primary, arm.secondary + secondary
        return replace(arm, primary=primary, secondary=secondary)

    def device(self, image: np.ndarray) -> np.ndarray:
        """Follows the device from its tip.

        Args:
            image: (rows, columns, 2) uint8, live image of the two planes.

        Returns:
            Points (P, 3), world frame, m: the marker at the tip, then every
            `TRACE_SPACING` behind it; (0, 3) where no marker is seen.
        """
        pitch = np.mean([plane.carm.pitch for plane in self._planes])
        pixel = pitch * self._planes[0].carm.source_isocentre
        pixel /= self._planes[0].carm.source_detector
        # Optical depth of a rod across a pixel, from the mean path through it.
        full = materials.CATHETER * 0.25 * np.pi * _SHAFT**2 / max(pixel, _SHAFT)
        grey = np.moveaxis(image, -1, 0).astype(np.float32)
        depth = np.log(np.maximum(self._masks, 1.0) / np.maximum(grey, 1.0))
        depth = np.ascontiguousarray(depth, dtype=np.float32)
        line = np.empty((TRACE_POINTS, 3))
        count = loops.trace(
            depth, self.matrices, _directions(),
            TRACE_SPACING, float(full), TRACE_ENOUGH, line, self._widest,
        )  # fmt: skip
        return line[:count]

    def point(self, pixels: ArrayLike) -> np.ndarray:
        """Triangulates a point (3,), m, from pixels (2, 2), (column, row) per plane."""
        places, found = np.asarray(pixels, dtype=np.float64)[:, ::-1], np.empty(3)
        loops.triangulated(self.matrices, np.ascontiguousarray(places), found)
        return found

    def depth(self, points: ArrayLike) -> np.ndarray:
        """Signed distance (...), m, of points (..., 3) from the outlines, + inside."""
        return self._depths(points).min(axis=0)

    def radii(self, line: np.ndarray) -> np.ndarray:
        """Radii (P,) of the lumen along a route (P, 3), m."""
        depths, least = self._depths(line), _LEAST_LUMEN[self._errors.any]
        if self._errors.any:
            width = _POOLED_LUMEN / ROUTE_SPACING
            depths = gaussian_filter1d(depths, width, axis=1, mode="nearest")
            depths += 0.5 * self._error  # the minimum over the views is biased
        return np.maximum(depths.min(axis=0), least)

    def _depths(self, points: ArrayLike) -> np.ndarray:
        """Signed distances (views, ...), m, of points (..., 3) from each outline."""
        points = np.asarray(points, dtype=np.float64)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        found = loops.depths(flat, self._views, self._walls, self._focal)
        return found.reshape(-1, *points.shape[:-1])

    @property
    def _error(self) -> float:
        """Error of the outlines with which places are weighted, m."""
        arm, noise = self._planes[0].carm, self._errors.noise
        return max(0.7 * noise, _LEAST_ERROR) * arm.source_isocentre / arm.focal_length

    @cached_property
    def _walls(self) -> np.ndarray:
        """Signed distances of pixels from the outlines, px, (P, rows, columns)."""
        walls = []
        for plane in self._roadmaps:
            inside = plane.vessel_mask
            out = _EDGE - distance_transform_edt(~inside)
            within = distance_transform_edt(inside) - _EDGE
            wall = np.where(inside, within, out)
            walls.append(self._spoiled(wall).astype(np.float32))
        return np.stack(walls)

    def _spoiled(self, wall: np.ndarray) -> np.ndarray:
        """Adds the errors of a roadmap to signed distances (rows, columns), px."""
        errors, random = self._errors, self._random
        if not errors.any:
            return wall
        inside = np.argwhere(wall > 0.0)
        wall = wall - errors.erosion
        if errors.noise:
            white = random.normal(size=wall.shape)
            smooth = gaussian_filter(white, _ALONG, mode="wrap")
            # The filter scales the deviation of white noise by 1 / (2 sqrt(pi) sigma).
            wall = wall + errors.noise * smooth * 2.0 * np.sqrt(np.pi) * _ALONG
        if len(inside):
            rows, columns = np.indices(wall.shape)
            for row, column in inside[random.randint(len(inside), size=errors.gaps)]:
                away = np.hypot(rows - row, columns - column)
                wall = np.minimum(wall, away - _GAP)
        return wall

    @cached_property
    def _hull(self) -> tuple[np.ndarray, np.ndarray]:
        """First corner (3,) of a grid around the hull, and its depths (X, Y, Z), m."""
        arm = self._planes[0].carm
        half = 0.5 * max(arm.resolution) * arm.source_isocentre / arm.focal_length
        low = np.asarray(arm.isocentre) - half
        number = np.arange(int(2 * half / HULL_SPACING) + 1) * HULL_SPACING
        x, y, z = low[:, None] + number
        grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1)
        depth = self.depth(grid)
        inside = np.argwhere(depth > _OUTSIDE)
        first, last = inside.min(axis=0), inside.max(axis=0)
        box = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
        return low + first * HULL_SPACING, depth[box].copy()

    def route(self, start: ArrayLike, goal: ArrayLike) -> np.ndarray:
        """Points (P, 3), m, every `ROUTE_SPACING` from a place in the hull to a goal.

        Args:
            start: (3,) world frame, m.
            goal: (3,) world frame, m.
        """
        start, goal = (np.asarray(end, dtype=np.float64) for end in (start, goal))
        found = self._path(start, goal)
        line = _smoothed(np.vstack([start, found[1:-1], goal]), _SMOOTHING)
        for _ in range(_CENTRINGS if self._errors.any else 0):
            line = _smoothed(self._centred(line), _SLIGHTLY)
        return line

    def _centred(self, line: np.ndarray) -> np.ndarray:
        """Moves each point of a route (P, 3), m, to the mean of a disc around it.

        The weight of a place is the probability that it is in the vessel, times its
        depth.
        """
        wide = np.clip(_DISC_RADII * self.depth(line) + 1e-3, _DISC[0], _DISC[1])
        shifts = wide[:, None, None] * (_disc() @ across(line))
        depths, error = self._depths(line[:, None] + shifts), self._error
        weights = ndtr(depths / error).prod(axis=0)
        weights *= np.maximum(depths.min(axis=0) + error, 0.1 * error)
        width = _POOLED_MIDDLE / ROUTE_SPACING
        weights = gaussian_filter1d(weights + 1e-9, width, axis=0)[..., None]
        # Both ends stay where they are.
        number = np.arange(len(line))
        ends = np.clip(np.minimum(number, number[::-1]) * ROUTE_SPACING / 1e-2, 0, 1)
        mean = (weights * shifts).sum(axis=1) / weights.sum(axis=1)
        return line + ends[:, None] * mean

    def _path(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Points (n, 3), m, of the grid on the cheapest path from start to goal."""
        low, depth = self._hull
        if self._goal is None or not np.array_equal(self._goal[0], goal):
            margin = 0.4 * HULL_SPACING
            cost = (_WIDE / np.clip(depth, margin, _WIDE)) ** 2
            cost = np.where(depth > _OUTSIDE, cost, _DEAR * cost)
            least = _THROUGH if self._errors.any else _OUTSIDE
            cost = np.where(depth > least, cost, -1.0)
            end = nearest_cell(np.argwhere(cost > 0.0), (goal - low) / HULL_SPACING)
            graph, way = search(cost, end)
            self._graph, self._goal = graph, (goal, np.argwhere(np.isfinite(way)))
        begin = nearest_cell(self._goal[1], (start - low) / HULL_SPACING)
        path = np.array(self._graph.traceback(begin))[::-1]
        return low + path * HULL_SPACING


def _smoothed(line: np.ndarray, width: float) -> np.ndarray:
    """A line (n, 3) smoothed over a width, m, in steps of `ROUTE_SPACING`."""
    way = arc_lengths(line)
    number = max(round(way[-1] / ROUTE_SPACING), 1) + 1
    line = interpolate(np.linspace(0.0, way[-1], number), way, line)
    # The line continues beyond its ends, point reflected, so that they stay in place.
    beyond = round(3 * width / ROUTE_SPACING)
    around = ((beyond, beyond), (0, 0))
    whole = np.pad(line, around, "reflect", reflect_type="odd")
    smooth = gaussian_filter1d(whole, width / ROUTE_SPACING, axis=0)
    return smooth[beyond : beyond + len(line)]


@cache
def _disc() -> np.ndarray:
    """Points (n, 2) in the unit disc."""
    number = np.linspace(-1.0, 1.0, 9)
    points = np.stack(np.meshgrid(number, number), axis=-1).reshape(-1, 2)
    return points[np.linalg.norm(points, axis=1) < 1.01]


@cache
def _directions(count: int = 300) -> np.ndarray:
    """Unit vectors (count, 3) all around, evenly spaced (Fibonacci)."""
    number = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * number / count, np.pi * (1.0 + 5**0.5) * number
    flat = np.sqrt(1.0 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1)
