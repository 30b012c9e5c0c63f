"""Fluoroscopy: the X-ray image that an operator sees, computed without OpenGL.

The path length through vessel and patient is computed once per anatomy and view
(`Fluoroscope.from_surface`); the device is drawn in every frame (`Fluoroscope.render`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging import detector, materials
from cathsim_dmc.imaging.carm import CArm
from cathsim_dmc.imaging.device import Shadow, device_attenuation
from cathsim_dmc.imaging.thickness import surface_thickness

# A pixel shows the device if the path through it is at least this share of its
# diameter: half the pixel covered to half the depth. Of a device thinner than a pixel,
# whose path is averaged over the pixel, it is that share of its width in pixels.
MASK_SHARE = 0.25

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
        kerma, blur, gain, roadmap: Gy, m and two fractions, see `FluoroscopyOptions`.
        overlay: (rows, columns) bool, vessel of the roadmap; None for `vessel_mask`.
    """

    carm: CArm
    vessel: np.ndarray
    vessel_mask: np.ndarray
    contrast: float = materials.CONTRAST
    kerma: float = detector.FRAME_KERMA
    blur: float = detector.DETECTOR_BLUR
    gain: float = detector.GAIN
    roadmap: float = 0.0
    overlay: np.ndarray | None = None

    @classmethod
    def from_surface(
        cls, surface: Surface, carm: CArm | None = None, **fields
    ) -> "Fluoroscope":
        """Fluoroscope of a lumen: the static part, once per anatomy and view.

        Args:
            surface: of the lumen, world frame, m, without open ends.
            carm: the view; by default AP with the isocentre in the middle of the
                surface.
            **fields: `contrast` and the further attributes.

        Raises:
            ValueError: if the surface is not oriented outwards, or reaches the source.
        """
        if carm is None:
            carm = CArm.view("AP").centred_on(surface.vertices)
        central = surface_thickness(carm, surface, 1)
        path = surface_thickness(carm, surface)
        return cls(carm, path, central > 0.0, **fields)

    def around(self, surface: Surface) -> "Fluoroscope":
        """The same view of a lumen whose surface has moved; the roadmap stays."""
        moved = Fluoroscope.from_surface(surface, self.carm)
        own = {"vessel": moved.vessel, "vessel_mask": moved.vessel_mask}
        return replace(self, **own, overlay=self._overlay)

    @property
    def _overlay(self) -> np.ndarray:
        return self.vessel_mask if self.overlay is None else self.overlay

    @cached_property
    def signal(self) -> np.ndarray:
        """(rows, columns) float32, signal behind patient and vessel, no device."""
        # Beer-Lambert: the share of quanta that pass.
        path = np.asarray(self.vessel, np.float32)
        return np.exp(-materials.IODINE * self.contrast * path)

    @cached_property
    def empty(self) -> np.ndarray:
        """(rows, columns) uint8, the image without a device and without noise."""
        return self._developed(np.zeros((1, *self.carm.resolution)), None)[0]

    @property
    def quanta(self) -> float:
        """Mean number of quanta on a pixel behind plain tissue in one frame."""
        return detector.QUANTA_PER_KERMA * self.kerma * self.carm.pitch**2

    def render(
        self, shadows: Sequence[Shadow], random_states: RandomStates | None = None
    ) -> np.ndarray:
        """Images of devices in the vessel, whose optical depths add up.

        Args:
            shadows: of one device, or of several coaxial ones, with the same leading
                axes.
            random_states: source of quantum noise: one state, or one per frame in the
                order of the flattened batch; None for images without noise.

        Returns:
            (..., rows, columns, 1) uint8, dark = opaque. A batch equals its frames
            rendered one by one, bit for bit.

        Raises:
            ValueError: if shapes do not match (see `device_attenuation`).
        """
        depth = device_attenuation(self.carm, shadows[0])
        for shadow in shadows[1:]:
            depth += device_attenuation(self.carm, shadow)
        frames = depth.reshape((-1, *self.carm.resolution))
        if isinstance(random_states, np.random.RandomState):
            random_states = [random_states] * len(frames)
        return self._developed(frames, random_states).reshape((*depth.shape, 1))

    def _developed(
        self, depths: np.ndarray, states: Sequence[np.random.RandomState] | None
    ) -> np.ndarray:
        """Grey images (B, rows, columns) of optical depths of devices."""
        signal = np.exp(-depths) * self.signal
        if states is not None:
            signal = detector.quantum_noise(signal, self.quanta, states)
        signal = detector.blurred(signal, self.blur / self.carm.pitch)
        if self.roadmap > 0.0:
            signal = signal * self._roadmap_gain
        return detector.grey(signal, self.gain)

    @cached_property
    def _roadmap_gain(self) -> np.ndarray:
        # A factor, not a blend, so that a device in the vessel keeps its contrast.
        white = 1.0 + self.roadmap * (1.0 / self.gain - 1.0)
        return np.where(self._overlay, white, 1.0).astype(np.float32)

    def device_mask(self, shadows: Sequence[Shadow]) -> np.ndarray:
        """Pixels (..., rows, columns) bool that show one of several devices."""
        shows = []
        for shadow in shadows:
            plain = replace(shadow, mu=1.0, marker_mu=None)
            radii = np.asarray(shadow.radius, dtype=np.float64)
            if radii.ndim == np.ndim(shadow.points) - 1:
                # A chain of unlike links is seen where its thinnest link would be.
                radii = np.asarray(radii.min(axis=-1))
            diameter = 2.0 * radii[..., None, None]
            width = diameter * self.carm.focal_length / self.carm.source_isocentre
            least = MASK_SHARE * diameter * np.minimum(width, 1.0)
            shows.append(device_attenuation(self.carm, plain) >= least)
        return np.any(shows, axis=0)
