"""Image sensors of N simulations, with the last few images of each."""

from collections.abc import Sequence

import mujoco
import numpy as np

from cathsim_dmc.imaging import angiograph as machines
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.tasks import cameras, observations
from cathsim_dmc.tasks.frame import NO_IMAGES, Images


class ImageSensors:
    """Captures the images that the observations ask for, of N simulations."""

    def __init__(
        self,
        names: Sequence[str],
        angiograph: machines.Angiograph | None,
        num_simulations: int,
        gl_cameras: cameras.Cameras | None = None,
    ):
        """Prepares the sensors.

        Args:
          names: Names of the observations.
          angiograph: Angiography machine; None without fluoroscopic observations.
          num_simulations: N.
          gl_cameras: MuJoCo's cameras; None without `rgb` and `depth`.
        """
        self._names = names
        self._on = angiograph is not None or gl_cameras is not None
        self._cameras = gl_cameras
        self._planes: list[machines.Planes] = []
        self._noise = False
        if angiograph is not None:
            self._planes = [angiograph.planes()] * num_simulations
            self._noise = angiograph.options.noise
        self._images: list[np.ndarray] = []
        self._masks = self._pixels = None
        self._views: dict[str, np.ndarray] = {}

    @property
    def on(self) -> bool:
        """Whether an observation needs them."""
        return self._on

    def restart(
        self,
        index: int,
        angiograph: machines.Angiograph | None,
        deviation: machines.Deviation,
    ) -> None:
        """Begins an episode of one simulation with its machine and its deviation."""
        if angiograph is not None:
            self._planes[index] = angiograph.planes(deviation)

    def capture(
        self,
        lines: np.ndarray,
        shadows: Sequence[Shadow],
        goal: np.ndarray,
        qpos: np.ndarray,
        random_states: Sequence[np.random.RandomState] | None,
        fresh: np.ndarray | None = None,
        device_points: np.ndarray | None = None,
    ) -> Images:
        """Captures the next images.

        Args:
          lines: (N, n, 3), centrelines of the chains, m.
          shadows: Shadow of each device.
          goal: (3,) or (N, 3), m.
          qpos: (N, nq).
          random_states: N sources of quantum noise, None for images without.
          fresh: indices of simulations that begin an episode: only their images are
            captured, and fill their history. None for a control step of all.
          device_points: (N, K, P, 3), tracked points of coaxial devices, m.
        """
        if not self._on:
            return NO_IMAGES
        count = len(qpos)
        chosen = np.arange(count) if fresh is None else fresh
        line = lines[chosen]
        planes = [self._planes[index] for index in chosen] if self._planes else []
        if self._wants("image", "sequential"):
            states = None
            if random_states is not None and self._noise:
                states = [random_states[index] for index in chosen.tolist()]
            image = machines.images(planes, [s.of(chosen) for s in shadows], states)
            self._remember(image, count, fresh)
        if self._wants("segmentation"):
            masks = machines.masks(planes, [s.of(chosen) for s in shadows])
            self._masks = _merged(self._masks, masks, count, fresh)
        if self._wants("tracking_2d"):
            ends = np.broadcast_to(goal, (count, 3))[chosen, None]
            points = [observations.tracked(line)]
            if device_points is not None:
                points.append(device_points[chosen].reshape(len(line), -1, 3))
            points = np.concatenate([*points, ends], axis=-2)
            pixels = machines.pixels(planes, points)
            self._pixels = _merged(self._pixels, pixels, count, fresh)
        kinds = [kind for kind in cameras.KINDS if kind in self._names]
        if kinds and self._cameras is not None:
            for key, view in self._cameras.see(kinds, qpos[chosen]).items():
                self._views[key] = _merged(self._views.get(key), view, count, fresh)
        return Images(
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
