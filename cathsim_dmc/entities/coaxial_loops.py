"""Coaxial devices: what they do to each other and to the chain, compiled.

Functions of one simulation; K devices, J joints, L = J + 1 links. `gaps` (K,), distance
from the end of each device to the end of the chain, m; `turns` (K, J), rotation of each
device at each joint, rad; `bends` (J,) complex, bending angles of the joints, rad;
`tables` of a `coaxial.Stack`. Arrays are C-contiguous.
"""

import math
from typing import NamedTuple

import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.hinges import unit

# A distance beyond the end of any device, m.
_FAR = 1e3


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

    compliance: np.ndarray
    rest: np.ndarray
    coupling: np.ndarray
    stiffness: np.ndarray
    moment: np.ndarray
    outermost: np.ndarray
    present: np.ndarray


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

    radius: np.ndarray
    friction: np.ndarray
    mass: np.ndarray
    buoyancy: np.ndarray
    inertia: np.ndarray


@compiled
def _weight(place, joint, nodes, lengths):
    """Integral of the weight of a joint from the end of the chain to a place."""
    ahead, behind = lengths[joint + 1], lengths[joint]
    offset = place - nodes[joint + 1]
    rise = min(max(offset + ahead, 0.0), ahead)
    fall = min(max(offset, 0.0), behind)
    return rise * rise / (2 * ahead) + fall - fall * fall / (2 * behind)


@compiled
def _breaks(gaps, edges):
    places = np.empty(edges.size + 1)
    for k in range(edges.shape[0]):
        for e in range(edges.shape[1]):
            places[k * edges.shape[1] + e] = min(gaps[k] + edges[k, e], _FAR)
    places[-1] = _FAR
    places.sort()
    return places


@compiled
def _piece(place, edges):
    piece = 0
    while piece < len(edges) and place >= edges[piece]:
        piece += 1
    return piece


@compiled
def overlap(gaps, tables):
    """The `Overlap` of devices."""
    nodes, lengths, edges, bending, moment = tables
    devices, joints = len(gaps), len(lengths) - 1
    pairs = devices * (devices - 1) // 2
    compliance, coupling = np.zeros(joints), np.zeros((pairs, joints))
    parts = np.zeros((3, devices, joints))
    rest, stiffness, mean = parts[0], parts[1], parts[2]
    own_bending, own_moment = np.empty(devices), np.empty(devices)
    breaks = _breaks(gaps, edges)
    for c in range(len(breaks) - 1):
        low, high = breaks[c], breaks[c + 1]
        if high <= low or low >= nodes[0]:
            continue
        total = 0.0
        for k in range(devices):
            piece = _piece((low + high) / 2 - gaps[k], edges[k])
            own_bending[k], own_moment[k] = bending[k, piece], moment[k, piece]
            total += own_bending[k]
        for j in range(joints):
            if high <= nodes[j + 2] or low >= nodes[j]:
                continue
            weight = _weight(high, j, nodes, lengths)
            weight -= _weight(low, j, nodes, lengths)
            compliance[j] += weight / total
            pair = 0
            for k in range(devices):
                share = own_moment[k] / total
                rest[k, j] += share * weight
                stiffness[k, j] += own_bending[k] * weight
                mean[k, j] += own_moment[k] * weight
                for other in range(k + 1, devices):
                    coupling[pair, j] += share * own_moment[other] * weight
                    pair += 1
    for j in range(joints):
        span = (lengths[j] + lengths[j + 1]) / 2
        for k in range(devices):
            stiffness[k, j] /= span
            mean[k, j] /= span
    reach = np.empty((2, devices, len(lengths)))
    outermost, present = reach[0], reach[1]
    for link in range(len(lengths)):
        # A device farther out covers a place that it reaches.
        covered = 0.0
        for k in range(devices - 1, -1, -1):
            reached = (nodes[link] - gaps[k]) / lengths[link]
            reached = min(max(reached, 0.0), 1.0)
            present[k, link] = reached
            outermost[k, link] = max(reached - covered, 0.0)
            covered = max(covered, reached)
    return Overlap(compliance, rest, coupling, stiffness, mean, outermost, present)


