"""Points of a device with given joints, and their depths in the walls."""

from typing import NamedTuple

import numpy as np

from cathsim_dmc.entities.posture import nodes_of
from cathsim_dmc.laws.field import FREE
from cathsim_dmc.tasks.placement import matrix_of
from cathsim_dmc.tasks.scene import AROUND_SHEATH, Scene

_SAMPLES = 0.5e-3  # m, between points of a posture whose depth is checked
_GUIDED = 0.02  # m of the shaft in the sheath that are checked, as they may turn


class Joints(NamedTuple):
    """Insertion, m, and angles (n - 1, 2) of the bending hinges of a device, rad."""

    insertion: float
    bends: np.ndarray


class Shape:
    """A device in its sheath and vessel."""

    def __init__(self, scene: Scene):
        """Takes the device, the field of the vessel and the bore of the sheath."""
        place, lengths = scene.placement, scene.catheter.link_lengths
        self._lengths, self._inlet = lengths, place.inlet
        self._base = place.start_depth - float(np.sum(lengths))
        self._frame = matrix_of(place.quaternion)
        counts = np.ceil(lengths / _SAMPLES).astype(int)
        shares = [np.arange(count) / count for count in counts]
        self._links = np.repeat(np.arange(len(lengths)), counts)
        self._shares = np.concatenate(shares)[:, None]
        self._radius = scene.catheter.device.outer_radius
        self._bore, self._lumen = scene.sheath.bore_radius, scene.anatomy.lumen
        self._hole = self._bore + AROUND_SHEATH
        self._walled = self._lumen.with_hole(self._hole)

    def points(self, joints: Joints, roll: float = 0.0) -> np.ndarray:
        """Points (m, 3) of the axis, m, world frame, the head last.

        Args:
            joints: Joints of the device.
            roll: Rotation of the base about its axis, rad.
        """
        nodes = nodes_of(self._lengths, joints.bends) @ about_z(roll).T
        nodes += (0.0, 0.0, self._base + joints.insertion)
        along = np.diff(nodes, axis=0)[self._links]
        points = np.vstack([nodes[self._links] + self._shares * along, nodes[-1:]])
        return self._inlet + points @ self._frame.T

    def depths(self, points: np.ndarray) -> np.ndarray:
        """Largest depths (2,), m, of points in the walls of vessel and sheath.

        Args:
            points: (m, 3), m, world frame.
        """
        local = (points - self._inlet) @ self._frame
        near = local[:, 2] > -_GUIDED
        points, (x, y, level) = points[near], local[near].T
        clear, guided = self._walled(points, free=True), level <= 0.0
        bore = self._bore - np.hypot(x[guided], y[guided])
        # A vessel may bend back beside the sheath.
        inside = self._lumen(points[guided])
        bore = np.where(inside > 0.0, np.maximum(bore, inside), bore)
        # Beside the sheath, outside the lumen, the physics has no wall.
        outside = (clear >= FREE) & (level > self._hole)
        clear[outside] = self._lumen(points[outside])
        return self._radius - np.array([clear.min(), bore.min(initial=np.inf)])


def about_z(angle: float) -> np.ndarray:
    """Matrix (3, 3) of a rotation about z, rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
