"""Coaxial devices: where they overlap, and the chain that represents them.

docs/pair_model.md derives the equations. Functions of one simulation; K devices, J
joints, L = J + 1 links, P pairs of devices. `gaps` (K,), distance from the end of each
device to the end of the chain, m; `turns` (K, J), rotation of each device at each
joint, rad; `bends` (J,) complex, bending angles of the joints, rad.
"""

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
        moment: (K, E + 1), EI κ likewise, N·m.
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
    """Posture of the devices: `gaps`, `bends` and `turns`, see the module."""

    gaps: Any
    bends: Any
    turns: Any


class Scratch(NamedTuple):
    """Scratch arrays of the laws.

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
        buoyancy: additional fraction of the link's weight that buoyancy cancels
            (`gravcomp`); gravity contains the buoyancy of all devices together.
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
    """Writes the sorted distances from the end of the chain where a piece begins, m."""
    count = 0
    for k in range(edges.shape[0]):
        for e in range(edges.shape[1]):
            place, rank = min(gaps[k] + edges[k, e], _FAR), count
            while rank > 0 and places[rank - 1] > place:
                places[rank] = places[rank - 1]
                rank -= 1
            places[rank] = place
            count += 1
    places[count] = _FAR


@compiled
def piece_at(place, edges):
    """Column of `Tables.bending` at a distance from the end of a device, m."""
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
            piece = piece_at((low + high) / 2 - gaps[k], edges[k])
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
        # Wherever an outer device is present, it covers the inner ones.
        covered = 0.0
        for k in range(devices - 1, -1, -1):
            reached = (nodes[link] - gaps[k]) / lengths[link]
            reached = min(max(reached, 0.0), 1.0)
            out.present[k, link] = reached
            out.outermost[k, link] = max(reached - covered, 0.0)
            covered = max(covered, reached)


@compiled
def rest_angles(rest, turns, out):
    """Writes the rest angles (J,) complex of the joints, rad, from `Overlap.rest`."""
    for j in range(len(out)):
        whole = rest[0, j] * unit(turns[0, j])
        for k in range(1, len(turns)):
            whole += rest[k, j] * unit(turns[k, j])
        out[j] = whole


@compiled
def _inertia(mass, radius, length):
    """Moments of inertia of a solid capsule, across and along it, kg·m²."""
    share = 1 / (1 + 4 * radius / (3 * length))  # volume fraction of the cylinder
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
