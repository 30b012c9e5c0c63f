"""Biplane reconstruction: device, vessel and route in space from two X-ray images.

The device is followed backwards from the marker at its tip in what the live images show
and the mask images do not (digital subtraction). The vessel is the visual hull of its
outlines in both roadmaps; the route to the goal marker keeps to the middle of the hull.
Outlines with errors leave a hull that is thin and broken in narrow branches: the route
goes on through the gaps, is centred on what the views together show round it, and the
lumen is pooled along it.
"""

from dataclasses import replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.anatomy.centreline import arc_lengths, interpolate
from cathsim_dmc.anatomy.geodesic import nearest_cell, search
from cathsim_dmc.imaging import biplane_loops as loops
from cathsim_dmc.imaging import materials
from cathsim_dmc.imaging.carm import CArm
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.imaging.options import NO_ERRORS, RoadmapErrors

# Distance of the points along the device, m, and their number: 0.2 m of it.
TRACE_SPACING = 5e-3
TRACE_POINTS = 41
# With fewer points, the device is sought in other directions behind its tip, too.
TRACE_ENOUGH = 12
# From the middle of the marker to the end of the device, m.
MARKER_TO_HEAD = 0.5 * materials.MARKER_LENGTH

# Distance of the points at which the hull is known, m, and of those of the route.
HULL_SPACING = 3e-3
_OUTSIDE = -0.5 * HULL_SPACING  # m; a point so deep still counts as inside
ROUTE_SPACING = 1e-3
# So far outside the outlines, m, a way may lead through a gap of a roadmap, at so many
# times the cost of a way along an outline.
_THROUGH, _DEAR = -12e-3, 10.0
# Errors of roadmaps, px: length along which outlines err alike, radius of a gap.
_ALONG, _GAP = 4.0, 3.0
# Rays of the same place miss each other by less, px; where calibration matters most is
# this far from the isocentre, m.
_WIDEST, _FAR = 2.0, 0.1
# The route is smoothed by a Gaussian of this deviation, m: three points of the hull. It
# cuts corners, so between centrings less of it has to do.
_SMOOTHING, _SLIGHTLY = 4e-3, 2e-3
# Farther than this from its outlines, m, no place of a vessel is better than another.
_WIDE = 12e-3
_SHAFT = 1.6e-3  # m, width of a usual device
# From a pixel at the outline to the outline, px, on average.
_EDGE = 0.25
# Where outlines have errors. A route is centred so many times; round each of its points
# in a disc of so many radii of the hull, and between these limits, m. What the views
# show is pooled along the route over these deviations, m, for its middle and its lumen.
_CENTRINGS, _DISC_RADII, _DISC = 8, 1.3, (4e-3, 12e-3)
_POOLED_MIDDLE, _POOLED_LUMEN = 2e-3, 6e-3
_LEAST_ERROR = 0.2  # px
_LEAST_LUMEN = 1e-3, 2e-3  # m, of outlines without and with errors


