"""Coaxial devices in a task: the compiled loops behind `sliding`.

N simulations, K devices, J joints, L links; each simulation on its own.
"""

import numpy as np

from cathsim_dmc.compiled import compiled


@compiled
def held(insertion, reached):
    """Insertions (N, K): the leading devices at (N,), the others as commanded."""
    count, devices = insertion.shape
    where = np.empty((count, devices))
    for i in range(count):
        leader = 0
        for k in range(devices):
            where[i, k] = min(insertion[i, k], reached[i])
            if insertion[i, k] > insertion[i, leader]:
                leader = k
        where[i, leader] = reached[i]
    return where


@compiled
def gaps(insertion):
    """Way (N, K) from the end of each device to that of the chain."""
    count, devices = insertion.shape
    ways = np.empty((count, devices))
    for i in range(count):
        farthest = insertion[i].max()
        for k in range(devices):
            ways[i, k] = farthest - insertion[i, k]
    return ways


@compiled
def advance(before, step, least, most):
    """Where (N, K) the devices are told to go, and the chain's insertion (N,) then, m.

    It cannot be drawn back behind its start.

    Args:
        before: (N, K), insertions, m.
        step: (N, K), by how much they are told to move, m.
        least, most: insertion of a device at least and at most, m.
    """
    count, devices = before.shape
    target, lead = np.empty((count, devices)), np.empty(count)
    for i in range(count):
        leader = 0
        for k in range(devices):
            target[i, k] = min(max(before[i, k] + step[i, k], least), most)
            if target[i, k] > target[i, leader]:
                leader = k
        lead[i] = max(target[i, leader], 0.0)
        target[i, leader] = lead[i]
    return target, lead


@compiled
def rubbing(force, lead, depth, nodes):
    """Size (N, L) of contact forces (N, L, 6) on the links outside the sheath, N.

    Args:
        force: torque and force, MuJoCo's `cfrc_ext`.
        lead: (N,), insertion of the chain, m.
        depth: of the chain's end past the mouth of the sheath at zero insertion, m.
        nodes: (L + 1,), ends of the links from the end of the chain, m.
    """
    count, links = force.shape[:2]
    size = np.zeros((count, links))
    for i in range(count):
        for link in range(links):
            if lead[i] - nodes[link + 1] > -depth:
                x, y, z = force[i, link, 3], force[i, link, 4], force[i, link, 5]
                size[i, link] = np.sqrt(x * x + y * y + z * z)
    return size


@compiled
def points(line, places, nodes):
    """Points (N, K, P, 3) of a chain (N, L + 1, 3) at places (N, K, P) from its end.

    Args:
        line: joints and head, from proximal to distal, m.
        places: m; behind its base the device is straight.
        nodes: (L + 1,), distance of the line's points from the end, m.
    """
    found = np.empty((*places.shape, 3))
    last = len(nodes) - 1
    for i in range(places.shape[0]):
        for k in range(places.shape[1]):
            for p in range(places.shape[2]):
                place = max(places[i, k, p], 0.0)
                # The node behind the place, and the one before it.
                far = last - 1
                while far > 0 and nodes[far] <= place:
                    far -= 1
                share = place - nodes[far + 1]
                share /= nodes[far] - nodes[far + 1]
                for axis in range(3):
                    near = line[i, far + 1, axis]
                    found[i, k, p, axis] = near + share * (line[i, far, axis] - near)
    return found


@compiled
def leading_load(force, line, ways, nodes):
    """Axial force (N,) in the leading device where it leaves the others, N.

    Args:
        force: (N, L, 6), on each link from the one before it, torque and force.
        line: (N, L + 1, 3), m.
        ways: (N, K), from the end of each device to that of the chain, m; K at least 2.
        nodes: (L + 1,), distance of the line's points from the end, m.
    """
    count, links = force.shape[:2]
    load = np.empty(count)
    for i in range(count):
        second = np.sort(ways[i])[1]
        # The one after the link with the place in it: its joint bears what is beyond.
        link = 1
        while link < links - 1 and nodes[link] > second:
            link += 1
        along = line[i, link + 1] - line[i, link]
        borne = length = 0.0
        for axis in range(3):
            borne += force[i, link, 3 + axis] * along[axis]
            length += along[axis] * along[axis]
        load[i] = borne / np.sqrt(length)
    return load
