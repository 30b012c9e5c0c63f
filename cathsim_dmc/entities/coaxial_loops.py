"""Coaxial devices: what they do to each other and to the chain, compiled.

`coaxial` defines the quantities: an `Overlap`, and `gaps`, `bends` and `turns` as the
methods of a `Stack` have them; `tables` and `arms` are those of a `Stack`. A chain has
some thirty joints, for which compiled loops are faster than numpy. Each simulation is
computed on its own, so single and batched simulations agree bit for bit.

Arrays have a leading axis N of simulations; K devices, J joints, L = J + 1 links. All
are C-contiguous.
"""

import math

import numpy as np

from cathsim_dmc.compiled import compiled
from cathsim_dmc.entities.hinge_loops import unit

# A distance beyond the end of any device, m.
_FAR = 1e3


@compiled
def _weight(place, joint, nodes, lengths):
    """Integral of the weight of a joint from the end of the chain to a place.

    The weight rises along the link distal of the joint and falls along the proximal
    one.
    """
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
def overlaps(gaps, nodes, lengths, edges, bending, moment):
    """Integrals around the joints, the first five of `coaxial.Overlap`.

    Args:
        edges: (K, E), start of the pieces of the devices, m from their ends; padded
            with infinity.
        bending, moment: (K, E + 1), EI (N·m²) and EI κ (N·m) beyond the device (0) and
            of the pieces.
    """
    count, devices = gaps.shape
    joints = len(lengths) - 1
    compliance = np.zeros((count, joints))
    rest = np.zeros((count, devices, joints))
    coupling = np.zeros((count, devices * (devices - 1) // 2, joints))
    stiffness = np.zeros((count, devices, joints))
    mean = np.zeros((count, devices, joints))
    own_bending, own_moment = np.empty(devices), np.empty(devices)
    for i in range(count):
        breaks = _breaks(gaps[i], edges)
        for c in range(len(breaks) - 1):
            low, high = breaks[c], breaks[c + 1]
            if high <= low or low >= nodes[0]:
                continue
            total = 0.0
            for k in range(devices):
                piece = _piece((low + high) / 2 - gaps[i, k], edges[k])
                own_bending[k], own_moment[k] = bending[k, piece], moment[k, piece]
                total += own_bending[k]
            for j in range(joints):
                if high <= nodes[j + 2] or low >= nodes[j]:
                    continue
                weight = _weight(high, j, nodes, lengths)
                weight -= _weight(low, j, nodes, lengths)
                compliance[i, j] += weight / total
                pair = 0
                for k in range(devices):
                    share = own_moment[k] / total
                    rest[i, k, j] += share * weight
                    stiffness[i, k, j] += own_bending[k] * weight
                    mean[i, k, j] += own_moment[k] * weight
                    for other in range(k + 1, devices):
                        coupling[i, pair, j] += share * own_moment[other] * weight
                        pair += 1
        for j in range(joints):
            span = (lengths[j] + lengths[j + 1]) / 2
            for k in range(devices):
                stiffness[i, k, j] /= span
                mean[i, k, j] /= span
    return compliance, rest, coupling, stiffness, mean


@compiled
def shares(gaps, nodes, lengths):
    """Fractions (N, K, L) of the links where a device is outermost, and present."""
    count, devices = gaps.shape
    outermost = np.empty((count, devices, len(lengths)))
    present = np.empty_like(outermost)
    for i in range(count):
        for link in range(len(lengths)):
            # A device farther out covers a place that it reaches.
            covered = 0.0
            for k in range(devices - 1, -1, -1):
                reached = (nodes[link] - gaps[i, k]) / lengths[link]
                reached = min(max(reached, 0.0), 1.0)
                present[i, k, link] = reached
                outermost[i, k, link] = max(reached - covered, 0.0)
                covered = max(covered, reached)
    return outermost, present


@compiled
def restoring(overlap, bends, turns):
    """Restoring torques of the shapes of the devices, and their stiffness.

    The energy of a joint bent by θ is |θ - Σ R_k e_k|²/2C, e_k = exp(iφ_k), and that of
    two devices against each other -S cos(φ_k - φ_l). The derivative by a rotation turns
    a shaped device into the plane of a curved vessel and makes it whip.

    Returns:
        Torque (N, K, J) on each device about its axis, N·m, and minus its derivative by
        the rotation, N·m/rad.
    """
    compliance, rest, coupling = overlap.compliance, overlap.rest, overlap.coupling
    count, devices, joints = turns.shape
    torque, rate = np.empty(turns.shape), np.empty(turns.shape)
    pulls = np.empty(devices, np.complex128)
    for i in range(count):
        for j in range(joints):
            whole = 0j
            for k in range(devices):
                pulls[k] = rest[i, k, j] * unit(turns[i, k, j])
                whole += pulls[k]
            for k in range(devices):
                force = np.conj(bends[i, j] - (whole - pulls[k])) * pulls[k]
                torque[i, k, j] = -force.imag / compliance[i, j]
                rate[i, k, j] = force.real / compliance[i, j]
            pair = 0
            for k in range(devices):
                for other in range(k + 1, devices):
                    energy = coupling[i, pair, j]
                    angle = turns[i, k, j] - turns[i, other, j]
                    torque[i, k, j] -= energy * math.sin(angle)
                    torque[i, other, j] += energy * math.sin(angle)
                    rate[i, k, j] += energy * math.cos(angle)
                    rate[i, other, j] += energy * math.cos(angle)
                    pair += 1
    return torque, rate


@compiled
def _pull(place, load, turns, gaps, edges, bending, moment, piece, device):
    """Force (N) at a place that bears a bending moment: |EI κ|²/2EI - Σ EI_k κ_k²/2.

    It is the derivative of the energy by the length of the rod. One device has a given
    piece there.
    """
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
    """Axial forces by which the joints resist the sliding of the devices.

    Minus the derivative of the energy by the gap of a device, at given bends and
    rotations of its rod; that of the leading device is minus the others' sum.

    Args:
        slopes: (N, K, J), torque of `restoring` times the derivative of `turns` by the
            gap, N.

    Returns:
        (N, K, J), N, positive where a device must be pushed forward.
    """
    nodes, lengths, edges, bending, moment = tables
    compliance, rest = overlap.compliance, overlap.rest
    count, devices, joints = turns.shape
    force = np.zeros(turns.shape)
    loads = np.empty(joints, np.complex128)
    for i in range(count):
        leader = gaps[i].argmin()
        for j in range(joints):
            whole = bends[i, j]
            for k in range(devices):
                whole -= rest[i, k, j] * unit(turns[i, k, j])
            loads[j] = whole / compliance[i, j]
        for k in range(devices):
            if k == leader:
                continue
            force[i, k] += slopes[i, k]
            link = joints
            for piece in range(edges.shape[1]):
                place = gaps[i, k] + edges[k, piece]
                if place >= nodes[0]:
                    break
                while place >= nodes[link]:
                    link -= 1
                share = (place - nodes[link + 1]) / lengths[link]
                # The joints at both ends of the link share what it bends.
                for j, weight in ((link - 1, share), (link, 1 - share)):
                    if 0 <= j < joints:
                        here = (place, loads[j], turns[i, :, j], gaps[i], edges)
                        jump = _pull(*here, bending, moment, piece, k)
                        jump -= _pull(*here, bending, moment, piece + 1, k)
                        force[i, k, j] += weight * jump
            force[i, leader] -= force[i, k]
    return force


@compiled
def pressure(lengths, overlap, bends, turns, axial, start, ways, coefficient):
    """Lateral forces of each device on the lumen of the next one, and friction.

    The force of a device with the moment M and the compression P is M'' + Pκ per
    length. P is EI (κ² - κ_k²)/2, the axial forces of the joints distal of the place,
    and their friction.

    Args:
        lengths: (L,), of the links, m.
        axial: (N, K, J), see `axial`, N.
        start: (N, K), compression where each device leaves the others, N.
        ways: (N, K - 1) in [-1, 1], fraction of the friction that acts on device k,
            positive when it slides forward in the next one.
        coefficient: Coulomb coefficient between the devices.

    Returns:
        (N, K - 1, J), force of device k on device k + 1 at the joints, N, and
        (N, K - 1), the axial force that their friction demands of device k, N.
    """
    stiffness, moment, present = overlap.stiffness, overlap.moment, overlap.present
    count, devices, joints = turns.shape
    force = np.empty((count, devices - 1, joints))
    drag = np.zeros((count, devices - 1))
    own = np.empty(joints, np.complex128)
    shear = np.zeros(joints, np.complex128)
    for i in range(count):
        for k in range(devices - 1):
            for j in range(joints):
                span = (lengths[j] + lengths[j + 1]) / 2
                own[j] = stiffness[i, k, j] * bends[i, j] / span
                own[j] -= moment[i, k, j] * unit(turns[i, k, j])
            for j in range(joints - 1):
                shear[j] = (own[j + 1] - own[j]) / lengths[j + 1]
            # Compression of the device, from its end on.
            pushed = start[i, k]
            for j in range(joints - 1, -1, -1):
                span = (lengths[j] + lengths[j + 1]) / 2
                pushed += axial[i, k, j]
                here = pushed
                if stiffness[i, k, j] > 0.0:
                    square = abs(stiffness[i, k, j] * bends[i, j] / span) ** 2
                    square -= moment[i, k, j] ** 2
                    here += square / (2 * stiffness[i, k, j])
                lateral = shear[j] + here * bends[i, j]
                if j > 0:
                    lateral -= shear[j - 1]
                # Only where both devices are present: the mean of both links.
                both = (present[i, k + 1, j] + present[i, k + 1, j + 1]) / 2
                force[i, k, j] = abs(lateral) * both
                rubbing = ways[i, k] * coefficient * force[i, k, j]
                pushed += rubbing
                drag[i, k] += rubbing
    return force, drag


@compiled
def wall_friction(arms, overlap, force, coefficient):
    """Limits (N, K, J) of the friction torque of the wall on the devices, N·m.

    Each joint has half of its two links.

    Args:
        force: (N, L), force of the wall on the links, N.
        coefficient: (N,), Coulomb coefficient of an uncoated device on the wall.
    """
    outermost = overlap.outermost
    count, devices, links = outermost.shape
    torque = np.empty((count, devices, links - 1))
    for i in range(count):
        for k in range(devices):
            for j in range(links - 1):
                # The last joint bears all of the last link.
                last = 1.0 if j == links - 2 else 0.5
                borne = 0.5 * outermost[i, k, j] * force[i, j]
                borne += last * outermost[i, k, j + 1] * force[i, j + 1]
                torque[i, k, j] = coefficient[i] * arms[k] * borne
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
def links(outermost, present, lengths, friction, radii, ratios, densities):
    """Properties of the links, see `coaxial.Links` and `Stack`."""
    count, devices, number = outermost.shape
    made, moments = np.zeros((4, count, number)), np.empty((count, number, 2))
    carried = densities[2, devices - 1] + densities[3].sum()
    share = densities[1].sum() / (densities[0].sum() + carried)
    for i in range(count):
        for link in range(number):
            radius = mass = weight = 0.0
            whole = True
            for k in range(devices):
                outside, there = outermost[i, k, link], present[i, k, link]
                radius += outside * radii[k]
                made[1, i, link] += outside * ratios[k] * friction[i]
                carried = outside * densities[2, k] + there * densities[3, k]
                mass += (there * densities[0, k] + carried) * lengths[link]
                weight += there * densities[1, k] * lengths[link]
                whole = whole and there == 1.0
            made[0, i, link], made[2, i, link] = radius, mass
            # Exactly 0 where all devices are present: MuJoCo then skips the link.
            if share > 0.0 and not whole:
                made[3, i, link] = 1.0 - weight / (mass * share)
            moments[i, link] = _inertia(mass, radius, lengths[link])
    return made[0], made[1], made[2], made[3], moments
