"""Image sensors of N simulations, with the last few images of each."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from cathsim_dmc import rows as array_rows
from cathsim_dmc.imaging import angiograph as angiographs
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.tasks import observations
from cathsim_dmc.tasks.biplane_sight import BiplaneSight
from cathsim_dmc.tasks.cases import Case
from cathsim_dmc.tasks.common_chain import CommonChain
from cathsim_dmc.tasks.observation_kind import BIPLANE, FLUOROSCOPY, HeldImages

_BIPLANE = ("biplane", "biplane_retry")
_OF_IMAGES = ("image", "sequential", *_BIPLANE)
_SHOWING = (*_OF_IMAGES, "segmentation")  # the vessel, too


class Exposure(NamedTuple):
    """What N machines image in a control step.

    Attributes:
        line: (N, n, 3), centrelines of the chains, m.
        ends: (N, m, 3), tracked points of coaxial devices, m.
        goal: (N, 3), m.
        shadows: X-ray shadows of the devices.
        handles: (N, 3, 3), orientation of the handles, axes in columns.
        last: (N,), last arc lengths of the heads on their routes, m, see
            `BiplaneSight.see`.
    """

    line: np.ndarray
    ends: np.ndarray
    goal: np.ndarray
    shadows: Sequence[Shadow]
    handles: np.ndarray
    last: np.ndarray


class ImageSensors:
    """Captures the images that the observations ask for, of N simulations.

    Attributes:
        planes: Planes of each simulation's machine; empty without fluoroscopy.
        thirds: Plane of each simulation's third roadmap, an empty tuple without one.
        images: The last images (N, ...) by name; "past_1" is the one before "past_0".
        sight: Reconstruction from two planes.
    """

    state = ("images",)  # see `snapshot`

    def __init__(
        self,
        names: Sequence[str],
        cases: Sequence[Case],
        num_simulations: int,
        chain: CommonChain,
    ):
        """Prepares the sensors for observations of these names, before any episode.

        Raises:
            ValueError: if `biplane` is observed by a single plane, or by planes that do
                not show inlet and goal of each case.
        """
        self._names = names = observations.with_images(names)
        self._chain, self._count = chain, num_simulations
        self.planes: list[angiographs.Planes] = []
        self.thirds: list[angiographs.Planes] = []
        self.sight, self._noise = BiplaneSight(num_simulations), False
        if observations.needs(names, FLUOROSCOPY, BIPLANE):
            case = cases[0]
            options = case.angiograph.options
            self.planes = [case.angiograph.planes()] * num_simulations
            self.thirds = [case.angiograph.third()] * num_simulations
            self.sight = BiplaneSight(num_simulations, options.roadmap_errors)
            self._noise = options.noise
            if observations.needs(names, BIPLANE):
                if options.planes < 2:
                    raise ValueError(
                        "the observation 'biplane' needs two planes: give fluoroscopy "
                        "a biplane, such as {'view': [60, 0], 'biplane': [-30, 0]}"
                    )
                for each in cases:
                    _check_in_view(each)
        self.images = HeldImages()

    def capture(
        self,
        rows: np.ndarray,
        begins: bool,
        exposure: Exposure,
        random_states: Sequence[np.random.RandomState] | None,
        around: Callable[[angiographs.Planes, int], angiographs.Planes],
    ) -> None:
        """Captures the next images; requires `planes`.

        Args:
            rows: (K,) numbers of the simulations whose images are captured.
            begins: Whether they begin an episode, so that the images fill their
                history. If not, the images of all N are captured.
            exposure: Devices and goals of all N.
            random_states: N sources of quantum noise, None for images without noise.
            around: Function from a simulation's planes and its number to the planes
                with its vessel as moved.
        """
        planes = [self.planes[index] for index in rows]
        own = [shadow.of(rows) for shadow in exposure.shadows]
        if self._wants(_SHOWING):
            planes = list(map(around, planes, rows.tolist()))
        if self._wants(_OF_IMAGES):
            noise = None
            if random_states is not None and self._noise:
                noise = [random_states[index] for index in rows]
            image = angiographs.images(planes, own, noise)
            self._append(rows, begins, image)
            if self._wants(_BIPLANE):
                if begins and random_states is not None:
                    self.sight.draw(rows, random_states)
                self._reconstruct(rows, begins, image, exposure)
        if "segmentation" in self._names:
            self.hold("masks", angiographs.masks(planes, own), rows)
        if "tracking_2d" in self._names:
            line, ends = self._chain.tracked(exposure.line[rows]), exposure.ends[rows]
            points = np.concatenate([line, ends, exposure.goal[rows, None]], axis=-2)
            self.hold("pixels", angiographs.pixels(planes, points), rows)

    def _append(self, rows: np.ndarray, begins: bool, image: np.ndarray) -> None:
        """Adds images (K, ...) to the history, or fills it with them."""
        for age in reversed(range(observations.SEQUENCE_LENGTH)):
            if begins or not age:
                self.hold(f"past_{age}", image, rows)
            else:
                newer = self.images[f"past_{age - 1}"]
                self.images[f"past_{age}"] = array_rows.copied(newer)

    def _reconstruct(
        self, rows: np.ndarray, begins: bool, image: np.ndarray, exposure: Exposure
    ) -> None:
        """Stores the entries of `biplane`, reconstructed from images (K, ...)."""
        # The roadmaps show the vessel at rest.
        machines = [(self.planes[index], self.thirds[index]) for index in rows]
        resting, goal = [two for two, _ in machines], exposure.goal[rows, None]
        marked = angiographs.pixels(resting, goal)[:, :, 0]
        handles, last = exposure.handles[rows], exposure.last[rows]
        seen = self.sight.see(machines, image, marked, handles, rows, begins, last)
        for key, value in seen.items():
            if key != "place" or "biplane_retry" in self._names:
                self.hold(f"biplane_{key}", value, rows)

    def hold(self, name: str, image: np.ndarray, rows: np.ndarray) -> None:
        """Stores images (K, ...) of some simulations (K,)."""
        if name not in self.images:
            shape = (self._count, *image.shape[1:])
            self.images[name] = np.zeros(shape, dtype=image.dtype)
        if len(rows) == self._count:
            array_rows.copy(self.images[name], image)
        else:
            self.images[name][rows] = image

    def _wants(self, names: Sequence[str]) -> bool:
        return any(name in self._names for name in names)


def _check_in_view(case: Case) -> None:
    """Refuses planes that do not show where the device enters, or the goal."""
    scene, anatomy = case.scene, case.scene.anatomy
    arms = case.fluoroscopy.carms(anatomy.surface.vertices)
    for what, place in {
        "inlet": anatomy.inlet.position,
        f"goal {scene.goal.name!r}": scene.goal.position,
    }.items():
        if not all(arm.shows(place) for arm in arms):
            at, centre = (
                f"({', '.join(f'{1e3 * x:.0f}' for x in point)}) mm"
                for point in (place, arms[0].isocentre)
            )
            raise ValueError(
                f"the observation 'biplane' needs the {what} at {at} in both planes of "
                f"{anatomy.name!r}, which turn about {centre} and do not show it: give "
                "fluoroscopy a centre between inlet and goal, less magnification or a "
                "larger detector_size, or import the scan with an inlet nearer to the "
                "goal (--inlet)"
            )
