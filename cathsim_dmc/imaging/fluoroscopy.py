"""Fluoroscopy: the picture an operator sees, computed without OpenGL.

The path length through vessel and patient is computed once per anatomy and view
(`Fluoroscope.from_surface`); the device is drawn in every frame (`Fluoroscope.render`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging import detector, materials
from cathsim_dmc.imaging.carm import CArm
from cathsim_dmc.imaging.device import Shadow, device_attenuation, device_thickness
from cathsim_dmc.imaging.thickness import surface_thickness

# A pixel shows the device if the path through it is at least this share of its
# diameter: half the pixel covered to half the depth. Of a device thinner than a pixel,
# whose path is averaged over the pixel, it is that share of its width in pixels.
MASK_SHARE = 0.25

# Frames rendered at once.
_CHUNK = 16

RandomStates = np.random.RandomState | Sequence[np.random.RandomState]


@dataclass(frozen=True, eq=False)
class Fluoroscope:
    """One C-arm view of one anatomy.

    I = I0 exp(-(mu_iodine c L_vessel + mu_device L_device)), scaled so that plain
    tissue has the signal 1; then quantum noise, detector blur, and grey
    level = round(255 gain signal). Vessel and device count with their excess over
    the tissue whose place they take.

    Attributes:
        carm: the view.
        vessel: (rows, columns) path length through the lumen, m.
        vessel_mask: (rows, columns) bool, pixels whose central ray meets the lumen.
        contrast: iodine in the lumen, kg/m³ (mg/ml); 0 is contrast off.
        kerma: air kerma at the detector per frame behind plain tissue, Gy; more is
            less noise.
        blur: standard deviation of the detector's point spread, m.
        gain: share of full white given to plain tissue.
        roadmap: opacity of the vessel laid over the live image in white, 0 for none,
            1 for tissue in full white; usually shown with contrast 0.
    """

    carm: CArm
    vessel: np.ndarray
    vessel_mask: np.ndarray
    contrast: float = materials.CONTRAST
    kerma: float = detector.FRAME_KERMA
    blur: float = detector.DETECTOR_BLUR
    gain: float = detector.GAIN
    roadmap: float = 0.0

    def __post_init__(self) -> None:
        shape = self.carm.resolution
        for name, dtype in (("vessel", np.float32), ("vessel_mask", bool)):
            value = np.array(getattr(self, name), dtype=dtype)
            if value.shape != shape:
                raise ValueError(
                    f"{name} has shape {value.shape}, the C-arm {shape}; compute it "
                    "with the same C-arm (Fluoroscope.from_surface)."
                )
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def from_surface(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        carm: CArm | None = None,
        supersample: int = 3,
        **fields,
    ) -> "Fluoroscope":
        """Fluoroscope of a lumen surface: the static part, once per anatomy and view.

        Args:
            vertices: (V, 3) of the lumen surface, world frame, m.
            faces: (F, 3), counter-clockwise seen from outside, without open ends.
            carm: the view; by default AP with the isocentre in the middle of the
                surface.
            supersample: rays along each side of a pixel.
            **fields: `contrast` and the further attributes.

        Raises:
            ValueError: if the surface is not oriented outwards, or reaches the source.
        """
        if carm is None:
            carm = CArm.view("AP").centred_on(vertices)
        paths = _paths(carm, vertices, faces, supersample)
        return cls(carm, *paths, **fields)

    def around(self, surface: Surface, supersample: int = 3) -> "Fluoroscope":
        """The same view of a lumen whose surface has moved."""
        paths = _paths(self.carm, surface.vertices, surface.faces, supersample)
        return replace(self, vessel=paths[0], vessel_mask=paths[1])

    @cached_property
    def signal(self) -> np.ndarray:
        """(rows, columns) float32, signal behind patient and vessel, no device."""
        vessel = materials.IODINE * self.contrast * self.vessel
        signal = detector.transmission(vessel)
        signal.flags.writeable = False
        return signal

    @property
    def quanta(self) -> float:
        """Mean number of quanta on a pixel behind plain tissue in one frame."""
        return detector.quanta_per_pixel(self.carm.pitch, self.kerma)

    def render(
        self,
        points: ArrayLike,
        radius: ArrayLike,
        random_state: RandomStates | None = None,
    ) -> np.ndarray:
        """Images of a device in the vessel.

        Args:
            points: (..., n, 3) joints of the device from base to tip, world frame, m.
            radius: m, one number, one per device (...,), or per link (..., n - 1).
            random_state: source of quantum noise: one state, or one per frame in the
                order of the flattened batch; None for an image without noise.

        Returns:
            (..., rows, columns, 1) uint8, dark = opaque. A batch equals its frames
            rendered one by one, bit for bit.

        Raises:
            ValueError: if shapes do not match (see `device_attenuation`).
        """
        return self.image([Shadow(np.asarray(points), radius)], random_state)

    def image(
        self, shadows: Sequence[Shadow], random_state: RandomStates | None = None
    ) -> np.ndarray:
        """Images of devices in the vessel, whose optical depths add up.

        Args:
            shadows: of one device, or of several in each other, with the same leading
                axes.

        Returns:
            (..., rows, columns, 1) uint8, as `render`.
        """
        depth = self._depth(shadows[0])
        for shadow in shadows[1:]:
            depth += self._depth(shadow)
        batch, shape = depth.shape[:-2], self.carm.resolution
        depth = depth.reshape(-1, *shape)
        states = random_state
        if states is not None and not isinstance(states, np.random.RandomState):
            states = list(states)
            if len(states) != len(depth):
                raise ValueError(
                    f"{len(states)} random states for {len(depth)} frames; give "
                    "one, or one per frame."
                )
        image = np.empty(depth.shape, dtype=np.uint8)
        for start in range(0, len(depth), _CHUNK):
            part = slice(start, start + _CHUNK)
            of_part = states[part] if isinstance(states, list) else states
            image[part] = self._developed(depth[part], of_part)
        return image.reshape(*batch, *shape, 1)

    def _depth(self, shadow: Shadow) -> np.ndarray:
        """Optical depth (..., rows, columns) of a device."""
        points = np.asarray(shadow.points, dtype=np.float64)
        material = shadow.mu, shadow.marker_mu, shadow.marker_length
        return device_attenuation(self.carm, points, shadow.radius, *material)

    def _developed(self, depth: np.ndarray, states) -> np.ndarray:
        """Grey images of optical depths (B, rows, columns); `depth` is used up."""
        np.negative(depth, out=depth)
        signal = np.exp(depth, out=depth)
        signal *= self.signal
        if states is not None:
            signal = detector.quantum_noise(signal, self.quanta, states)
        signal = detector.blurred(signal, self.blur / self.carm.pitch)
        if self.roadmap > 0.0:
            signal = signal * self._roadmap_gain
        return detector.grey(signal, self.gain)

    @cached_property
    def _roadmap_gain(self) -> np.ndarray:
        return detector.roadmap_gain(self.vessel_mask, self.roadmap, self.gain)

    def device_mask(self, shadows: Sequence[Shadow]) -> np.ndarray:
        """Pixels (..., rows, columns) bool that show one of several devices."""
        return np.any([self._shows(shadow) for shadow in shadows], axis=0)

    def _shows(self, shadow: Shadow) -> np.ndarray:
        thickness = device_thickness(self.carm, shadow.points, shadow.radius)
        radii = np.asarray(shadow.radius, dtype=np.float64)
        if radii.ndim == np.ndim(shadow.points) - 1:
            # A chain of unlike links is seen where its thinnest link would be.
            radii = np.asarray(radii.min(axis=-1))
        arm, diameter = self.carm, 2.0 * radii[..., None, None]
        width = diameter * arm.focal_length / arm.source_isocentre
        return thickness >= MASK_SHARE * diameter * np.minimum(width, 1.0)


def _paths(
    carm: CArm, vertices: ArrayLike, faces: ArrayLike, supersample: int
) -> tuple[np.ndarray, np.ndarray]:
    """Path length through the lumen, and pixels whose central ray meets it."""
    central = surface_thickness(carm, vertices, faces, 1)
    return surface_thickness(carm, vertices, faces, supersample), central > 0.0
