"""Twist of coaxial devices: a one-dimensional rod along each of them.

The rod of a device has a node wherever the chain has one when the device reaches to its
end; node 0 is held by the rotary unit, the last one is the device's end. A segment has
the torque GJ/l (Δφ + τ Δφ'), as the torsion hinges of a single catheter do, and there
is no inertia: between two control steps the rod is in balance with what acts on it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cathsim_dmc.entities.device import Device

# Rate of turning below which Coulomb friction is taken for viscous, rad/s: a device
# that sticks creeps by less than this.
STICKING = 0.02


class Rods:
    """The rods of K devices in N simulations.

    Attributes:
      stiffness: (K, M), torsional stiffness of the M segments, N·m/rad.
    """

    def __init__(
        self, devices: Sequence[Device], nodes: np.ndarray, relaxation_time: float
    ):
        """Finds the stiffness of the segments.

        Args:
          devices: K devices.
          nodes: (M + 1,), distance of the nodes from a device's end, m, from proximal
            to distal, 0 the last.
          relaxation_time: τ, s.
        """
        from cathsim_dmc.entities import coaxial_loops  # late, as it takes long

        self._loops = coaxial_loops
        self._nodes = nodes
        self._relaxation_time = relaxation_time
        self.stiffness = np.stack([1 / _twist(device, nodes) for device in devices])

    def turn(
        self,
        angles: np.ndarray,
        turned: np.ndarray,
        duration: float,
        torque: np.ndarray | float = 0.0,
        rate: np.ndarray | float = 0.0,
        friction: np.ndarray | float = 0.0,
        brake: np.ndarray | float = 0.0,
    ) -> np.ndarray:
        """Turns the bases and brings the rods into balance.

        Args:
          angles: (N, K, M + 1), rotation of the nodes, rad.
          turned: (N, K), by how much the bases are turned, rad.
          duration: in which they are, s.
          torque: (N, K, M), on the nodes but the base, N·m.
          rate: likewise, minus the derivative of the torque by the rotation, N·m/rad.
          friction: likewise, largest torque of Coulomb friction, N·m.
          brake: likewise, torque per rate of turning, N·m·s/rad.

        Returns:
          (N, K, M + 1), rad.
        """
        loads = np.empty((4, *angles.shape[:-1], angles.shape[-1] - 1))
        loads[0], loads[1], loads[2], loads[3] = torque, rate, friction, brake
        return self._loops.turned(
            np.ascontiguousarray(angles),
            turned,
            self.stiffness,
            self._relaxation_time / duration,
            STICKING * duration,
            duration,
            loads,
        )

    def at_joints(self, angles: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """Rotations of the devices where the chain has its joints.

        Between two nodes the rotation is linear; a joint beyond a device's end has that
        of the end.

        Args:
          angles: (N, K, M + 1), rotation of the nodes, rad.
          gaps: (N, K), way from the end of each device to the end of the chain, m.

        Returns:
          (N, K, J), rad; the chain has its J = M - 1 joints where a device that reaches
          to its end has its inner nodes.
        """
        return self._loops.at_joints(np.ascontiguousarray(angles), gaps, self._nodes)

    def at_nodes(self, loads: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """Loads on the nodes, of loads at the joints of the chain.

        Args:
          loads: (F, N, K, J), F kinds of loads at the joints.
          gaps: (N, K), m.

        Returns:
          (F, N, K, M), on the nodes but the base: those on both sides of a joint share
          its load.
        """
        return self._loops.at_nodes(loads, gaps, self._nodes)

    def base_torque(self, angles: np.ndarray) -> np.ndarray:
        """Torque (N, K) of the rotary units on the devices at rest, N·m."""
        return -self.stiffness[:, 0] * np.diff(angles[..., :2], axis=-1)[..., 0]


def _twist(device: Device, nodes: np.ndarray) -> np.ndarray:
    """Twist (M,) per torque of the segments between nodes, ∫ds/GJ, rad/(N·m)."""
    in_tip = -np.diff(np.minimum(nodes, device.tip_length))
    in_shaft = -np.diff(nodes) - in_tip
    return (
        in_tip / device.tip.torsional_stiffness
        + in_shaft / device.shaft.torsional_stiffness
    )