class Biplane:
    """Two C-arms before one vessel.

    Attributes:
        matrices: (2, 3, 4), from places to pixels, see `CArm.matrix`.
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
            errors: Of the roadmaps and of what is known of the planes.
            seed: Of these errors.
        """
        self._planes, self._roadmaps = planes, (*planes, *third)
        self._errors, self._random = errors, np.random.RandomState(seed)
        self.isocentre = np.asarray(planes[0].carm.isocentre)
        arms = [self._believed(plane.carm) for plane in self._roadmaps]
        self._views = np.array([arm.matrix for arm in arms])
        self.matrices = self._views[:2]
        self._focal = np.array([plane.carm.focal_length for plane in self._roadmaps])
        # By how much rays of both planes may miss each other, px: what the angles are
        # off by, at a place some way from the isocentre.
        off = np.deg2rad(errors.calibration) * _FAR * planes[0].carm.focal_length
        self._widest = _WIDEST + float(off) / planes[0].carm.source_isocentre
        # Grey levels without a device, (2, rows, columns).
        self._masks = np.stack([plane.empty for plane in planes]).astype(np.float32)
        self._goal: tuple[np.ndarray, np.ndarray] | None = None

    def _believed(self, arm: CArm) -> CArm:
        """A C-arm whose angles are not quite those that it has."""
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
        # Of a rod across a pixel: the mean path through it.
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
        """Point (3,), m, that is seen at pixels (2, 2), (column, row) of each plane."""
        places, found = np.asarray(pixels, dtype=np.float64)[:, ::-1], np.empty(3)
        loops.triangulated(self.matrices, np.ascontiguousarray(places), found)
        return found

    def depth(self, points: ArrayLike) -> np.ndarray:
        """Signed distance (...), m, of points (..., 3) from the outlines, + inside."""
        return self._depths(points).min(axis=0)

    def radii(self, line: np.ndarray) -> np.ndarray:
        """Radii (P,) of the lumen along a route (P, 3), m."""
        from scipy.ndimage import gaussian_filter1d

        depths, least = self._depths(line), _LEAST_LUMEN[self._errors.any]
        if self._errors.any:
            width = _POOLED_LUMEN / ROUTE_SPACING
            depths = gaussian_filter1d(depths, width, axis=1, mode="nearest")
            depths += 0.5 * self._error  # the least of several is too small
        return np.maximum(depths.min(axis=0), least)

    def _depths(self, points: ArrayLike) -> np.ndarray:
        """Signed distances (views, ...), m, of points (..., 3) from each outline."""
        points = np.asarray(points, dtype=np.float64)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        found = loops.depths(flat, self._views, self._walls, self._focal)
        return found.reshape(-1, *points.shape[:-1])

    @property
    def _error(self) -> float:
        """Error of the outlines, a part of its deviation that tells places apart, m."""
        arm, noise = self._planes[0].carm, self._errors.noise
        return max(0.7 * noise, _LEAST_ERROR) * arm.source_isocentre / arm.focal_length

    @cached_property
    def _walls(self) -> np.ndarray:
        """Signed distances of pixels from the outlines, px, (P, rows, columns)."""
        from scipy.ndimage import distance_transform_edt as distances

        walls = []
        for plane in self._roadmaps:
            inside = plane.vessel_mask
            out, within = _EDGE - distances(~inside), distances(inside) - _EDGE
            wall = np.where(inside, within, out)
            walls.append(self._spoiled(wall).astype(np.float32))
        return np.stack(walls)

    def _spoiled(self, wall: np.ndarray) -> np.ndarray:
        """Signed distances (rows, columns) with the errors of a roadmap, px."""
        from scipy.ndimage import gaussian_filter

        errors, random = self._errors, self._random
        if not errors.any:
            return wall
        inside = np.argwhere(wall > 0.0)
        wall = wall - errors.erosion
        if errors.noise:
            white = random.normal(size=wall.shape)
            smooth = gaussian_filter(white, _ALONG, mode="wrap")
            # Of white noise the filter leaves 1 / (2 sqrt(pi) sigma).
            wall = wall + errors.noise * smooth * 2.0 * np.sqrt(np.pi) * _ALONG
        if len(inside):
            rows, columns = np.indices(wall.shape)
            for row, column in inside[random.randint(len(inside), size=errors.gaps)]:
                away = np.hypot(rows - row, columns - column)
                wall = np.minimum(wall, away - _GAP)
        return wall

    @cached_property
    def _hull(self) -> tuple[np.ndarray, np.ndarray]:
        """First corner (3,) of a grid round the hull, and its depths (X, Y, Z)."""
        arm = self._planes[0].carm
        half = 0.5 * arm.resolution[1] * arm.source_isocentre / arm.focal_length
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
        """A route (P, 3) each of whose points is in the middle of what is round it.

        Places count by how probable it is that they are in the vessel, and how deep.
        """
        from scipy.ndimage import gaussian_filter1d
        from scipy.special import ndtr

        ways = np.gradient(line, axis=0)
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        across = np.eye(3)[np.abs(ways).argmin(axis=1)]
        across = np.cross(ways, across)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        disc = np.stack([across, np.cross(ways, across)], axis=1)
        wide = np.clip(_DISC_RADII * self.depth(line) + 1e-3, _DISC[0], _DISC[1])
        shifts = wide[:, None, None] * (_disc() @ disc)
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
        """Points of the grid from the start to the goal, the cheapest way."""
        low, depth = self._hull
        if self._goal is None or not np.array_equal(self._goal[0], goal):
            margin = 0.4 * HULL_SPACING
            cost = (_WIDE / np.clip(depth, margin, _WIDE)) ** 2
            cost = np.where(depth > _OUTSIDE, cost, _DEAR * cost)
            cost = np.where(depth > self._limit, cost, -1.0)
            end = nearest_cell(np.argwhere(cost > 0.0), (goal - low) / HULL_SPACING)
            self._graph, way = search(cost, end)
            self._goal = goal, np.argwhere(np.isfinite(way))
        begin = nearest_cell(self._goal[1], (start - low) / HULL_SPACING)
        path = np.array(self._graph.traceback(begin))[::-1]
        return low + path * HULL_SPACING

    @property
    def _limit(self) -> float:
        """Depth, m, from which on places are part of ways."""
        return _THROUGH if self._errors.any else _OUTSIDE


def _smoothed(line: np.ndarray, width: float) -> np.ndarray:
    """A line (n, 3) smoothed over a width, m, in steps of `ROUTE_SPACING`."""
    from scipy.ndimage import gaussian_filter1d

    way = arc_lengths(line)
    line = interpolate(np.arange(0.0, way[-1], ROUTE_SPACING), way, line)
    # The ends stay where they are: the line continues beyond them, point reflected.
    beyond = min(round(3 * width / ROUTE_SPACING), len(line) - 1)
    around = ((beyond, beyond), (0, 0))
    whole = np.pad(line, around, "reflect", reflect_type="odd")
    smooth = gaussian_filter1d(whole, width / ROUTE_SPACING, axis=0)
    return smooth[beyond : beyond + len(line)]


@cache
def _disc(across: int = 9) -> np.ndarray:
    """Points (n, 2) in the unit disc."""
    number = np.linspace(-1.0, 1.0, across)
    points = np.stack(np.meshgrid(number, number), axis=-1).reshape(-1, 2)
    return points[np.linalg.norm(points, axis=1) < 1.01]


@cache
def _directions(count: int = 300) -> np.ndarray:
    """Unit vectors (count, 3) all around, evenly spaced (Fibonacci)."""
    number = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * number / count, np.pi * (1.0 + 5**0.5) * number
    flat = np.sqrt(1.0 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1)
