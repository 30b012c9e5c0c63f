"""The angiography machine: one or two C-arms before one anatomy, for many devices."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cathsim_dmc import rows
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging import views
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

    def __init__(self, surface: Surface, options: FluoroscopyOptions | None = None):
        """Computes the path lengths through a lumen (world frame, m) for its angles."""
        self._surface = surface
        self.options = views.settled(surface, options or FluoroscopyOptions())
        self._views: dict[tuple[int, int], Planes] = {}
        self._thirds: dict[tuple[int, int], Planes] = {}
        self.planes()

    def third(self, deviation: Deviation = Deviation()) -> Planes:
        """Plane of the third roadmap, a tuple of one; empty without a third roadmap."""
        if self.options.third is None:
            return ()
        angles = deviation.primary, deviation.secondary
        if angles not in self._thirds:
            vertices = self._surface.vertices
            (arm,) = self.options.carms(vertices, angles, ("third",))
            self._thirds[angles] = (Fluoroscope.from_surface(self._surface, arm),)
        return self._thirds[angles]

    def planes(self, deviation: Deviation = Deviation()) -> Planes:
        """Fluoroscopes of every plane, frontal first."""
        angles, options = (deviation.primary, deviation.secondary), self.options
        if angles not in self._views:
            names = "kerma", "blur", "gain", "roadmap"
            own = {name: getattr(options, name) for name in names}
            self._views[angles] = tuple(
                Fluoroscope.from_surface(
                    self._surface, arm, contrast=options.iodine, **own
                )
                for arm in options.carms(self._surface.vertices, angles)
            )
        view = self._views[angles]
        if deviation.gain == deviation.kerma == 1.0:
            return view
        gain, kerma = options.gain * deviation.gain, options.kerma * deviation.kerma
        return tuple(replace(plane, gain=gain, kerma=kerma) for plane in view)


def images(
    machines: Sequence[Planes],
    shadows: Sequence[Shadow],
    random_states: Sequence[np.random.RandomState] | None = None,
) -> np.ndarray:
    """Images of N machines, each of one device or of several coaxial ones.

    Args:
        machines: planes of the N machines, as many for each.
        shadows: of the devices, with points (N, n, 3) and one radius.
        random_states: one for each machine, or None for images without noise. With two
            planes, the frontal one draws first.

    Returns:
        (N, rows, columns, planes) uint8.
    """
    image = _blank(machines, 1)
    # Frames that share a random state draw in their order, so not in parallel.
    alone = random_states and len(set(map(id, random_states))) < len(random_states)
    for plane, chosen, fluoroscope in _each(machines):

        def render(part: slice) -> None:
            these = chosen[part]  # noqa: B023
            states = random_states and [random_states[i] for i in these]
            own = [shadow.of(these) for shadow in shadows]
            frames = fluoroscope.render(own, states)  # noqa: B023
            image[these, ..., plane] = frames[..., 0]  # noqa: B023

        if alone:
            render(slice(None))
        else:
            rows.each(len(chosen), render, least=16)
    return image


def masks(machines: Sequence[Planes], shadows: Sequence[Shadow]) -> np.ndarray:
    """Segmentation (N, rows, columns, 2 planes) uint8, 0 or 255.

    Channels: device and vessel of the frontal plane, then of the second one. Arguments
    as in `images`.
    """
    mask = _blank(machines, 2)
    for plane, chosen, fluoroscope in _each(machines):
        own = [shadow.of(chosen) for shadow in shadows]
        mask[chosen, ..., 2 * plane] = fluoroscope.device_mask(own) * np.uint8(255)
        mask[chosen, ..., 2 * plane + 1] = fluoroscope.vessel_mask * np.uint8(255)
    return mask


def pixels(machines: Sequence[Planes], points: np.ndarray) -> np.ndarray:
    """Pixel coordinates (column, row) of points (N, K, 3), m: (N, planes, K, 2).

    Points that no ray reaches, nearer to a source than its housing, are at -1.
    """
    places = np.empty((len(points), len(machines[0]), points.shape[1], 2))
    for plane, chosen, fluoroscope in _each(machines):
        places[chosen, plane] = fluoroscope.carm.project(points[chosen])[0]
    return np.nan_to_num(places, copy=False, nan=-1.0)


def _blank(machines: Sequence[Planes], channels: int) -> np.ndarray:
    planes = machines[0]
    shape = (len(machines), *planes[0].carm.resolution, channels * len(planes))
    return np.empty(shape, np.uint8)


def _each(machines: Sequence[Planes]) -> Iterator[tuple[int, np.ndarray, Fluoroscope]]:
    """Yields the number of a plane, the indices of its devices, and its fluoroscope."""
    groups: dict[int, list[int]] = {}
    for index, planes in enumerate(machines):
        groups.setdefault(id(planes), []).append(index)
    for plane in range(len(machines[0])):
        for group in groups.values():
            yield plane, np.array(group), machines[group[0]][plane]
