"""Options of the fluoroscopy that a task shows, JSON-able."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.imaging import carm, detector, materials
from cathsim_dmc.imaging.carm import VIEWS, CArm

# Long side of a 30 x 38 cm flat detector, m. It shows 0.26 m of patient: an arch from
# the inlet to the ends of the branches.
DETECTOR_SIZE = 0.38

# Endoluminal camera: vertical field of view of a chip-on-tip endoscope, degrees, and
# distance, m, at which a ray that meets no wall ends.
VIEW_ANGLE, FARTHEST_WALL = 90.0, 0.3

# Bounds (low, high, unit) of the numbers that are not those of a C-arm.
_BOUNDS = {
    "kerma": (0.0, 1.0, "Gy"),
    "gain": (0.0, 1000.0, ""),
    "blur": (0.0, 0.1, "m"),
    "roadmap": (0.0, 1.0, ""),
}
_MOST_IODINE = 10_000.0  # kg/m³, twice the density of solid iodine

# Name in `carm.VIEWS`, or primary and secondary angle in degrees.
View = str | Sequence[float]
# Name of the views with the fewest ambiguous places, see `imaging.views`; and angles,
# degrees, that replace them where no anatomy is known.
BEST = "best"
_ANY = {"view": (0.0, 0.0), "biplane": (90.0, 0.0), "third": (45.0, 0.0)}


@dataclass(frozen=True)
class RoadmapErrors:
    """Errors of the roadmaps, from which the observation `biplane` takes the route.

    Each episode draws its own.

    Attributes:
        noise: standard deviation of the place of the outlines, pixels; smooth along
            them.
        erosion: distance by which the outlines lie inside those of the vessel, pixels.
        gaps: missing segments of each roadmap.
        calibration: largest error of the angles of each plane, degrees.
    """

    noise: float = 0.0
    erosion: float = 0.0
    gaps: int = 0
    calibration: float = 0.0

    def __post_init__(self) -> None:
        bounds.number("noise", self.noise, 0.0, 20.0, "pixels")
        bounds.number("erosion", self.erosion, -20.0, 20.0, "pixels")
        bounds.whole("gaps", self.gaps, 0, 100)
        bounds.number("calibration", self.calibration, 0.0, 20.0, "degrees")

    @property
    def any(self) -> bool:
        """Whether there are errors."""
        return self != NO_ERRORS


NO_ERRORS = RoadmapErrors()


@dataclass(frozen=True)
class FluoroscopyOptions:
    """Set-up of the angiography suite.

    Attributes:
        view: name of a view, or (primary, secondary) angle in degrees. "best", for
            `biplane` too, selects the pair of views of this anatomy in which the fewest
            points are ambiguous.
        biplane: view of a second C-arm; None for a single plane.
        third: view of a third roadmap, which the observation `biplane` also uses for
            its route; None for two roadmaps.
        roadmap_errors: `RoadmapErrors`, or a mapping of its fields.
        size: pixels along a side of the image, or (rows, columns).
        magnification: electronic zoom.
        centre: isocentre (3,), world frame, m. None for the middle of the lumen, or for
            the middle between inlet and goal if that view would miss one of them.
        contrast: iodine in the lumen, kg/m³ (mg/ml); True for the usual concentration,
            False for none.
        noise: whether images have quantum noise, drawn from the environment's random
            state.
        kerma: air kerma at the detector per frame, Gy; the noise decreases with it.
        gain: grey level of tissue without vessel or device as a fraction of white.
        blur: standard deviation of the detector's point spread, m.
        roadmap: opacity of the roadmap, of the vessel at rest, over the live image, 0
            for none; usually with `contrast=False`.
        source_detector: distance of source and detector, m.
        source_isocentre: distance of source and isocentre, m.
        detector_size: width of the detector, m.
    """

    view: View = "AP"
    biplane: View | None = None
    third: View | None = None
    size: int | Sequence[int] = carm.RESOLUTION
    magnification: float = 1.0
    centre: Sequence[float] | None = None
    contrast: float | bool = True
    noise: bool = False
    kerma: float = detector.FRAME_KERMA
    gain: float = detector.GAIN
    blur: float = detector.DETECTOR_BLUR
    roadmap: float = 0.0
    source_detector: float = carm.SOURCE_DETECTOR
    source_isocentre: float = carm.SOURCE_ISOCENTRE
    detector_size: float = DETECTOR_SIZE
    # Accepts a mapping, which `__post_init__` converts to `RoadmapErrors`.
    roadmap_errors: Any = NO_ERRORS

    def __post_init__(self) -> None:
        errors = bounds.made("roadmap_errors", self.roadmap_errors, RoadmapErrors)
        vars(self)["roadmap_errors"] = errors
        if is_best(self.view) != is_best(self.biplane):
            raise ValueError(
                f"view is {self.view!r} and biplane {self.biplane!r}; give {BEST!r} "
                "for both, or for none"
            )
        bounds.fields(self, _BOUNDS, positive=("kerma", "gain"))
        bounds.switch("noise", self.noise)
        if not isinstance(self.contrast, bool):
            bounds.number("contrast", self.contrast, 0.0, _MOST_IODINE, "kg/m³")
        if self.centre is not None:
            bounds.vector("centre", self.centre, 3, -bounds.FAR, bounds.FAR, "m")
        # Built here, so that a wrong option is refused before any simulation.
        third = () if self.third is None else ("third",)
        for names in ((), third):
            self.carms(np.zeros((1, 3)), names=names)
        for name in ("view", "biplane", "third", "size", "centre"):
            if isinstance(given := getattr(self, name), list | np.ndarray):
                vars(self)[name] = tuple(given)  # hashable

    @property
    def iodine(self) -> float:
        """Iodine in the lumen, kg/m³."""
        if isinstance(self.contrast, bool):
            return materials.CONTRAST if self.contrast else 0.0
        return float(self.contrast)

    @property
    def resolution(self) -> tuple[int, int]:
        """(rows, columns)."""
        return bounds.pixels("size", self.size)

    @property
    def planes(self) -> int:
        """Number of C-arms, 1 or 2."""
        return 1 if self.biplane is None else 2

    def carms(
        self,
        points: np.ndarray,
        deviation: tuple[float, float] = (0.0, 0.0),
        names: Sequence[str] = (),
    ) -> tuple[CArm, ...]:
        """The C-arms, frontal first.

        Args:
            points: (..., 3) whose middle is the isocentre unless `centre` is given, m.
            deviation: added to primary and secondary angle of every plane, degrees.
            names: names of the fields with the views; by default those of the planes.

        Raises:
            ValueError: if a view or a distance is not possible.
        """
        own = ("magnification", "source_detector", "source_isocentre", "detector_size")
        fields: dict[str, Any] = {name: getattr(self, name) for name in own}
        if self.centre is not None:
            fields["isocentre"] = self.centre
        arms = []
        for name in names or ("view", "biplane")[: self.planes]:
            angles = np.deg2rad(np.add(_angles(name, getattr(self, name)), deviation))
            arm = CArm(angles[0], angles[1], resolution=self.resolution, **fields)
            arms.append(arm.centred_on(points) if self.centre is None else arm)
        return tuple(arms)

    def aimed(self, points: np.ndarray, places: np.ndarray) -> Self:
        """Puts the isocentre amid `places` if that amid `points` misses some of them.

        A given centre stays. Options do not change if neither shows all places.

        Args:
            points: (m, 3), vertices of the lumen, m.
            places: (n, 3), what every plane should show, m.
        """

        def shown(amid: np.ndarray) -> bool:
            return all(arm.shows(places).all() for arm in self.carms(amid))

        if self.centre is not None or shown(points) or not shown(places):
            return self
        return replace(self, centre=self.carms(places)[0].isocentre)


def is_best(view: View | None) -> bool:
    """Whether a view is "best", which depends on the anatomy."""
    return isinstance(view, str) and view == BEST


def _angles(name: str, view: View) -> tuple[float, float]:
    if is_best(view):
        return _ANY[name]
    if isinstance(view, str):
        if view not in VIEWS:
            names = ", ".join((*VIEWS, BEST))
            bounds.refuse(name, view, f"one of {names}, or two angles in degrees")
        return VIEWS[view]
    primary, secondary = bounds.vector(name, view, 2, -360.0, 360.0, "degrees")
    tilt = f"secondary angle of {name}"
    bounds.number(tilt, float(secondary), -89.0, 89.0, "degrees")
    return primary, secondary
