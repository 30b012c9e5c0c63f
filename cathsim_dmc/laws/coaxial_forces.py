"""Forces between coaxial devices, see `laws.coaxial` for names and shapes.

docs/pair_model.md derives the equations.
"""

import math
from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.coaxial import piece_at
from cathsim_dmc.laws.hinges import unit


class Lumen(NamedTuple):
    """Loads of coaxial devices within the lumens.

    Attributes:
        start: (K,), axial compression of each device where it leaves the others, N.
        ways: (K - 1,) in [-1, 1], fraction of the full friction that acts on device k,
            positive when it slides forward in the next one.
        coefficient: Coulomb coefficient between the devices.
        factor: Factor of all stiffnesses.
    """

    start: Any
    ways: Any
    coefficient: Any
    factor: Any


@compiled
def restoring(overlap, posture, scratch, torque, rate):
    """Writes the restoring torques of the devices' shapes, and their stiffness.

    The energy of a joint bent by θ is |θ - Σ R_k e_k|²/2C, e_k = exp(iφ_k), and that of
    two devices against each other -S cos(φ_k - φ_l).

    Args:
        overlap: `Overlap`.
        posture: `Posture`.
        scratch: `Scratch`.
        torque: (K, J), gets the torque on each device about its axis, N·m.
        rate: (K, J), gets its negative derivative by the rotation, N·m/rad.
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
            here = piece_at(place - posture.gaps[k], tables.edges[k])
        bending, moment = tables.bending[k, here], tables.moment[k, here]
        if bending > 0.0:
            total += bending
            whole += moment * unit(posture.turns[k, joint])
            own += moment**2 / bending
    return (abs(whole) ** 2 / total - own) / 2


@compiled
def axial(tables, overlap, posture, slopes, scratch, force):
    """Writes the axial forces at the joints, positive where a device must be pushed.

    They are the negative derivative of the energy by the gap of a device, at given
    bends and rotations. That of the leading device is the negative sum of the others.

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
            # The joints at both ends of the link share its bending.
            for j, weight in ((link - 1, share), (link, 1 - share)):
                if 0 <= j < joints:
                    jump = _pull(place, loads[j], posture, tables, j, k, piece)
                    jump -= _pull(place, loads[j], posture, tables, j, k, piece + 1)
                    force[k, j] += weight * jump
        for j in range(joints):
            force[leader, j] -= force[k, j]


@compiled
def pressure(tables, overlap, posture, axial, lumen, scratch, force, drag):
    """Writes the lateral forces of each device on the lumen around it, and friction.

    With the moment M and the compression P, the force per length is M'' + P κ.

    Args:
        tables: `Tables`.
        overlap: `Overlap`.
        posture: `Posture`.
        axial: (K, J), see `axial`, N.
        lumen: `Lumen`.
        scratch: `Scratch`.
        force: (K - 1, J), gets the force of device k on device k + 1 at the joints, N.
        drag: (K - 1,), gets the axial force on device k that overcomes friction, N.
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
        # Axial compression of the device, summed up from its distal end.
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
            # Only the fraction of both links on which both devices are present.
            present = overlap.present[k + 1]
            force[k, j] = abs(lateral) * ((present[j] + present[j + 1]) / 2)
            rubbing = lumen.ways[k] * lumen.coefficient * force[k, j]
            pushed += rubbing
            drag[k] += rubbing


@compiled
def wall_friction(arms, outermost, force, coefficient, torque):
    """Writes limits (K, J) of the friction torque of the wall on the devices, N·m.

    The arms (K,) are radius times friction ratio, m; the forces (L,) act on links, N.
    """
    devices, links = outermost.shape
    for k in range(devices):
        for j in range(links - 1):
            # The last joint bears all of the last link.
            last = 1.0 if j == links - 2 else 0.5
            borne = 0.5 * outermost[k, j] * force[j]
            borne += last * outermost[k, j + 1] * force[j + 1]
            torque[k, j] = coefficient * arms[k] * borne
