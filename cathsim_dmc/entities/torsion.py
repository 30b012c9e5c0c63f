"""Twist of coaxial devices: a one-dimensional rod along each of them.

The nodes of a rod are those of the chain when the device reaches its end. The rotary
unit holds node 0; the last node is the device's end. A segment has the torque
GJ/l (Δφ + τ Δφ'), as the torsion hinges of a single catheter have. The rod has no
inertia: it is in equilibrium with its loads at the end of every control step.
"""

from collections.abc import Sequence

import numpy as np

from cathsim_dmc.entities.device import Device

# Rate of rotation below which Coulomb friction is viscous, rad/s; a sticking device
# creeps more slowly.
STICKING = 0.02


class Rods:
    """The rods of K devices in N simulations.

    Attributes:
        stiffness: (K, M), torsional stiffness of the M segments, N·m/rad.
    """

    def __init__(
        self,
        devices: Sequence[Device],
        nodes: np.ndarray,
        relaxation_times: np.ndarray,
    ):
        """Computes the stiffness of the segments.

        Args:
            nodes: (M + 1,), distances of the nodes from a device's end, from proximal
                to distal, m; the last one is 0.
            relaxation_times: (K,), relaxation times τ, s.
        """
        from cathsim_dmc.entities import torsion_loops  # imports numba, which is slow

        self._loops = torsion_loops
        self._nodes = nodes
        self._relaxation_times = relaxation_times
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
        """Rotates the bases and returns the equilibrium of the rods.

        Args:
            angles: (N, K, M + 1), rotation of the nodes, rad.
            turned: (N, K), rotations of the bases, rad.
            duration: duration of that rotation, s.
            torque: (N, K, M), torque on the nodes except the base, N·m.
            rate: (N, K, M), minus its derivative by the rotation, N·m/rad.
            friction: (N, K, M), largest torque of Coulomb friction, N·m.
            brake: (N, K, M), torque per rate of rotation, N·m·s/rad.

        Returns:
            (N, K, M + 1), rotation of the nodes, rad.
        """
        loads = np.empty((4, *angles.shape[:-1], angles.shape[-1] - 1))
        loads[0], loads[1], loads[2], loads[3] = torque, rate, friction, brake
        return self._loops.turned(
            np.ascontiguousarray(angles),
            turned,
            self.stiffness,
            self._relaxation_times / duration,
            STICKING * duration,
            duration,
            loads,
        )

    def at_joints(self, angles: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """Rotations of the devices at the joints of the chain.

        The rotation is linear between two nodes; a joint beyond a device's end has that
        of the end.

        Args:
            angles: (N, K, M + 1), rotation of the nodes, rad.
            gaps: (N, K), distance from the end of each device to that of the chain, m.

        Returns:
            (N, K, J), rad; the J = M - 1 joints are the inner nodes of a device that
            reaches the end of the chain.
        """
        return self._loops.at_joints(np.ascontiguousarray(angles), gaps, self._nodes)

    def at_nodes(self, loads: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """Loads on the nodes, from loads at the joints of the chain.

        Args:
            loads: (F, N, K, J), F kinds of loads at the joints.
            gaps: (N, K), distance from the end of each device to that of the chain, m.

        Returns:
            (F, N, K, M), loads on the nodes except the base; the nodes on both sides of
            a joint share its load.
        """
        return self._loops.at_nodes(loads, gaps, self._nodes)

    def slip(self, angles: np.ndarray, torque: float) -> tuple[np.ndarray, np.ndarray]:
        """Bases whose clamps slip at a torque.

        Args:
            angles: (N, K, M + 1), rotation of the nodes, rad.
            torque: of slip, N·m.

        Returns:
            Way (N, K) of the slip, and rotation (N, K) of the bases after it, rad.
        """
        most = torque / self.stiffness[:, 0]
        lead = angles[..., 0] - angles[..., 1]
        held = np.where(
            np.abs(lead) > most,
            angles[..., 1] + np.clip(lead, -most, most),
            angles[..., 0],
        )
        return np.abs(angles[..., 0] - held), held

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
