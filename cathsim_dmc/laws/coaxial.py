"""Coaxial devices: forces on each other, and the chain that represents them.

docs/pair_model.md derives the equations. Functions of one simulation; K devices, J
joints, L = J + 1 links, P pairs of devices. `gaps` (K,), distance from the end of each
device to the end of the chain, m; `turns` (K, J), rotation of each device at each
joint, rad; `bends` (J,) complex, bending angles of the joints, rad.
"""

import math
from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.hinges import unit

# A distance beyond the end of any device, m.
_FAR = 1e3


class Tables(NamedTuple):
    """Sections of the devices along the chain.

    Attributes:
        nodes: (L + 1,), distances of the ends of the links from the end of the chain,
            from proximal to distal, m.
        lengths: (L,), of the links, m.
        edges: (K, E), start of the uniform pieces of the devices, m from their ends,
            padded with infinity.
        bending: (K, E + 1), EI beyond the device and of the pieces, N·m².
        moment: (K, E + 1), EI κ there, N·m.
    """

    nodes: Any
    lengths: Any
    edges: Any
    bending: Any
    moment: Any


class Sections(NamedTuple):
    """Outer sections of the devices.

    Attributes:
        radii: (K,), outer radii, m.
        ratios: (K,), friction ratios.
        densities: (4, K), mass, weight in blood, blood carried by a device that is the
            outermost and by one that is present, kg/m.
    """

    radii: Any
    ratios: Any
    densities: Any


class Posture(NamedTuple):
    """How devices lie: `gaps`, `bends` and `turns`."""

    gaps: Any
    bends: Any
    turns: Any


class Lumen(NamedTuple):
    """What acts on devices in each other.

    Attributes:
        start: (K,), compression where each device leaves the others, N.
        ways: (K - 1,) in [-1, 1], fraction of the friction that acts on device k,
            positive when it slides forward in the next one.
        coefficient: Coulomb coefficient between the devices.
        factor: Of all stiffnesses.
    """

    start: Any
    ways: Any
    coefficient: Any
    factor: Any


class Scratch(NamedTuple):
    """Memory of the laws.

    Attributes:
        places: (K E + 1,), m.
        devices: (2, K).
        pulls: (K,) complex.
        joints: (2, J) complex.
    """

    places: Any
    devices: Any
    pulls: Any
    joints: Any


class Overlap(NamedTuple):
    """Properties of a chain that depend on the overlap but not on the rotations.

    Attributes:
        compliance: (J,), ∫h ds/EI of a joint with weight h, rad/(N·m).
        rest: (K, J), ∫h κ_k EI_k/EI ds, angle by which a device bends the free joint,
            rad.
        coupling: (P, J), ∫h κ_k κ_l EI_k EI_l/EI ds for each of the P pairs of devices:
            energy of two that bend against each other, N·m.
        stiffness: (K, J), weighted mean of EI_k, N·m².
        moment: (K, J), weighted mean of EI_k κ_k, N·m.
        outermost: (K, L), fraction of each link on which a device is the outermost.
        present: (K, L), fraction of each link on which a device is present.
    """

    compliance: Any
    rest: Any
    coupling: Any
    stiffness: Any
    moment: Any
    outermost: Any
    present: Any


class Links(NamedTuple):
    """Properties of the links, arrays (L,).

    Attributes:
        radius: radius of the outermost device, its mean over the link, m.
        friction: Coulomb coefficient on the wall, its mean over the link.
        mass: mass, kg.
        buoyancy: fraction of the link's weight that buoyancy cancels, beyond the
            buoyancy of all devices together, which reduces gravity (`gravcomp`).
        inertia: (L, 2), moments of inertia of a solid capsule across and along its
            axis, kg·m².
    """

    radius: Any
    friction: Any
    mass: Any
    buoyancy: Any
    inertia: Any


@compiled
def _weight(place, joint, nodes, lengths):
    """Integral of the weight of a joint from the end of the chain to a place."""
    ahead, behind = lengths[joint + 1], lengths[joint]
    offset = place - nodes[joint + 1]
    rise = min(max(offset + ahead, 0.0), ahead)
    fall = min(max(offset, 0.0), behind)
    return rise * rise / (2 * ahead) + fall - fall * fall / (2 * behind)


