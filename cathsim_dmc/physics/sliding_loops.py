"""Coaxial devices in a task: the compiled loops behind `sliding`.

N simulations, K devices, J joints, L links; each simulation on its own.
"""

import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.entities import coaxial_loops, torsion
from cathsim_dmc.laws.hinges import Bends, bent, free_hinges
from cathsim_dmc.physics import chain_fields

_GAP_STEP = 1e-8  # m, for a derivative


@compiled
def _lay(made, overlap, turns, hinges, friction, factors, fields):
    (tables, _, _, of_links), _, places = made
    shape = coaxial_loops.rest_angles(overlap.rest, turns)
    rest, joints = np.empty((len(shape), 2)), len(shape)
    scratch = Bends(np.empty(joints, np.complex128), np.empty(joints))
    free_hinges(shape, overlap.compliance, hinges, scratch, rest)
    links = coaxial_loops.links(overlap, tables[1], friction, *of_links)
    chain_fields.write(fields, places, overlap, rest, links, factors)


@compiled
def lay(made, gaps, angles, hinges, friction, factors, fields):
    """Writes the properties of the chain of one simulation; see `settle`."""
    tables = made[0][0]
    overlap = coaxial_loops.overlap(gaps, tables)
    turns = torsion.at_joints(angles, gaps, tables[0])
    _lay(made, overlap, turns, hinges, friction, factors, fields)


@compiled
def settle(
    made, gaps, turned, force, load, state, axial, hinges, friction, factors, fields
):
    """Turns the devices of one simulation and writes the properties of its chain.

    Args:
        made: see `sliding.made`.
        gaps: (K,), way from the end of each device to that of the chain, m.
        turned: (K,), by how much the bases are turned, rad.
        force: (L,), of the wall on the links, N.
        load: axial force in the leading device where it leaves the others, N.
        state: (K, M + 1) rotations of the nodes, rad; (K - 1,) fraction of the friction
            between devices that acts; (K - 1,) that friction, N; (K,) way by which the
            clamps have slipped, rad. All but the second change.
        axial: (K, J), receives the axial forces at the joints, N.
        hinges: (2 J,), positions of the hinges, rad.
        friction: Coulomb coefficient of an uncoated device on the wall.
        factors: (2,), of all stiffnesses, and of all loss factors.
        fields: live `chain_fields.FIELDS` of its model.
    """
    (tables, rods, arms, of_links), (lined, duration, torque), _ = made
    angles, ways, drag, slipped = state
    nodes, lengths, radii = tables[0], tables[1], of_links[0]
    rods = torsion.Rods(factors[0] * rods.stiffness, factors[1] * rods.times)
    overlap = coaxial_loops.overlap(gaps, tables)
    turns = torsion.at_joints(angles, gaps, nodes)
    joints = turns.shape[1]
    bends = np.empty(joints, np.complex128)
    bent(hinges, Bends(bends, np.empty(joints)))
    loads = np.empty((3, *turns.shape))
    loads[:2] = coaxial_loops.restoring(overlap, bends, turns) * factors[0]
    loads[2] = coaxial_loops.wall_friction(arms, overlap.outermost, force, friction)
    if len(gaps) > 1:
        slopes = torsion.at_joints(angles, gaps + _GAP_STEP, nodes) - turns
        slopes *= loads[0] / factors[0] / _GAP_STEP
        given = overlap, gaps, bends, turns, slopes
        axial[:] = factors[0] * coaxial_loops.axial(tables, *given)
        start = np.zeros(len(gaps))
        start[gaps.argmin()] = load
        given = lengths, overlap, bends, turns, axial, start, ways, lined, factors[0]
        pressure, drag[:] = coaxial_loops.pressure(*given)
        # The lumen holds back the device in it; that one is too soft in torsion to turn
        # the lumen in its turn.
        for k in range(len(gaps) - 1):
            loads[2, k] += lined * pressure[k] * radii[k]
    borne = torsion.at_nodes(loads, gaps, nodes)
    angles[:] = torsion.turned(angles, turned, rods, duration, borne)
    for k in range(len(gaps)):
        most = torque / rods.stiffness[k, 0]
        ahead = angles[k, 0] - angles[k, 1]
        if abs(ahead) > most:
            held = angles[k, 1] + min(max(ahead, -most), most)
            slipped[k] += abs(angles[k, 0] - held)
            angles[k, 0] = held
    turns = torsion.at_joints(angles, gaps, nodes)
    _lay(made, overlap, turns, hinges, friction, factors, fields)


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

    They move from `before` (N, K) by `step` (N, K), m, within two limits; the chain
    cannot be drawn back behind its start.
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

    The chain's end is past the sheath's mouth by its insertion (N,) and a depth, m;
    nodes (L + 1,) are the ends of the links from there, m.
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
    """Points (N, K, P, 3) of a line (N, L + 1, 3) at places (N, K, P) from its end, m.

    Nodes (L + 1,) are the distances of its points; behind its base it is straight.
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

    The force (N, L, 6) is that on each link from the one before it, torque first; the
    ways (N, K) lead from the ends of K > 1 devices to that of the line (N, L + 1, 3).
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
