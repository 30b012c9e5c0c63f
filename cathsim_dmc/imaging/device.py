"""Shadow of a slender device: path length or optical depth, frame by frame.

A device is a polyline with a radius: a chain of capsules. Its shadow is drawn with
sub-pixel accuracy even when it is thinner than a pixel, and keeps its weight: summed
over the image, thickness times pixel area is the volume of the device, wherever it
moves and however it turns.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.imaging import kernel, materials
from cathsim_dmc.imaging.carm import CArm


@dataclass(frozen=True, eq=False)
class Shadow:
    """A device, or one of several coaxial ones, in the beam.

    Attributes:
        points: (..., n, 3) joints from base to tip, world frame, m.
        radius: as in `device_thickness`.
        mu: excess attenuation, homogenised over its cross-section, 1/m.
        marker_mu: that of the marker at its tip, 1/m; None for no marker.
        marker_length: of the marker, m, measured back from the tip.
    """

    points: np.ndarray
    radius: ArrayLike
    mu: float = materials.CATHETER
    marker_mu: float | None = materials.MARKER
    marker_length: float = materials.MARKER_LENGTH

    def of(self, rows: np.ndarray) -> "Shadow":
        """The shadows of some frames of a batch; the radius is the same for all."""
        return replace(self, points=self.points[rows])


def device_thickness(
    carm: CArm,
    points: ArrayLike,
    radius: ArrayLike,
) -> np.ndarray:
    """Path length through a device, averaged over each pixel.

    Args:
        points: (..., n, 3) joints of the device from its base to its tip, world
            frame, m, n >= 2.
        radius: its radius, m: one number, one per device (...,), or one per link
            (..., n - 1).

    Returns:
        (..., rows, columns) float32, m. Overlaps add up; the two ends of the chain
        are round, drawn as a cylinder of the volume of a hemisphere. Links with a
        joint that is not finite or not in front of the source are left out.

    Raises:
        ValueError: if shapes do not match, a radius is not positive, or a shadow is
            wider than 256 pixels.
    """
    return device_attenuation(carm, points, radius, mu=1.0)


def device_attenuation(
    carm: CArm,
    points: ArrayLike,
    radius: ArrayLike,
    mu: float,
    marker_mu: float | None = None,
    marker_length: float = 0.0,
) -> np.ndarray:
    """Optical depth of a device with a marker at its tip, averaged over each pixel.

    Args:
        mu: attenuation of the device, homogenised over its cross-section, 1/m.
        marker_mu: attenuation of the marker, 1/m; None for a device without one.
        marker_length: length of the marker, m, measured back from the tip.

    Returns:
        (..., rows, columns) float32, no unit.

    Raises:
        ValueError: as in `device_thickness`.
    """
    points, radius, batch = _chain(points, radius)
    if marker_mu is None:
        marker_mu, marker_length = mu, 0.0
    image = np.zeros((len(points), *carm.resolution), dtype=np.float32)
    with np.errstate(invalid="ignore"):  # joints that are not finite
        camera = carm.camera(points)
    widest = kernel.add_devices(
        image,
        camera,
        radius,
        carm.focal_length,
        float(mu),
        float(marker_mu),
        float(marker_length),
    )
    if widest > kernel.WIDEST:
        raise ValueError(
            f"a shadow is {widest:.0f} px in radius; at most {kernel.WIDEST} can be "
            "drawn. Lower the resolution or magnification, or check the radius "
            "(metres)."
        )
    return image.reshape(*batch, *carm.resolution)


def _chain(points: ArrayLike, radius: ArrayLike):
    """Points (B, n, 3), radii (B, n - 1) and the batch shape."""
    points = np.asarray(points, dtype=np.float64)
    if points.ndim < 2 or points.shape[-1] != 3 or points.shape[-2] < 2:
        raise ValueError(
            f"points have shape {points.shape}; give (..., n, 3) with n >= 2."
        )
    batch, links = points.shape[:-2], points.shape[-2] - 1
    radius = np.asarray(radius, dtype=np.float64)
    per_link = radius.ndim == points.ndim - 1
    # Filled in, and not a broadcast view: what is compiled is compiled again for
    # another kind of array.
    radii = np.empty((*batch, links))
    try:
        radii[...] = radius if per_link else radius[..., None]
    except ValueError:
        raise ValueError(
            f"radius has shape {radius.shape}; for points {points.shape} give one "
            f"number, {batch} or {(*batch, links)}."
        ) from None
    if not (radii > 0.0).all():
        raise ValueError(f"the smallest radius is {radii.min():g} m; it must be > 0.")
    return points.reshape(-1, links + 1, 3), radii.reshape(-1, links), batch
