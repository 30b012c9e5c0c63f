"""Coaxial devices in a control step: rotations, and targets of their insertions.

Friction at wall and lumen and the shapes of the devices load the rods (`torsion`,
`coaxial`). `rest`, `lay` and `settle` take one simulation, the other functions N. K
devices, J joints, L links.
"""

from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws import coaxial, coaxial_forces, hinges, torsion

_GAP_STEP = 1e-8  # m, for a derivative


class Devices(NamedTuple):
    """The devices of a task.

    Attributes:
        tables: `coaxial.Tables`.
        rods: `torsion.Rods`.
        arms: (K,), radius of each device times its friction ratio, m.
        sections: `coaxial.Sections`.
        lumen_friction: Coulomb coefficient between the devices.
        duration: Duration of a control step, s.
        torque: Torque limit of a rotary unit, N·m.
    """

    tables: Any
    rods: Any
    arms: Any
    sections: Any
    lumen_friction: Any
    duration: Any
    torque: Any


class Loads(NamedTuple):
    """Loads on the devices of one simulation in a control step.

    Attributes:
        turned: (K,), rotation of the bases in the control step, rad.
        force: (L,), force of the wall on the links, N.
        axial: Axial force in the leading device where it leaves the others, N.
        friction: Coulomb coefficient of an uncoated device on the wall.
        stiffness: Factor of all stiffnesses.
        loss: Factor of all loss factors.
    """

    turned: Any
    force: Any
    axial: Any
    friction: Any
    stiffness: Any
    loss: Any


class State(NamedTuple):
    """State of the devices of one simulation.

    Attributes:
        gaps: (K,), distance from the end of each device to that of the chain, m.
        hinges: (2 J,), positions of the hinges, rad.
        angles: (K, M + 1), rotations of the nodes, rad; updated.
        ways: (K - 1,), fraction of the friction between devices that acts.
        drag: (K - 1,), friction between devices, N; written.
        slipped: (K,), angle by which the clamps have slipped, rad; updated.
        axial: (K, J), axial forces at the joints, N; written.
    """

    gaps: Any
    hinges: Any
    angles: Any
    ways: Any
    drag: Any
    slipped: Any
    axial: Any


class Scratch(NamedTuple):
    """Scratch arrays of `settle` and `rest`.

    Attributes:
        coaxial: `coaxial.Scratch`.
        torsion: `torsion.Scratch`.
        bends: `hinges.Bends`.
        rods: `torsion.Rods`.
        turns: (2, K, J).
        loads: (3, K, J).
        borne: (3, K, M).
        slopes: (K, J).
        pressure: (K - 1, J).
        gaps: (2, K).
        shape: (J,) complex.
    """

    coaxial: Any
    torsion: Any
    bends: Any
    rods: Any
    turns: Any
    loads: Any
    borne: Any
    slopes: Any
    pressure: Any
    gaps: Any
    shape: Any


class Chain(NamedTuple):
    """The chain that represents the devices.

    Attributes:
        overlap: `coaxial.Overlap`.
        rest: (J, 2), angles of the free hinges about x and y, rad.
        links: `coaxial.Links`.
    """

    overlap: Any
    rest: Any
    links: Any


@compiled
def rest(devices, state, friction, scratch, chain):
    """Writes the `Chain` of devices at their present rotations.

    Args:
        devices: `Devices`.
        state: `State`.
        friction: Coulomb coefficient of an uncoated device on the wall.
        scratch: `Scratch`.
        chain: `Chain`; its overlap is read and must be that of the gaps.
    """
    tables, overlap, turns = devices.tables, chain.overlap, scratch.turns[0]
    torsion.at_joints(state.angles, state.gaps, tables.nodes, turns)
    coaxial.rest_angles(overlap.rest, turns, scratch.shape)
    bends, compliance = scratch.bends, overlap.compliance
    hinges.free_hinges(scratch.shape, compliance, state.hinges, bends, chain.rest)
    sections, lengths = devices.sections, tables.lengths
    coaxial.links(overlap, lengths, friction, sections, chain.links)


@compiled
def lay(devices, state, friction, scratch, chain):
    """Writes the `Chain` of devices at the start of an episode; see `rest`."""
    coaxial.overlap(state.gaps, devices.tables, scratch.coaxial, chain.overlap)
    rest(devices, state, friction, scratch, chain)


@compiled
def _push(devices, loads, state, scratch, overlap, posture):
    """Writes axial forces and lumen friction; adds the friction torque to loads."""
    tables, gaps, turns, ahead = devices.tables, state.gaps, posture.turns, scratch.gaps
    for k in range(len(gaps)):
        ahead[0, k], ahead[1, k] = gaps[k] + _GAP_STEP, 0.0
    ahead[1, gaps.argmin()] = loads.axial
    slopes, torque = scratch.slopes, scratch.loads
    torsion.at_joints(state.angles, ahead[0], tables.nodes, slopes)
    for k in range(len(gaps)):
        for j in range(turns.shape[1]):
            slopes[k, j] -= turns[k, j]
            slopes[k, j] *= torque[0, k, j] / loads.stiffness / _GAP_STEP
    memory, axial = scratch.coaxial, state.axial
    coaxial_forces.axial(tables, overlap, posture, slopes, memory, axial)
    for k in range(len(gaps)):
        for j in range(turns.shape[1]):
            axial[k, j] = loads.stiffness * axial[k, j]
    friction, force = devices.lumen_friction, scratch.pressure
    lumen = coaxial_forces.Lumen(ahead[1], state.ways, friction, loads.stiffness)
    coaxial_forces.pressure(
        tables, overlap, posture, axial, lumen, memory, force, state.drag
    )
    # The lumen brakes the device in it. Its reaction on the lumen is left out: the
    # inner device is too soft in torsion to turn the outer one.
    for k in range(len(gaps) - 1):
        for j in range(turns.shape[1]):
            held = friction * force[k, j] * devices.sections.radii[k]
            torque[2, k, j] += held


