"""What the operator sees: the live images of N simulations and their recent past."""

from collections.abc import Sequence

import mujoco
import numpy as np

from cathsim_dmc.imaging import angiograph as machines
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.tasks import cameras, observations


class Screen:
    """Takes the pictures that the observations ask for, of N simulations."""

    def __init__(
        self,
        names: Sequence[str],
        angiograph: machines.Angiograph | None,
        radius: float,
        simulations: int,
        eyes: cameras.Cameras | None = None,
    ):
        """Switches the screen on.

        Args:
          names: of the observations.
          angiograph: needed by fluoroscopic observations.
          radius: of the device, m.
          simulations: N.
          eyes: cameras, needed by `rgb` and `depth`.
        """
        self._names = names
        self._on = angiograph is not None or eyes is not None
        self._angiograph = angiograph
        self._radius = radius
        self._eyes = eyes
        self._planes = [angiograph and angiograph.planes()] * simulations
        self._images: list[np.ndarray] = []
        self._masks = self._pixels = None
        self._views: dict[str, np.ndarray] = {}

    def restart(self, index: int, deviation: machines.Deviation) -> None:
        """Begins an episode of one simulation, before a machine that deviates."""
        if self._angiograph is not None:
            self._planes[index] = self._angiograph.planes(deviation)

    def take(
        self,
        lines: np.ndarray,
        goal: np.ndarray,
        qpos: np.ndarray,
        random_states: Sequence[np.random.RandomState] | None,
        fresh: np.ndarray | None = None,
    ) -> observations.Picture:
        """Takes the next pictures.

        Args:
          lines: (N, n, 3), centrelines of the devices, m.
          goal: (3,) or (N, 3), m.
          qpos: (N, nq).
          random_states: N sources of quantum noise, None for images without.
          fresh: indices of simulations that have just begun an episode: only theirs
            are taken and fill their whole history. None for all, one step on.
        """
        if not self._on:
            return observations.DARK
        count = len(qpos)
        chosen = np.arange(count) if fresh is None else fresh
        line = lines[chosen]
        planes = [self._planes[index] for index in chosen]
        if self._wants("image", "sequential"):
            states = None
            if random_states is not None and self._angiograph.options.noise:
                states = [random_states[index] for index in chosen]
            image = machines.render(planes, line, self._radius, states)
            self._remember(image, count, fresh)
        if self._wants("segmentation"):
            masks = machines.masks(planes, line, self._radius)
            self._masks = _merged(self._masks, masks, count, fresh)
        if self._wants("tracking_2d"):
            ends = np.broadcast_to(goal, (count, 3))[chosen, None]
            points = np.concatenate([observations.tracked(line), ends], axis=-2)
            pixels = machines.pixels(planes, points)
            self._pixels = _merged(self._pixels, pixels, count, fresh)
        kinds = [kind for kind in cameras.KINDS if kind in self._names]
        if kinds:
            for key, view in self._eyes.see(kinds, qpos[chosen]).items():
                self._views[key] = _merged(self._views.get(key), view, count, fresh)
        return observations.Picture(
            image=self._images[0] if self._images else None,
            past_images=tuple(self._images[1:]),
            masks=self._masks,
            pixels=self._pixels,
            views=dict(self._views),
        )

    def _wants(self, *names: str) -> bool:
        return any(name in self._names for name in names)

    def _remember(self, image, count, fresh):
        length = observations.SEQUENCE_LENGTH
        if fresh is None and self._images:
            self._images = [image, *self._images[: length - 1]]
            return
        past = self._images or [None] * length
        self._images = [_merged(each, image, count, fresh) for each in past]

    @property
    def fluoroscope(self) -> Fluoroscope | None:
        """Frontal plane before the first simulation, or None without fluoroscopy."""
        return self._planes[0] and self._planes[0][0]


def _merged(old, new, count, fresh):
    """`new` in the rows `fresh` of `old`; the caller's arrays are not shared."""
    if fresh is None:
        return new
    if old is None:
        old = np.zeros((count, *new.shape[1:]), dtype=new.dtype)
    old = old.copy()
    old[fresh] = new
    return old


def open_cameras(
    names: Sequence[str],
    model: mujoco.MjModel,
    options: cameras.CameraOptions,
    catheter: str,
) -> cameras.Cameras | None:
    """The cameras that the observations need, or None if they need none."""
    if not any(kind in names for kind in cameras.KINDS):
        return None
    return cameras.Cameras(model, options, catheter)
