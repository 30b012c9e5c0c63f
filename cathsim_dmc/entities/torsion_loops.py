"""Twist of coaxial devices: compiled loops over simulations, devices and nodes.

`torsion` calls them. Arrays are as in `coaxial_loops`; a rod has M + 1 = J + 2 nodes,
of which 0 is its base.
"""

import numpy as np

from cathsim_dmc.compiled import compiled

# Largest number of iterations that find the sticking nodes; two or three are usual.
_ROUNDS = 5


@compiled
def _on_rod(joint, gap, nodes, first):
    """Segment of a rod, from `first` on, with a joint; the fraction before it."""
    place = max(nodes[joint + 1] - gap, 0.0)
    while first < len(nodes) - 2 and nodes[first + 1] > place:
        first += 1
    return first, (nodes[first] - place) / (nodes[first] - nodes[first + 1])


@compiled
def at_joints(angles, gaps, nodes):
    """Rotations (N, K, J) at the joints of the chain, see `Rods.at_joints`."""
    count, devices = gaps.shape
    joints = len(nodes) - 2
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
def at_nodes(loads, gaps, nodes):
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
def turned(angles, base, stiffness, lag, least, duration, loads):
    """Equilibrium rotations of rods after a rotation of their bases, see `Rods.turn`.

    Args:
        angles: (N, K, M + 1), rad.
        base: (N, K), rotations of the bases, rad.
        stiffness: (K, M), torsional stiffness of the segments, N·m/rad.
        lag: (K,), relaxation times divided by the duration.
        least: largest movement of a sticking node, rad.
        duration: s.
        loads: (4, N, K, M): torque, rate, friction and brake on the nodes.

    Returns:
        (N, K, M + 1), rad.
    """
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