@compiled
def _breaks(gaps, edges, places):
    """Writes the places, m from the end, where a piece begins, in order."""
    for k in range(edges.shape[0]):
        for e in range(edges.shape[1]):
            places[k * edges.shape[1] + e] = min(gaps[k] + edges[k, e], _FAR)
    places[-1] = _FAR
    places.sort()


@compiled
def _piece(place, edges):
    piece = 0
    while piece < len(edges) and place >= edges[piece]:
        piece += 1
    return piece


@compiled
def overlap(gaps, tables, scratch, out):
    """Writes the `Overlap` of devices; `scratch` is `Scratch`."""
    nodes, lengths, edges = tables.nodes, tables.lengths, tables.edges
    devices, joints, breaks = len(gaps), len(lengths) - 1, scratch.places
    own_bending, own_moment = scratch.devices[0], scratch.devices[1]
    for j in range(joints):
        out.compliance[j] = 0.0
        for pair in range(len(out.coupling)):
            out.coupling[pair, j] = 0.0
        for k in range(devices):
            out.rest[k, j] = out.stiffness[k, j] = out.moment[k, j] = 0.0
    _breaks(gaps, edges, breaks)
    for c in range(len(breaks) - 1):
        low, high = breaks[c], breaks[c + 1]
        if high <= low or low >= nodes[0]:
            continue
        total = 0.0
        for k in range(devices):
            piece = _piece((low + high) / 2 - gaps[k], edges[k])
            own_bending[k] = tables.bending[k, piece]
            own_moment[k] = tables.moment[k, piece]
            total += own_bending[k]
        for j in range(joints):
            if high <= nodes[j + 2] or low >= nodes[j]:
                continue
            weight = _weight(high, j, nodes, lengths)
            weight -= _weight(low, j, nodes, lengths)
            out.compliance[j] += weight / total
            pair = 0
            for k in range(devices):
                share = own_moment[k] / total
                out.rest[k, j] += share * weight
                out.stiffness[k, j] += own_bending[k] * weight
                out.moment[k, j] += own_moment[k] * weight
                for other in range(k + 1, devices):
                    out.coupling[pair, j] += share * own_moment[other] * weight
                    pair += 1
    for j in range(joints):
        span = (lengths[j] + lengths[j + 1]) / 2
        for k in range(devices):
            out.stiffness[k, j] /= span
            out.moment[k, j] /= span
    for link in range(len(lengths)):
        # A device farther out covers a place that it reaches.
        covered = 0.0
        for k in range(devices - 1, -1, -1):
            reached = (nodes[link] - gaps[k]) / lengths[link]
            reached = min(max(reached, 0.0), 1.0)
            out.present[k, link] = reached
            out.outermost[k, link] = max(reached - covered, 0.0)
            covered = max(covered, reached)


@compiled
def rest_angles(rest, turns, out):
    """Writes the rest angles (J,) complex of the joints, rad; `rest` of `Overlap`."""
    for j in range(len(out)):
        whole = rest[0, j] * unit(turns[0, j])
        for k in range(1, len(turns)):
            whole += rest[k, j] * unit(turns[k, j])
        out[j] = whole


