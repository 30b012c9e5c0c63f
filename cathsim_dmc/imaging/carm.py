"""The C-arm: position of X-ray source and detector about the patient.

The world is the patient frame LPS, in metres. Pixel coordinates are (column, row):
column grows to the right, row downwards, and (0, 0) is the centre of the top left
pixel. The observer looks from the detector towards the source: the patient's left is on
the right of an AP image and the head is up.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds

# Primary and secondary angle of the views used for the arch, degrees. Signs are those
# of the DICOM positioner angles: LAO and cranial positive.
VIEWS: Mapping[str, tuple[float, float]] = {
    "AP": (0.0, 0.0),
    "LAO45": (45.0, 0.0),
    "LATERAL": (90.0, 0.0),
    "RAO30": (-30.0, 0.0),
}

# Usual geometry of an angiography C-arm, m: source to isocentre is fixed by the
# gantry (0.72-0.81), source to detector is adjustable (0.90-1.20).
SOURCE_ISOCENTRE = 0.75
SOURCE_DETECTOR = 1.10
# Width of a 30 cm square flat detector, m; 0.205 m of patient at the isocentre.
DETECTOR_SIZE = 0.30
RESOLUTION = (128, 128)  # the published image observation

# Closer to the source than this (m) nothing is imaged: the tube housing is there.
NEAREST = 0.05
# Least and largest value of each number, and its unit: wider than real systems, within
# the computable.
_BOUNDS = {
    "primary": (-np.inf, np.inf, "rad"),
    "secondary": (-np.deg2rad(89.0), np.deg2rad(89.0), "rad"),
    "magnification": (0.01, 1000.0, ""),
    "source_detector": (NEAREST, bounds.FAR, "m"),
    "source_isocentre": (NEAREST, bounds.FAR, "m"),
    "detector_size": (1e-3, bounds.FAR, "m"),
}


@dataclass(frozen=True)
class CArm:
    """A cone-beam X-ray camera.

    Attributes:
        primary: rotation of the detector about the long axis of the patient, rad,
            0 = detector in front of the chest, positive towards the left (LAO).
        secondary: tilt of the detector, rad, positive towards the head (cranial).
        magnification: electronic zoom; 2 shows half the field on the same pixels.
        source_detector: distance of source and detector, m.
        source_isocentre: distance of source and isocentre, m.
        detector_size: width of the detector (its columns), m; pixels are square.
        resolution: (rows, columns).
        isocentre: the point (3,) about which the arm turns, world frame, m.
    """

    primary: float = 0.0
    secondary: float = 0.0
    magnification: float = 1.0
    source_detector: float = SOURCE_DETECTOR
    source_isocentre: float = SOURCE_ISOCENTRE
    detector_size: float = DETECTOR_SIZE
    resolution: tuple[int, int] = RESOLUTION
    isocentre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        checked = bounds.fields(self, _BOUNDS)
        if checked["source_detector"] < checked["source_isocentre"]:
            raise ValueError(
                f"source_detector is {self.source_detector} m and source_isocentre "
                f"{self.source_isocentre} m; the detector must lie beyond the isocentre"
            )
        isocentre = bounds.vector("isocentre", self.isocentre, 3, unit="m")
        resolution = bounds.pixels("resolution", self.resolution)
        vars(self).update(checked, isocentre=isocentre, resolution=resolution)

    @classmethod
    def view(cls, name: str = "AP", **fields) -> "CArm":
        """C-arm of a named view, see the constructor; ValueError for another name."""
        primary, secondary = np.deg2rad(VIEWS[bounds.choice("view", name, VIEWS)])
        return cls(primary=primary, secondary=secondary, **fields)

    def centred_on(self, points: ArrayLike) -> "CArm":
        """The same arm with its isocentre in the middle of the box around `points`.

        Args:
            points: (..., 3) world frame, m, for example the vertices of the lumen.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        return replace(self, isocentre=tuple(middle))

    @cached_property
    def axes(self) -> np.ndarray:
        """(3, 3) float64, rows: image right, image down, source to detector (world)."""
        ca, sa = np.cos(self.primary), np.sin(self.primary)
        cb, sb = np.cos(self.secondary), np.sin(self.secondary)
        beam = (cb * sa, -cb * ca, sb)
        return np.array([(ca, sa, 0.0), (sb * sa, -sb * ca, -cb), beam])

    @cached_property
    def source(self) -> np.ndarray:
        """(3,) float64, position of the X-ray focus, world frame, m."""
        return np.asarray(self.isocentre) - self.source_isocentre * self.axes[2]

    @property
    def pitch(self) -> float:
        """Side of a pixel on the detector, m."""
        return self.detector_size / (self.resolution[1] * self.magnification)

    @property
    def focal_length(self) -> float:
        """Source to detector distance in pixels."""
        return self.source_detector / self.pitch

    def camera(self, points: ArrayLike) -> np.ndarray:
        """Right, down and depth (..., 3) m of points (..., 3) m, from the source."""
        relative = np.asarray(points, dtype=np.float64) - self.source
        # Sums written out: a matrix product would round differently for batches.
        terms = relative[..., None, :] * self.axes
        return terms[..., 0] + terms[..., 1] + terms[..., 2]

    @property
    def matrix(self) -> np.ndarray:
        """(3, 4) float64: (x, y, z, 1) in m to (column w, row w, w), w the depth, m."""
        rows, columns = self.resolution
        inner = np.diag([self.focal_length, self.focal_length, 1.0])
        inner[:2, 2] = 0.5 * (columns - 1), 0.5 * (rows - 1)
        return inner @ np.column_stack([self.axes, -self.axes @ self.source])

    def shows(self, points: ArrayLike) -> np.ndarray:
        """Whether points (..., 3), m, lie within the image, (...) bool."""
        pixels, _ = self.project(points)
        last = np.subtract(self.resolution[::-1], 1)
        return np.all((pixels >= 0.0) & (pixels <= last), axis=-1)

    def project(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates of world points.

        Args:
            points: (..., 3) world frame, m.

        Returns:
            pixels: (..., 2) float64, (column, row); NaN for points nearer to the
                source than `NEAREST` or behind it. Points outside the image have
                coordinates outside it.
            depth: (...) float64, distance from the source along the beam axis, m.
        """
        right, down, depth = np.moveaxis(self.camera(points), -1, 0)
        scale = self.focal_length / np.where(depth > NEAREST, depth, np.nan)
        rows, columns = self.resolution
        column = right * scale + 0.5 * (columns - 1)
        row = down * scale + 0.5 * (rows - 1)
        return np.stack([column, row], axis=-1), depth

    def slant(self, supersample: int = 1) -> np.ndarray:
        """Path along each ray per unit of depth, 1 / cos of its angle to the axis.

        (rows * supersample, columns * supersample) float64, >= 1.
        """
        across = []
        for count in self.resolution:
            place = (np.arange(count * supersample) + 0.5) / supersample - 0.5 * count
            across.append((place / self.focal_length) ** 2)
        return np.sqrt(1.0 + across[1] + across[0][:, None])
