"""Coaxial devices: the properties of the chain that represents them.

docs/pair_model.md has the equations. Devices are numbered from the innermost outwards;
device k ends `gap_k` before the end of the chain. Directions across the chain are
complex numbers x + iy in frames that do not twist along it: a joint bent by a small
`bend_y` about y and `bend_x` about x leads towards bend_y - i bend_x, and a rotation by
φ about the device multiplies by exp(iφ). The frames of the links twist, because two
hinges do (`laws.hinges.bent`).
"""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc.compiled import interpreted
from cathsim_dmc.entities import stack_memory
from cathsim_dmc.entities.arena import BLOOD_DENSITY
from cathsim_dmc.entities.device import Device
from cathsim_dmc.laws import coaxial as laws


class Stack:
    """Coaxial devices on one chain of links.

    Attributes:
        devices: devices from the innermost outwards.
        link_lengths: (L,), from proximal to distal, m.
        nodes: (L + 1,), distances of the ends of the links from the end of the chain,
            from proximal to distal, m.
        spans: (J,), length of rod of each joint, half of its two links, m.
        tables: Sections of the devices along the chain.
        sections: Outer sections of the devices.
        arms: (K,), radius of each device times its friction ratio, m.
    """

    def __init__(self, devices: Sequence[Device], link_lengths: np.ndarray):
        """Tabulates the sections of the devices.

        Raises:
            ValueError: if `devices` is empty, or one does not fit into the next.
        """
        _check_fit(devices)
        self.devices = tuple(devices)
        self.link_lengths = np.asarray(link_lengths, dtype=np.float64)
        beyond = np.cumsum(self.link_lengths[::-1])[::-1]
        self.nodes = np.append(beyond, 0.0)
        self.spans = (self.link_lengths[:-1] + self.link_lengths[1:]) / 2
        count = len(devices)
        pieces = [_pieces(device) for device in self.devices]
        most = max(len(edges) for edges, _, _ in pieces)
        edges = np.full((count, most), np.inf)
        bending, moment = np.zeros((2, count, most + 1))
        for k, (starts, stiffness, moments) in enumerate(pieces):
            edges[k, : len(starts)] = starts
            bending[k, 1 : len(starts) + 1] = stiffness
            moment[k, 1 : len(starts) + 1] = moments
        self.tables = laws.Tables(self.nodes, self.link_lengths, edges, bending, moment)
        radii = np.array([device.outer_radius for device in devices])
        ratios = np.array([device.friction_ratio for device in devices])
        outer = [_disc(device.outer_radius) for device in devices]
        inner = [_disc(device.inner_radius) for device in devices]
        masses = [device.linear_density for device in devices]
        weights = [weight_density(device) for device in devices]
        carried = 2 * np.array(outer), np.subtract(inner, outer)
        densities = np.array([masses, weights, *carried])
        self.sections = laws.Sections(radii, ratios, densities)
        self.arms = ratios * radii

    def overlap(self, gaps: ArrayLike) -> laws.Overlap:
        """`Overlap` of devices whose ends are `gaps` (K,) from the chain's end, m."""
        found, scratch = stack_memory.overlap(self.tables), stack_memory.scratch
        gaps = np.array(gaps, np.float64)
        interpreted(laws.overlap)(gaps, self.tables, scratch(self.tables), found)
        return found

    def links(self, overlap: laws.Overlap, friction: float) -> laws.Links:
        """`Links` for a Coulomb coefficient of an uncoated device on the wall."""
        found = stack_memory.links(self.tables)
        lengths, sections = self.link_lengths, self.sections
        interpreted(laws.links)(overlap, lengths, friction, sections, found)
        return found


def _disc(radius: float) -> float:
    """Mass per length of a cylinder of blood, kg/m."""
    return BLOOD_DENSITY * np.pi * radius**2


def carried_mass(devices: Sequence[Device]) -> float:
    """Added mass of blood per length of coaxial devices, kg/m.

    Across its axis, a cylinder moves as much blood around it as it displaces (potential
    flow), and all blood in its lumen.
    """
    lumens = [_disc(device.inner_radius) for device in devices]
    filled = [_disc(device.outer_radius) for device in devices[:-1]]
    return _disc(devices[-1].outer_radius) + sum(lumens) - sum(filled)


def moved_mass(devices: Sequence[Device]) -> float:
    """Mass per length that coaxial devices move across their axis, kg/m."""
    return sum(device.linear_density for device in devices) + carried_mass(devices)


def effective_density(devices: Sequence[Device]) -> float:
    """Density, kg/m³, that gives a chain the buoyancy of all its devices."""
    weight = sum(weight_density(device) for device in devices)
    return BLOOD_DENSITY / (1 - weight / moved_mass(devices))


def weight_density(device: Device) -> float:
    """Mass per length less that of the displaced blood, kg/m; blood fills the lumen."""
    section = np.pi * (device.outer_radius**2 - device.inner_radius**2)
    return max(0.0, device.linear_density - BLOOD_DENSITY * section)


def _pieces(device: Device) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starts of uniform pieces, m from the end; their EI and EI κ, κ > 0 towards +x."""
    curved, end = [], 0.0
    for arc in reversed(device.tip_shape):
        curved.append((end, end + arc.length, np.copysign(1 / arc.radius, arc.angle)))
        end += arc.length
    starts = {0.0, device.tip_length, *(each for arc in curved for each in arc[:2])}
    edges = np.array(sorted(starts))
    tip, shaft = device.tip.bending_stiffness, device.shaft.bending_stiffness
    bending = np.where(edges < device.tip_length, tip, shaft)
    curvature = np.zeros(len(edges))
    for start, stop, value in curved:
        curvature[(edges >= start) & (edges < stop)] = value
    return edges, bending, bending * curvature


def _check_fit(devices: Sequence[Device]) -> None:
    if not devices:
        raise ValueError("there is no device in devices; give at least one")
    for inner, outer in itertools.pairwise(devices):
        if not inner.outer_radius < outer.inner_radius:
            lumen = f"has a lumen of {2e3 * outer.inner_radius:.3g} mm"
            raise ValueError(
                f"device {inner.name!r} is {2e3 * inner.outer_radius:.3g} mm thick, "
                f"but {outer.name!r} around it "
                f"{'is solid' if outer.is_wire else lumen}; give devices from the "
                "innermost outwards, each thinner than the lumen of the next"
            )