@compiled
def restoring(overlap, posture, scratch, torque, rate):
    """Restoring torques of the shapes of the devices, and their stiffness.

    The energy of a joint bent by θ is |θ - Σ R_k e_k|²/2C, e_k = exp(iφ_k), and that of
    two devices against each other -S cos(φ_k - φ_l).

    Args:
        overlap: `Overlap`.
        posture: `Posture`.
        scratch: `Scratch`.
        torque: (K, J), gets the torque on each device about its axis, N·m.
        rate: (K, J), gets minus its derivative by the rotation, N·m/rad.
    """
    compliance, rest, coupling = overlap.compliance, overlap.rest, overlap.coupling
    bends, turns, pulls = posture.bends, posture.turns, scratch.pulls
    devices, joints = turns.shape
    for j in range(joints):
        whole = 0j
        for k in range(devices):
            pulls[k] = rest[k, j] * unit(turns[k, j])
            whole += pulls[k]
        for k in range(devices):
            force = (bends[j] - (whole - pulls[k])).conjugate() * pulls[k]
            torque[k, j] = -force.imag / compliance[j]
            rate[k, j] = force.real / compliance[j]
        pair = 0
        for k in range(devices):
            for other in range(k + 1, devices):
                energy, angle = coupling[pair, j], turns[k, j] - turns[other, j]
                torque[k, j] -= energy * math.sin(angle)
                torque[other, j] += energy * math.sin(angle)
                rate[k, j] += energy * math.cos(angle)
                rate[other, j] += energy * math.cos(angle)
                pair += 1


@compiled
def _pull(place, load, posture, tables, joint, device, piece):
    """Force (N) at a place that bears a bending moment: |EI κ|²/2EI - Σ EI_k κ_k²/2.

    The piece of one device is given, those of the others are looked up.
    """
    total, whole, own = 0.0, load, 0.0
    for k in range(len(posture.gaps)):
        here = piece
        if k != device:
            here = _piece(place - posture.gaps[k], tables.edges[k])
        bending, moment = tables.bending[k, here], tables.moment[k, here]
        if bending > 0.0:
            total += bending
            whole += moment * unit(posture.turns[k, joint])
            own += moment**2 / bending
    return (abs(whole) ** 2 / total - own) / 2


@compiled
def axial(tables, overlap, posture, slopes, scratch, force):
    """Writes the axial forces of the joints, positive where a device must be pushed.

    Minus the derivative of the energy by the gap of a device, at given bends and
    rotations of its rod; that of the leading device is minus the others' sum.

    Args:
        tables: `Tables`.
        overlap: `Overlap`.
        posture: `Posture`.
        slopes: (K, J), N, torque of `restoring` times the derivative of `turns` by gap.
        scratch: `Scratch`.
        force: (K, J), N.
    """
    nodes, lengths, edges = tables.nodes, tables.lengths, tables.edges
    gaps, turns, loads = posture.gaps, posture.turns, scratch.joints[0]
    devices, joints = turns.shape
    leader = 0
    for k in range(1, devices):
        if gaps[k] < gaps[leader]:
            leader = k
    for j in range(joints):
        whole = posture.bends[j]
        for k in range(devices):
            whole -= overlap.rest[k, j] * unit(turns[k, j])
            force[k, j] = 0.0
        loads[j] = whole / overlap.compliance[j]
    for k in range(devices):
        if k == leader:
            continue
        for j in range(joints):
            force[k, j] += slopes[k, j]
        link = joints
        for piece in range(edges.shape[1]):
            place = gaps[k] + edges[k, piece]
            if place >= nodes[0]:
                break
            while place >= nodes[link]:
                link -= 1
            share = (place - nodes[link + 1]) / lengths[link]
            # The joints at both ends of the link share what it bends.
            for j, weight in ((link - 1, share), (link, 1 - share)):
                if 0 <= j < joints:
                    jump = _pull(place, loads[j], posture, tables, j, k, piece)
                    jump -= _pull(place, loads[j], posture, tables, j, k, piece + 1)
                    force[k, j] += weight * jump
        for j in range(joints):
            force[leader, j] -= force[k, j]


