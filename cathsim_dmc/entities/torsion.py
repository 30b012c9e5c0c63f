"""Twist of coaxial devices: a one-dimensional rod along each of them.

The nodes of a rod are those of the chain when the device reaches its end. The rotary
unit holds node 0; the last node is the device's end. A segment has the torque
GJ/l (Δφ + τ Δφ'), as the torsion hinges of a single catheter have. The rod has no
inertia: it is in equilibrium with its loads at the end of every control step.
"""

from collections.abc import Sequence

import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.entities.device import Device

# Rate of rotation below which Coulomb friction is viscous, rad/s; a sticking device
# creeps more slowly.
STICKING = 0.02
# Largest number of iterations that find the sticking nodes; two or three are usual.
_ROUNDS = 5


class Rods:
    """The rods of K devices in N simulations.

    Attributes:
        stiffness: (K, M), torsional stiffness of the M segments, N·m/rad.
    """

    def __init__(
        self, devices: Sequence[Device], nodes: np.ndarray, relaxation_times: np.ndarray
    ):
        """Computes the stiffness of the segments.

        Args:
            nodes: (M + 1,), distances of the nodes from a device's end, from proximal
                to distal, m; the last one is 0.
            relaxation_times: (K,), relaxation times τ, s.
        """
        self._nodes, self._relaxation_times = nodes, relaxation_times
        tips = np.minimum(nodes, [[device.tip_length] for device in devices])
        in_tips = -np.diff(tips)
        in_shafts = -np.diff(nodes) - in_tips
        # Twist per torque of a segment, ∫ds/GJ.
        in_tips /= [[device.tip.torsional_stiffness] for device in devices]
        in_shafts /= [[device.shaft.torsional_stiffness] for device in devices]
        self.stiffness = 1 / (in_tips + in_shafts)

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
        lag, least = self._relaxation_times / duration, STICKING * duration
        given = np.ascontiguousarray(angles), turned, self.stiffness, lag, least
        return _turned(*given, duration, loads)

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
        return _at_joints(np.ascontiguousarray(angles), gaps, self._nodes)

    def at_nodes(self, loads: np.ndarray, gaps: np.ndarray) -> np.ndarray:
        """Loads on the nodes, from loads at the joints of the chain.

        Args:
            loads: (F, N, K, J), F kinds of loads at the joints.
            gaps: (N, K), distance from the end of each device to that of the chain, m.

        Returns:
            (F, N, K, M), loads on the nodes except the base; the nodes on both sides of
            a joint share its load.
        """
        return _at_nodes(loads, gaps, self._nodes)

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
        slipped = angles[..., 1] + np.clip(lead, -most, most)
        held = np.where(np.abs(lead) > most, slipped, angles[..., 0])
        return np.abs(angles[..., 0] - held), held

    def base_torque(self, angles: np.ndarray) -> np.ndarray:
        """Torque (N, K) of the rotary units on the devices at rest, N·m."""
        return -self.stiffness[:, 0] * np.diff(angles[..., :2], axis=-1)[..., 0]


@compiled
def _on_rod(joint, gap, nodes, first):
    """Segment of a rod, from `first` on, with a joint; the fraction before it."""
    place = max(nodes[joint + 1] - gap, 0.0)
    while first < len(nodes) - 2 and nodes[first + 1] > place:
        first += 1
    return first, (nodes[first] - place) / (nodes[first] - nodes[first + 1])


@compiled
def _at_joints(angles, gaps, nodes):
    """Rotations (N, K, J) at the joints of the chain, see `Rods.at_joints`."""
    (count, devices), joints = gaps.shape, len(nodes) - 2
    turns = np.empty((count, devices, joints))
    for i in range(count):
        for k in range(devices):
            first = 0
            for j in range(joints):
                first, share = _on_rod(j, gaps[i, k], nodes, first)
                near, far = angles[i, k, first], angles[i, k, first + 1]
                turns[i, k, j] = near + share * (far - near)
    return turns


@compiled
def _at_nodes(loads, gaps, nodes):
    """Loads (F, N, K, M) on the nodes distal of the base, see `Rods.at_nodes`."""
    kinds, count, devices, joints = loads.shape
    shared = np.zeros((kinds, count, devices, joints + 1))
    for i in range(count):
        for k in range(devices):
            first = 0
            for j in range(joints):
                first, share = _on_rod(j, gaps[i, k], nodes, first)
                for kind in range(kinds):
                    load = loads[kind, i, k, j]
                    shared[kind, i, k, first] += share * load
                    if first > 0:
                        shared[kind, i, k, first - 1] += (1 - share) * load
    return shared


@compiled
def _balance(diagonal, beside, load, pivot, move):
    """Solves a symmetric, diagonally dominant, tridiagonal system."""
    last = len(load) - 1
    for m in range(last + 1):
        pivot[m], move[m] = diagonal[m], load[m]
        if m > 0:
            factor = beside[m - 1] / pivot[m - 1]
            pivot[m] -= factor * beside[m - 1]
            move[m] -= factor * move[m - 1]
    move[last] /= pivot[last]
    for m in range(last - 1, -1, -1):
        move[m] = (move[m] - beside[m] * move[m + 1]) / pivot[m]


@compiled
def _balance_sticking(diagonal, beside, load, friction, least, move):
    """Balance with Coulomb friction: each node sticks, or slides in one direction.

    Newton's method on the friction law, which is linear up to `least`, the largest
    movement of a sticking node. The last iterate is the result.
    """
    count = len(load)
    way = np.zeros(count)
    stiff, pull, pivot = np.empty(count), np.empty(count), np.empty(count)
    for _ in range(_ROUNDS):
        for m in range(count):
            sticks = friction[m] / least if way[m] == 0.0 else 0.0
            stiff[m] = diagonal[m] + sticks
            pull[m] = load[m] - friction[m] * way[m]
        _balance(stiff, beside, pull, pivot, move)
        settled = True
        for m in range(count):
            found = np.sign(move[m]) if abs(move[m]) > least else 0.0
            if found * way[m] < 0.0:
                found = 0.0
            if found != way[m]:
                settled, way[m] = False, found
        if settled:
            return


@compiled
def _turned(angles, base, stiffness, lag, least, duration, loads):
    """Rotations of rods after a rotation of their bases, see `Rods.turn`."""
    count, devices, nodes = angles.shape
    segments = nodes - 1
    new = np.empty_like(angles)
    diagonal, beside = np.empty(segments), np.empty(segments)
    load, move = np.empty(segments), np.empty(segments)
    for i in range(count):
        for k in range(devices):
            for m in range(segments):
                now = stiffness[k, m] * (angles[i, k, m + 1] - angles[i, k, m])
                coupling = (1 + lag[k]) * stiffness[k, m]
                load[m] = loads[0, i, k, m] - now
                # A negative rate has no equilibrium nearby; there the torque is
                # explicit, and the damping of the rod bounds the speed.
                rate = max(loads[1, i, k, m], 0.0)
                diagonal[m] = coupling + rate + loads[3, i, k, m] / duration
                if m == 0:
                    load[0] += coupling * base[i, k]
                else:
                    load[m - 1] += now
                    diagonal[m - 1] += coupling
                    beside[m - 1] = -coupling
            _balance_sticking(diagonal, beside, load, loads[2, i, k], least, move)
            new[i, k, 0] = angles[i, k, 0] + base[i, k]
            for m in range(segments):
                new[i, k, m + 1] = angles[i, k, m + 1] + move[m]
    return new
