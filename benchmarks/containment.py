"""Containment of a device in the lumen or the introducer sheath."""

import dataclasses

import numpy as np

from cathsim_dmc.anatomy import Anatomy

# Spacing of the sample points along the device, m: about a device radius, so that no
# excursion of the size of the device is missed between two of them.
SPACING = 1e-3


def points_along(centreline: np.ndarray, spacing: float = SPACING) -> np.ndarray:
    """Points along the links of a device.

    Args:
      centreline: (..., L + 1, 3), proximal ends of the links and the head, m.
      spacing: largest distance between neighbouring points, m.

    Returns:
      (..., P, 3): both ends of every link and points evenly between them.

    Raises:
      ValueError: if there is no link, or the spacing is not positive.
    """
    centreline = np.asarray(centreline, dtype=np.float64)
    if centreline.ndim < 2 or centreline.shape[-2] < 2 or centreline.shape[-1] != 3:
        raise ValueError(
            f"centreline has shape {centreline.shape}; give (..., L + 1, 3), L >= 1"
        )
    if not spacing > 0:
        raise ValueError(f"spacing is {spacing} m; it must be > 0")
    lengths = np.linalg.norm(np.diff(centreline, axis=-2), axis=-1)
    # Links are rigid, so the first of a batch gives the division of all.
    counts = np.ceil(lengths.reshape(-1, lengths.shape[-1])[0] / spacing)
    counts = np.maximum(counts.astype(int), 1)
    link = np.repeat(np.arange(len(counts)), counts)
    along = np.concatenate([np.arange(count) / count for count in counts])[:, None]
    points = (1 - along) * centreline[..., link, :] + along * (
        centreline[..., link + 1, :]
    )
    return np.concatenate([points, centreline[..., -1:, :]], axis=-2)


@dataclasses.dataclass(frozen=True)
class Containment:
    """Lumen and sheath that hold a device.

    Attributes:
      anatomy: anatomy with lumen and inlet.
      device_radius: outer radius of the device, m.
      bore_radius: bore radius of the sheath, m.
      axis: (3,), unit direction of the sheath, world frame.
    """

    anatomy: Anatomy
    device_radius: float
    bore_radius: float
    axis: np.ndarray

    @classmethod
    def of(cls, task) -> "Containment":
        """Containment of the device of a `tasks.navigation.Navigation`."""
        return cls(
            task.scene.anatomy,
            task.scene.catheter.device.outer_radius,
            task.scene.sheath.bore_radius,
            task.scene.placement.direction,
        )

    def excess(self, points: np.ndarray) -> np.ndarray:
        """Protrusion of the device from the lumen and the sheath, m.

        For the lumen it is the device's radius minus the depth of the point. For the
        sheath it is the protrusion of the device's side beyond the bore. Before the
        inlet the smaller one counts, so a device that is in neither is detected.

        Args:
          points: (..., 3) on the axis of the device, m, world frame.

        Returns:
          (...), m; at most 0 where the device is inside.
        """
        points = np.asarray(points, dtype=np.float64)
        in_lumen = self.device_radius - self.anatomy.lumen(points)
        offset = points - self.anatomy.inlet.position
        lateral = np.linalg.norm(np.cross(offset, self.axis), axis=-1)
        in_sheath = lateral + self.device_radius - self.bore_radius
        before = offset @ self.anatomy.inlet.direction <= 0
        return np.where(before, np.minimum(in_lumen, in_sheath), in_lumen)

    def largest_excess(self, centreline: np.ndarray) -> np.ndarray:
        """Largest excess (...) along a device's centreline (..., L + 1, 3), m."""
        return self.excess(points_along(centreline)).max(-1)
