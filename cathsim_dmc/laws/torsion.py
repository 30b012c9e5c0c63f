"""Twist of coaxial devices: a one-dimensional rod along each of them.

The M + 1 nodes of a rod coincide with those of the chain when the device reaches the
chain's end; the rotary unit holds the first node. The rod has no inertia: it is in
equilibrium with its loads at the end of every control step (docs/pair_model.md).

Functions of one simulation; K devices, J = M - 1 joints. `angles` (K, M + 1) are
rotations of the nodes, rad; `gaps` (K,) the distance from the end of each device to
that of the chain, m; `nodes` (M + 1,) distances from a device's end, m.
"""

from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled

# Rate of rotation below which Coulomb friction is viscous, rad/s: a sticking device
# creeps at a lower rate.
STICKING = 0.02
# Largest number of iterations that find the sticking nodes; two or three are usual.
_ROUNDS = 5


class Rods(NamedTuple):
    """The rods of K devices.

    Attributes:
        stiffness: (K, M), torsional stiffness of the segments, N·m/rad.
        times: (K,), relaxation times τ of the materials, s.
    """

    stiffness: Any
    times: Any


class Scratch(NamedTuple):
    """Scratch of `turned`, arrays (M,)."""

    diagonal: Any
    beside: Any
    load: Any
    move: Any
    stiff: Any
    pull: Any
    pivot: Any
    way: Any


@compiled
def _on_rod(joint, gap, nodes, first):
    """Segment of a rod, from `first` on, that holds a joint; its fraction before it."""
    place = max(nodes[joint + 1] - gap, 0.0)
    while first < len(nodes) - 2 and nodes[first + 1] > place:
        first += 1
    return first, (nodes[first] - place) / (nodes[first] - nodes[first + 1])


@compiled
def at_joints(angles, gaps, nodes, turns):
    """Writes rotations (K, J) of the devices at the joints of the chain, rad.

    The rotation is linear between two nodes; a joint beyond a device's end has that of
    the end.
    """
    devices, joints = turns.shape
    for k in range(devices):
        first = 0
        for j in range(joints):
            first, share = _on_rod(j, gaps[k], nodes, first)
            near, far = angles[k, first], angles[k, first + 1]
            turns[k, j] = near + share * (far - near)


@compiled
def at_nodes(loads, gaps, nodes, shared):
    """Writes F kinds of loads (F, K, M) of all nodes but the bases.

    The nodes on both sides of a joint share its load, one of `loads` (F, K, J).
    """
    kinds, devices, joints = loads.shape
    for k in range(devices):
        for kind in range(kinds):
            for m in range(joints + 1):
                shared[kind, k, m] = 0.0
        first = 0
        for j in range(joints):
            first, share = _on_rod(j, gaps[k], nodes, first)
            for kind in range(kinds):
                load = loads[kind, k, j]
                shared[kind, k, first] += share * load
                if first > 0:
                    shared[kind, k, first - 1] += (1 - share) * load


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
def _sign(value, least):
    """Sign of a value, 0 up to the magnitude `least`."""
    if not abs(value) > least:
        return 0.0
    return 1.0 if value > 0.0 else -1.0


@compiled
def _balance_sticking(scratch, friction, least):
    """Solves with Coulomb friction, linear up to `least`, by Newton's method."""
    load, move, way = scratch.load, scratch.move, scratch.way
    stiff, pull, count = scratch.stiff, scratch.pull, len(load)
    for m in range(count):
        way[m] = 0.0
    for _ in range(_ROUNDS):
        for m in range(count):
            sticks = friction[m] / least if way[m] == 0.0 else 0.0
            stiff[m] = scratch.diagonal[m] + sticks
            pull[m] = load[m] - friction[m] * way[m]
        _balance(stiff, scratch.beside, pull, scratch.pivot, move)
        settled = True
        for m in range(count):
            found = _sign(move[m], least)
            if found * way[m] < 0.0:
                found = 0.0
            if found != way[m]:
                settled, way[m] = False, found
        if settled:
            return


@compiled
def turned(angles, base, rods, duration, loads, scratch, new):
    """Writes equilibrium rotations (K, M + 1) of the nodes, rad, for rotated bases.

    Args:
        angles: (K, M + 1), rotations of the nodes before, rad.
        base: (K,), rotations of the bases from there, rad.
        rods: `Rods`.
        duration: duration of that rotation, s.
        loads: (3, K, M) on all nodes but the bases: torque, N·m; its negative
            derivative by the rotation, N·m/rad; limit of the friction torque, N·m.
        scratch: `Scratch`.
        new: (K, M + 1), may be `angles`.
    """
    devices, segments = rods.stiffness.shape
    diagonal, beside, load = scratch.diagonal, scratch.beside, scratch.load
    for k in range(devices):
        lag = rods.times[k] / duration
        for m in range(segments):
            stiffness = rods.stiffness[k, m]
            now = stiffness * (angles[k, m + 1] - angles[k, m])
            coupling = (1 + lag) * stiffness
            load[m] = loads[0, k, m] - now
            # With a negative derivative there is no equilibrium nearby: the torque is
            # explicit, and the damping of the rod bounds the speed.
            diagonal[m] = coupling + max(loads[1, k, m], 0.0)
            if m == 0:
                load[0] += coupling * base[k]
            else:
                load[m - 1] += now
                diagonal[m - 1] += coupling
                beside[m - 1] = -coupling
        _balance_sticking(scratch, loads[2, k], STICKING * duration)
        new[k, 0] = angles[k, 0] + base[k]
        for m in range(segments):
            new[k, m + 1] = angles[k, m + 1] + scratch.move[m]
