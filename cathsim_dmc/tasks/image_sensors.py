"""Image sensors of N simulations, with the last few images of each."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cathsim_dmc.imaging import angiograph as angiographs
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.tasks import observations
from cathsim_dmc.tasks.biplane_sight import BiplaneSight
from cathsim_dmc.tasks.common_chain import CommonChain

_AGES = tuple(f"past_{age}" for age in range(observations.SEQUENCE_LENGTH))

ENDOLUMINAL = ("endoluminal", "endoluminal_distance")


class ImageSensors:
    """Captures the images that the observations ask for, of N simulations.

    Attributes:
        on: Whether an observation needs them.
    """

    def __init__(
        self,
        names: Sequence[str],
        angiograph: angiographs.Angiograph | None,
        num_simulations: int,
        chain: CommonChain,
        endoscope: Callable[[np.ndarray], Mapping[str, np.ndarray]] | None = None,
    ):
        """Prepares the sensors.

        Args:
            angiograph: Angiography machine; None without fluoroscopic observations.
            num_simulations: N.
            chain: The device as observations show it.
            endoscope: Function from numbers (K,) of simulations to the endoluminal
                views (K, ...) from their heads, by name.
        """
        self._names, self._chain = names, chain
        self._endoscope = endoscope if self._wants(*ENDOLUMINAL) else None
        self.on = angiograph is not None or self._endoscope is not None
        self._planes: list[angiographs.Planes] = []
        self._sight = BiplaneSight(num_simulations)
        self._noise = False
        if angiograph is not None:
            self._planes = [angiograph.planes()] * num_simulations
            self._noise = angiograph.options.noise
            if observations.needs(names, "biplane") and angiograph.options.planes < 2:
                raise ValueError(
                    "the observation 'biplane' needs two planes: give fluoroscopy a "
                    "biplane, such as {'view': [60, 0], 'biplane': [-30, 0]}"
                )
        # The last images (N, ...) by name, and those before: past_0 is the last one.
        self._held: dict[str, np.ndarray] = {}

    def restart(
        self,
        index: int,
        angiograph: angiographs.Angiograph | None,
        deviation: angiographs.Deviation,
    ) -> None:
        """Begins an episode of one simulation with its machine and its deviation."""
        if angiograph is not None:
            self._planes[index] = angiograph.planes(deviation)

    def capture(
        self,
        lines: np.ndarray,
        shadows: Sequence[Shadow],
        goal: np.ndarray,
        random_states: Sequence[np.random.RandomState] | None,
        fresh: np.ndarray | None = None,
        device_points: np.ndarray | None = None,
        around: Callable[[angiographs.Planes, int], angiographs.Planes] | None = None,
        handles: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """Captures the next images.

        Args:
            lines: (N, n, 3), centrelines of the chains, m.
            goal: (3,) or (N, 3), m.
            random_states: N sources of quantum noise, None for images without.
            fresh: indices of simulations that begin an episode: only their images are
                captured, and fill their history. None for a control step of all.
            device_points: (N, K, P, 3), tracked points of coaxial devices, m.
            around: moves the vessel before the machine of a simulation.
            handles: (N, 3, 3), orientation of the handles, axes in columns; needed for
                "biplane".
        """
        count = len(lines)
        chosen = np.arange(count) if fresh is None else fresh
        line = lines[chosen]
        planes = [self._planes[index] for index in chosen] if self._planes else []
        if around and self._wants("image", "sequential", "segmentation"):
            planes = list(map(around, planes, chosen.tolist()))
        image = None
        if self._wants("image", "sequential", "biplane"):
            states = None
            if random_states is not None and self._noise:
                states = [random_states[index] for index in chosen.tolist()]
            image = angiographs.images(planes, [s.of(chosen) for s in shadows], states)
            self._remember(image, count, fresh)
        if self._wants("biplane") and image is not None and handles is not None:
            ends = np.broadcast_to(goal, (count, 3))[chosen, None]
            # The roadmaps show the vessel at rest.
            own = [self._planes[index] for index in chosen]
            marked = angiographs.pixels(own, ends)[:, :, 0]
            given = own, image, marked, handles[chosen], chosen
            seen = self._sight.see(*given, fresh is not None)
            for key, value in seen.items():
                self._hold(f"biplane_{key}", value, count, fresh)
        if self._wants("segmentation"):
            masks = angiographs.masks(planes, [s.of(chosen) for s in shadows])
            self._hold("masks", masks, count, fresh)
        if self._wants("tracking_2d"):
            ends = np.broadcast_to(goal, (count, 3))[chosen, None]
            points = [self._chain.tracked(line)]
            if device_points is not None:
                points.append(device_points[chosen].reshape(len(line), -1, 3))
            points = np.concatenate([*points, ends], axis=-2)
            self._hold("pixels", angiographs.pixels(planes, points), count, fresh)
        if self._endoscope is not None:
            for key, view in self._endoscope(chosen).items():
                self._hold(key, view, count, fresh)
        return dict(self._held)

    def _hold(self, name, image, count, fresh):
        self._held[name] = _merged(self._held.get(name), image, count, fresh)

    def _wants(self, *names: str) -> bool:
        return any(name in self._names for name in names)

    def _remember(self, image, count, fresh):
        if fresh is None and _AGES[0] in self._held:
            past = [image, *(self._held[age] for age in _AGES[:-1])]
            self._held.update(zip(_AGES, past, strict=True))
            return
        for age in _AGES:
            self._hold(age, image, count, fresh)

    @property
    def fluoroscope(self) -> Fluoroscope | None:
        """Frontal plane before the first simulation, or None without fluoroscopy."""
        return self._planes[0][0] if self._planes else None


def _merged(old, new, count, fresh):
    """`new` in the rows `fresh` of `old`; the caller's arrays are not shared."""
    if fresh is None:
        return new
    if old is None:
        old = np.zeros((count, *new.shape[1:]), dtype=new.dtype)
    old = old.copy()
    old[fresh] = new
    return old
