"""The angiography machine: one or two C-arms before one anatomy, for many devices."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.fluoroscopy import Fluoroscope
from cathsim_dmc.imaging.options import FluoroscopyOptions

Planes = tuple[Fluoroscope, ...]


@dataclass(frozen=True)
class Deviation:
    """Deviation of one simulation's machine from the options.

    Attributes:
        primary: added to the primary angles, whole degrees.
        secondary: added to the secondary angles, whole degrees.
        gain: factor of the gain.
        kerma: factor of the kerma.
    """

    primary: int = 0
    secondary: int = 0
    gain: float = 1.0
    kerma: float = 1.0


class Angiograph:
    """C-arms before an anatomy; images have the leading axis N of the devices.

    The path length through the vessel is cached for each pair of angles.

    Attributes:
        options: Set-up of the machine.
    """

    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        options: FluoroscopyOptions | None = None,
    ):
        """Computes the path length through the vessel for the default angles.

        Args:
            vertices: (V, 3) of the lumen surface, world frame, m.
            faces: (F, 3), counter-clockwise seen from outside.
        """
        self._vertices, self._faces = vertices, faces
        self.options = options or FluoroscopyOptions()
        self._views: dict[tuple[int, int], Planes] = {}
        self._usual = self._view(0, 0)

    def _view(self, primary: int, secondary: int) -> Planes:
        key = (primary, secondary)
        if key not in self._views:
            options = self.options
            self._views[key] = tuple(
                Fluoroscope.from_surface(
                    self._vertices,
                    self._faces,
                    arm,
                    contrast=options.iodine,
                    kerma=options.kerma,
                    blur=options.blur,
                    gain=options.gain,
                    roadmap=options.roadmap,
                )
                for arm in options.carms(self._vertices, key)
            )
        return self._views[key]

    def planes(self, deviation: Deviation | None = None) -> Planes:
        """Fluoroscopes of every plane, frontal first."""
        if deviation is None or deviation == Deviation():
            return self._usual
        view = self._view(deviation.primary, deviation.secondary)
        if deviation.gain == 1.0 and deviation.kerma == 1.0:
            return view
        return tuple(
            replace(
                plane,
                gain=plane.gain * deviation.gain,
                kerma=plane.kerma * deviation.kerma,
            )
            for plane in view
        )


def images(
    machines: Sequence[Planes],
    shadows: Sequence[Shadow],
    random_states: Sequence[np.random.RandomState] | None = None,
) -> np.ndarray:
    """Images before N machines, each of one device or of several in each other.

    Args:
        machines: N times the planes of a machine, all with as many.
        shadows: of the devices, with points (N, n, 3) and one radius.
        random_states: one for each device, or None for images without noise. Of two
            planes the frontal one draws first.

    Returns:
        (N, rows, columns, planes) uint8.
    """
    groups = _alike(machines)
    images = []
    for plane, shape in enumerate(_resolutions(machines)):
        if len(groups) == 1:
            images.append(machines[0][plane].image(shadows, random_states))
            continue
        image = np.empty((len(machines), *shape, 1), dtype=np.uint8)
        for chosen in groups:
            states = random_states and [random_states[i] for i in chosen]
            own = [shadow.of(chosen) for shadow in shadows]
            image[chosen] = machines[chosen[0]][plane].image(own, states)
        images.append(image)
    return np.concatenate(images, axis=-1) if len(images) > 1 else images[0]


def masks(machines: Sequence[Planes], shadows: Sequence[Shadow]) -> np.ndarray:
    """Segmentation (N, rows, columns, 2 planes) uint8, 0 or 255.

    Channels: device and vessel of the frontal plane, then of the second one. Arguments
    as in `images`.
    """
    channels = []
    for plane, shape in enumerate(_resolutions(machines)):
        both = np.empty((len(machines), *shape, 2), dtype=np.uint8)
        for chosen in _alike(machines):
            own = [shadow.of(chosen) for shadow in shadows]
            fluoroscope = machines[chosen[0]][plane]
            both[chosen, ..., 0] = fluoroscope.device_mask(own) * np.uint8(255)
            both[chosen, ..., 1] = fluoroscope.vessel_mask * np.uint8(255)
        channels.append(both)
    return np.concatenate(channels, axis=-1)


def pixels(machines: Sequence[Planes], points: np.ndarray) -> np.ndarray:
    """Pixel coordinates (column, row) of points (N, K, 3), m: (N, planes, K, 2).

    Points that no ray reaches, nearer to a source than its housing, are at -1.
    """
    places = np.empty((len(points), len(machines[0]), points.shape[1], 2))
    for chosen in _alike(machines):
        for plane, fluoroscope in enumerate(machines[chosen[0]]):
            places[chosen, plane] = fluoroscope.carm.project(points[chosen])[0]
    return np.nan_to_num(places, copy=False, nan=-1.0)


def _resolutions(machines: Sequence[Planes]) -> list[tuple[int, int]]:
    return [plane.carm.resolution for plane in machines[0]]


def _alike(machines: Sequence[Planes]) -> list[np.ndarray]:
    """Indices of devices before the same machine, in the order of the devices."""
    groups: dict[int, list[int]] = {}
    for index, planes in enumerate(machines):
        groups.setdefault(id(planes), []).append(index)
    return [np.array(group) for group in groups.values()]