@compiled
def settle(devices, loads, state, scratch, chain):
    """Turns the devices of one simulation and writes the `Chain` that results.

    Args:
        devices: `Devices`.
        loads: `Loads`.
        state: `State`.
        scratch: `Scratch`.
        chain: `Chain`.
    """
    tables, gaps, angles = devices.tables, state.gaps, state.angles
    rods, overlap, turns = scratch.rods, chain.overlap, scratch.turns[1]
    for k in range(len(gaps)):
        rods.times[k] = loads.loss * devices.rods.times[k]
        for m in range(rods.stiffness.shape[1]):
            rods.stiffness[k, m] = loads.stiffness * devices.rods.stiffness[k, m]
    coaxial.overlap(gaps, tables, scratch.coaxial, overlap)
    torsion.at_joints(angles, gaps, tables.nodes, turns)
    hinges.bent(state.hinges, scratch.bends)
    posture, torque = coaxial.Posture(gaps, scratch.bends.bends, turns), scratch.loads
    coaxial_forces.restoring(overlap, posture, scratch.coaxial, torque[0], torque[1])
    for k in range(len(gaps)):
        for j in range(turns.shape[1]):
            torque[0, k, j] *= loads.stiffness
            torque[1, k, j] *= loads.stiffness
    outermost, friction = overlap.outermost, loads.friction
    coaxial_forces.wall_friction(
        devices.arms, outermost, loads.force, friction, torque[2]
    )
    if len(gaps) > 1:
        _push(devices, loads, state, scratch, overlap, posture)
    torsion.at_nodes(torque, gaps, tables.nodes, scratch.borne)
    duration, memory = devices.duration, scratch.torsion
    torsion.turned(angles, loads.turned, rods, duration, scratch.borne, memory, angles)
    for k in range(len(gaps)):
        most = devices.torque / rods.stiffness[k, 0]
        ahead = angles[k, 0] - angles[k, 1]
        if abs(ahead) > most:
            held = angles[k, 1] + min(max(ahead, -most), most)
            state.slipped[k] += abs(angles[k, 0] - held)
            angles[k, 0] = held
    rest(devices, state, loads.friction, scratch, chain)


@compiled
def advance(before, step, limits, target, lead):
    """Writes the target insertions (N, K) of the devices and (N,) of the chain, m.

    The devices move from `before` (N, K) by `step` (N, K) within `limits` (least and
    most, (N,) m each). A device that starts behind them is not drawn back further. The
    chain cannot retract behind its start.
    """
    count, devices = before.shape
    least, most = limits
    for i in range(count):
        leader = 0
        for k in range(devices):
            back = min(least[i], before[i, k])
            target[i, k] = min(max(before[i, k] + step[i, k], back), most[i])
            if target[i, k] > target[i, leader]:
                leader = k
        lead[i] = max(target[i, leader], 0.0)
        target[i, leader] = lead[i]


@compiled
def rubbing(force, lead, depth, nodes, size):
    """Writes magnitudes (N, L) of contact forces (N, L, 6) on links past the sheath, N.

    They are 0 on links in the sheath. The chain ends `lead` + `depth` (N,) past the
    mouth of the sheath, m. `nodes` (L + 1,) are the distances of the ends of the links
    from the end of the chain, m.
    """
    count, links = force.shape[:2]
    for i in range(count):
        for link in range(links):
            size[i, link] = 0.0
            if lead[i] - nodes[link + 1] > -depth[i]:
                x, y, z = force[i, link, 3], force[i, link, 4], force[i, link, 5]
                size[i, link] = np.sqrt(x * x + y * y + z * z)


@compiled
def points(line, places, nodes, found):
    """Writes points (N, K, P, 3) of a line (N, L + 1, 3) at places (N, K, P), m.

    Places and nodes (L + 1,), those of the line's points, are distances from the end of
    the line, m. Behind its base the line is straight.
    """
    last = len(nodes) - 1
    for i in range(places.shape[0]):
        for k in range(places.shape[1]):
            for p in range(places.shape[2]):
                place = max(places[i, k, p], 0.0)
                # Node `far` is proximal of the place, `far + 1` distal of it.
                far = last - 1
                while far > 0 and nodes[far] <= place:
                    far -= 1
                share = place - nodes[far + 1]
                share /= nodes[far] - nodes[far + 1]
                for axis in range(3):
                    near = line[i, far + 1, axis]
                    found[i, k, p, axis] = near + share * (line[i, far, axis] - near)


@compiled
def _second(ways):
    """The second smallest of two numbers or more."""
    least = second = np.inf
    for way in ways:
        if way < least:
            least, second = way, least
        elif way < second:
            second = way
    return second


@compiled
def leading_load(force, line, ways, nodes, load):
    """Writes the axial force (N,) in the leading device where it leaves the others, N.

    `force` (N, L, 6) acts on each link from the one before it, torque first. `ways`
    (N, K) are the distances from the ends of K > 1 devices to that of the line
    (N, L + 1, 3), `nodes` (L + 1,) those of the line's points, m.
    """
    count, links = force.shape[:2]
    for i in range(count):
        second = _second(ways[i])
        # The first link distal of the place: its joint bears the load beyond.
        link = 1
        while link < links - 1 and nodes[link] > second:
            link += 1
        borne = length = 0.0
        for axis in range(3):
            along = line[i, link + 1, axis] - line[i, link, axis]
            borne += force[i, link, 3 + axis] * along
            length += along * along
        load[i] = borne / np.sqrt(length)