@compiled
def pressure(tables, overlap, posture, axial, lumen, scratch, force, drag):
    """Lateral forces of each device on the lumen of the next one, and friction.

    With the moment M and the compression P, the force is M'' + Pκ per length.

    Args:
        tables: `Tables`.
        overlap: `Overlap`.
        posture: `Posture`.
        axial: (K, J), see `axial`, N.
        lumen: `Lumen`.
        scratch: `Scratch`.
        force: (K - 1, J), gets the force of device k on device k + 1 at the joints, N.
        drag: (K - 1,), gets the axial force that their friction demands of device k, N.
    """
    lengths, bends, turns = tables.lengths, posture.bends, posture.turns
    devices, joints = turns.shape
    own, shear = scratch.joints[0], scratch.joints[1]
    shear[joints - 1] = 0j
    for k in range(devices - 1):
        drag[k] = 0.0
        for j in range(joints):
            span = (lengths[j] + lengths[j + 1]) / 2
            stiffness = lumen.factor * overlap.stiffness[k, j]
            own[j] = stiffness * bends[j] / span
            own[j] -= lumen.factor * overlap.moment[k, j] * unit(turns[k, j])
        for j in range(joints - 1):
            shear[j] = (own[j + 1] - own[j]) / lengths[j + 1]
        # Compression of the device, from its end on.
        pushed = lumen.start[k]
        for j in range(joints - 1, -1, -1):
            span = (lengths[j] + lengths[j + 1]) / 2
            pushed += axial[k, j]
            here = pushed
            stiffness = lumen.factor * overlap.stiffness[k, j]
            if stiffness > 0.0:
                square = abs(stiffness * bends[j] / span) ** 2
                square -= (lumen.factor * overlap.moment[k, j]) ** 2
                here += square / (2 * stiffness)
            lateral = shear[j] + here * bends[j]
            if j > 0:
                lateral -= shear[j - 1]
            # Only where both devices are present: the mean of both links.
            present = overlap.present[k + 1]
            force[k, j] = abs(lateral) * ((present[j] + present[j + 1]) / 2)
            rubbing = lumen.ways[k] * lumen.coefficient * force[k, j]
            pushed += rubbing
            drag[k] += rubbing


@compiled
def wall_friction(arms, outermost, force, coefficient, torque):
    """Writes limits (K, J) of the friction torque of the wall on the devices, N·m.

    The arms (K,) are radii by friction ratio, m, the forces (L,) those on the links, N.
    """
    devices, links = outermost.shape
    for k in range(devices):
        for j in range(links - 1):
            # The last joint bears all of the last link.
            last = 1.0 if j == links - 2 else 0.5
            borne = 0.5 * outermost[k, j] * force[j]
            borne += last * outermost[k, j + 1] * force[j + 1]
            torque[k, j] = coefficient * arms[k] * borne


@compiled
def _inertia(mass, radius, length):
    """Moments of inertia of a solid capsule, across and along it, kg·m²."""
    share = 1 / (1 + 4 * radius / (3 * length))  # of the cylinder in the volume
    cylinder, ball = mass * share, mass * (1 - share)
    square = radius * radius
    across = cylinder * (length * length / 12 + square / 4)
    across += ball * (2 * square / 5 + length * length / 4 + 3 * length * radius / 8)
    return across, cylinder * square / 2 + ball * 2 * square / 5


@compiled
def links(overlap, lengths, friction, sections, out):
    """Writes the `Links` of a chain.

    Args:
        overlap: `Overlap`.
        lengths: (L,), m.
        friction: Coulomb coefficient of an uncoated device on the wall.
        sections: `Sections`.
        out: `Links`.
    """
    (devices, count), densities = overlap.outermost.shape, sections.densities
    carried = densities[2, devices - 1] + densities[3].sum()
    share = densities[1].sum() / (densities[0].sum() + carried)
    for link in range(count):
        radius = mass = weight = coefficient = 0.0
        whole = True
        for k in range(devices):
            outside, there = overlap.outermost[k, link], overlap.present[k, link]
            radius += outside * sections.radii[k]
            coefficient += outside * sections.ratios[k] * friction
            carried = outside * densities[2, k] + there * densities[3, k]
            mass += (there * densities[0, k] + carried) * lengths[link]
            weight += there * densities[1, k] * lengths[link]
            whole = whole and there == 1.0
        out.radius[link], out.mass[link] = radius, mass
        out.friction[link], out.buoyancy[link] = coefficient, 0.0
        # Exactly 0 where all devices are present: MuJoCo then skips the link.
        if share > 0.0 and not whole:
            out.buoyancy[link] = 1.0 - weight / (mass * share)
        across, along = _inertia(mass, radius, lengths[link])
        out.inertia[link, 0], out.inertia[link, 1] = across, along
