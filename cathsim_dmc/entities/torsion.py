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
# Most rounds in which it is found which nodes stick; two or three are usual.
_ROUNDS = 5


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
        from scipy.linalg import lapack  # late, as all that takes long to import

        self._solve = lapack.dptsv
        self._relaxation_time = relaxation_time
        self.stiffness = np.stack([1 / _twist(device, nodes) for device in devices])

    def turn(
        self,
        angles: np.ndarray,
        turned: np.ndarray,
        duration: float,
        torque: np.ndarray | float = 0.0,
        rate: np.ndarray | float = 0.0,
        friction: np.ndarray | None = None,
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
        stiffness, lag = self.stiffness, self._relaxation_time / duration
        now = stiffness * np.diff(angles, axis=-1)  # torque of the segments at rest
        coupling = np.broadcast_to((1 + lag) * stiffness, now.shape)
        load = (
            np.concatenate([now[..., 1:] - now[..., :-1], -now[..., -1:]], axis=-1)
            + torque
        )
        load[..., 0] += coupling[..., 0] * turned
        # Where the torque grows with the rotation it is taken as it is: no balance is
        # near, and the rod's own damping bounds the speed.
        diagonal = coupling + np.maximum(rate, 0.0) + brake / duration
        diagonal[..., :-1] += coupling[..., 1:]
        beside = -coupling
        beside = np.concatenate(
            [beside[..., 1:], np.zeros_like(beside[..., :1])], axis=-1
        )
        if friction is None or not friction.any():
            move = self._balance(diagonal, beside, load)
        else:
            move = self._rubbed(diagonal, beside, load, friction, STICKING * duration)
        new = angles.copy()
        new[..., 0] += turned
        new[..., 1:] += move
        return new

    def _rubbed(
        self,
        diagonal: np.ndarray,
        beside: np.ndarray,
        load: np.ndarray,
        friction: np.ndarray,
        least: float,
    ) -> np.ndarray:
        """Balance with Coulomb friction: each node sticks, or slides one way.

        Which one is found by trying (Newton's method on the law of friction, which is
        linear up to `least`, what a node that sticks may move); what was tried last
        stands.
        """
        way = np.zeros_like(load)  # +1 and -1 where a node slides, 0 where it sticks
        move = way
        for _ in range(_ROUNDS):
            sticks = np.where(way == 0.0, friction / least, 0.0)
            move = self._balance(diagonal + sticks, beside, load - friction * way)
            found = np.where(np.abs(move) > least, np.sign(move), 0.0)
            found[found * way < 0.0] = 0.0
            if (found == way).all():
                break
            way = found
        return move

    def _balance(
        self, diagonal: np.ndarray, beside: np.ndarray, load: np.ndarray
    ) -> np.ndarray:
        """Solves the tridiagonal systems of all rods, one after the other in a row."""
        move, status = self._solve(diagonal.ravel(), beside.ravel()[:-1], load.ravel())[
            2:
        ]
        if status:
            raise RuntimeError(f"the twist of a device has no solution ({status})")
        return move.reshape(load.shape)

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