@compiled
def rest_angles(rest, turns):
    """Rest angles (J,) of the joints, complex, rad; `rest` of an `Overlap`."""
    angles = np.empty(turns.shape[1], np.complex128)
    for j in range(len(angles)):
        whole = rest[0, j] * unit(turns[0, j])
        for k in range(1, len(turns)):
            whole += rest[k, j] * unit(turns[k, j])
        angles[j] = whole
    return angles


@compiled
def restoring(overlap, bends, turns):
    """Restoring torques of the shapes of the devices, and their stiffness.

    The energy of a joint bent by θ is |θ - Σ R_k e_k|²/2C, e_k = exp(iφ_k), and that of
    two devices against each other -S cos(φ_k - φ_l).

    Returns:
        (2, K, J): torque on each device about its axis, N·m, and minus its derivative
        by the rotation, N·m/rad.
    """
    compliance, rest, coupling = overlap.compliance, overlap.rest, overlap.coupling
    devices, joints = turns.shape
    loads, pulls = np.empty((2, devices, joints)), np.empty(devices, np.complex128)
    torque, rate = loads[0], loads[1]
    for j in range(joints):
        whole = 0j
        for k in range(devices):
            pulls[k] = rest[k, j] * unit(turns[k, j])
            whole += pulls[k]
        for k in range(devices):
            force = np.conj(bends[j] - (whole - pulls[k])) * pulls[k]
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
    return loads


@compiled
def _pull(place, load, turns, gaps, edges, bending, moment, piece, device):
    """Force (N) at a place that bears a bending moment: |EI κ|²/2EI - Σ EI_k κ_k²/2."""
    total, whole, own = 0.0, load, 0.0
    for k in range(len(gaps)):
        here = piece if k == device else _piece(place - gaps[k], edges[k])
        if bending[k, here] > 0.0:
            total += bending[k, here]
            whole += moment[k, here] * unit(turns[k])
            own += moment[k, here] ** 2 / bending[k, here]
    return (abs(whole) ** 2 / total - own) / 2


@compiled
def axial(tables, overlap, gaps, bends, turns, slopes):
    """Axial forces (K, J), N, of the joints, positive where a device must be pushed.

    Minus the derivative of the energy by the gap of a device, at given bends and
    rotations of its rod; that of the leading device is minus the others' sum.

    Args:
        slopes: (K, J), N, torque of `restoring` times the derivative of `turns` by gap.
    """
    nodes, lengths, edges, bending, moment = tables
    devices, joints = turns.shape
    force, loads = np.zeros(turns.shape), np.empty(joints, np.complex128)
    leader = gaps.argmin()
    for j in range(joints):
        whole = bends[j]
        for k in range(devices):
            whole -= overlap.rest[k, j] * unit(turns[k, j])
        loads[j] = whole / overlap.compliance[j]
    for k in range(devices):
        if k == leader:
            continue
        force[k] += slopes[k]
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
                    here = (place, loads[j], turns[:, j], gaps, edges)
                    jump = _pull(*here, bending, moment, piece, k)
                    jump -= _pull(*here, bending, moment, piece + 1, k)
                    force[k, j] += weight * jump
        force[leader] -= force[k]
    return force


@compiled
def pressure(lengths, overlap, bends, turns, axial, start, ways, coefficient, factor):
    """Lateral forces of each device on the lumen of the next one, and friction.

    With the moment M and the compression P, the force is M'' + Pκ per length.

    Args:
        axial: (K, J), see `axial`, N.
        start: (K,), compression where each device leaves the others, N.
        ways: (K - 1,) in [-1, 1], fraction of the friction that acts on device k,
            positive when it slides forward in the next one.
        coefficient: Coulomb coefficient between the devices.
        factor: of all stiffnesses.

    Returns:
        (K - 1, J), force of device k on device k + 1 at the joints, N, and (K - 1,),
        the axial force that their friction demands of device k, N.
    """
    stiffness, moment = factor * overlap.stiffness, factor * overlap.moment
    devices, joints = turns.shape
    force, drag = np.empty((devices - 1, joints)), np.zeros(devices - 1)
    own = np.empty(joints, np.complex128)
    shear = np.zeros(joints, np.complex128)
    for k in range(devices - 1):
        for j in range(joints):
            span = (lengths[j] + lengths[j + 1]) / 2
            own[j] = stiffness[k, j] * bends[j] / span
            own[j] -= moment[k, j] * unit(turns[k, j])
        for j in range(joints - 1):
            shear[j] = (own[j + 1] - own[j]) / lengths[j + 1]
        # Compression of the device, from its end on.
        pushed = start[k]
        for j in range(joints - 1, -1, -1):
            span = (lengths[j] + lengths[j + 1]) / 2
            pushed += axial[k, j]
            here = pushed
            if stiffness[k, j] > 0.0:
                square = abs(stiffness[k, j] * bends[j] / span) ** 2
                square -= moment[k, j] ** 2
                here += square / (2 * stiffness[k, j])
            lateral = shear[j] + here * bends[j]
            if j > 0:
                lateral -= shear[j - 1]
            # Only where both devices are present: the mean of both links.
            present = overlap.present[k + 1]
            force[k, j] = abs(lateral) * ((present[j] + present[j + 1]) / 2)
            rubbing = ways[k] * coefficient * force[k, j]
            pushed += rubbing
            drag[k] += rubbing
    return force, drag


@compiled
def wall_friction(arms, outermost, force, coefficient):
    """Limits (K, J) of the friction torque of the wall on the devices, N·m.

    The arms (K,) are radii by friction ratio, m, the forces (L,) those on the links, N.
    """
    devices, links = outermost.shape
    torque = np.empty((devices, links - 1))
    for k in range(devices):
        for j in range(links - 1):
            # The last joint bears all of the last link.
            last = 1.0 if j == links - 2 else 0.5
            borne = 0.5 * outermost[k, j] * force[j]
            borne += last * outermost[k, j + 1] * force[j + 1]
            torque[k, j] = coefficient * arms[k] * borne
    return torque


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
def links(overlap, lengths, friction, radii, ratios, densities):
    """The `Links` of a chain.

    Args:
        lengths: (L,), m.
        friction: Coulomb coefficient of an uncoated device on the wall.
        radii, ratios: (K,), outer radii, m, and friction ratios.
        densities: (4, K), mass, weight in blood, blood carried by a device that is the
            outermost and by one that is present, kg/m.
    """
    devices, count = overlap.outermost.shape
    made, moments = np.zeros((4, count)), np.empty((count, 2))
    carried = densities[2, devices - 1] + densities[3].sum()
    share = densities[1].sum() / (densities[0].sum() + carried)
    for link in range(count):
        radius = mass = weight = 0.0
        whole = True
        for k in range(devices):
            outside, there = overlap.outermost[k, link], overlap.present[k, link]
            radius += outside * radii[k]
            made[1, link] += outside * ratios[k] * friction
            carried = outside * densities[2, k] + there * densities[3, k]
            mass += (there * densities[0, k] + carried) * lengths[link]
            weight += there * densities[1, k] * lengths[link]
            whole = whole and there == 1.0
        made[0, link], made[2, link] = radius, mass
        # Exactly 0 where all devices are present: MuJoCo then skips the link.
        if share > 0.0 and not whole:
            made[3, link] = 1.0 - weight / (mass * share)
        moments[link] = _inertia(mass, radius, lengths[link])
    return Links(made[0], made[1], made[2], made[3], moments)
