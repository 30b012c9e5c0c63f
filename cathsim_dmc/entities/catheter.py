"""The catheter: a chain of rigid links with the bending stiffness of a real device."""

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.armature import hinge_armatures
from cathsim_dmc.entities.chain import TIMESTEP, Chain, Links
from cathsim_dmc.entities.coaxial import effective_density, moved_mass
from cathsim_dmc.entities.contact import device_contact


class Catheter(Chain):
    """One device: pushed at its base, optionally rotated and steered at its tip."""

    def _build(
        self,
        device: str | devices.Device = "steerable_5f",
        discretisation: devices.Discretisation | None = None,
        *,
        stroke: float = 0.25,
        rotation: bool = False,
        friction: float = 0.0,
        timestep: float = TIMESTEP,
    ):
        """Builds the chain.

        Args:
            device: a device, or its name in `devices.DEVICES`.
            discretisation: division into links.
            stroke: longest insertion, m.
            rotation: whether the base has a rotation joint.
            friction: Coulomb coefficient; MuJoCo takes the larger of the two geoms'.
            timestep: physics step with which the chain will be simulated, s.
        """
        device = devices.get(device)
        self.devices = (device,)
        division = devices.discretised(discretisation)
        lengths = division.link_lengths(device)
        first = len(lengths) - device.tip_links
        # A joint bends like two half links.
        half = _half_compliances(device, lengths, "bending_stiffness")
        compliances = half[:-1] + half[1:]
        self.density = effective_density(self.devices)
        # These torques bend free joints by the steering angle.
        torques = device.steering_angle / compliances
        steered = range(first, len(lengths) if device.steerable else first)
        self._assemble(
            Links(
                lengths,
                device.outer_radius,
                masses=(moved_mass(self.devices) * lengths).tolist(),
                compliances=compliances.tolist(),
                armatures=hinge_armatures(device, lengths).tolist(),
                rest_angles=[(0.0, each) for each in device.rest_angles(lengths)],
                axial_stiffness=device.axial_stiffness,
                tip=first,
                steering={index: torques[index - 1] for index in steered},
                twists=_twists(device, lengths, division.torsion_joints),
            ),
            device_contact(friction),
            stroke=stroke,
            rotation=rotation,
            timestep=timestep,
        )
        self.distal_shares = half[1:] / compliances


def _half_compliances(device: devices.Device, lengths: np.ndarray, of: str):
    """Compliances (n,) of half of each link in bending or torsion, rad/(N·m)."""
    in_tip = np.arange(len(lengths)) >= len(lengths) - device.tip_links
    stiffness = np.where(in_tip, getattr(device.tip, of), getattr(device.shaft, of))
    return lengths / 2 / stiffness


def _twists(device: devices.Device, lengths: np.ndarray, count: int):
    """Compliances ∫ds/GJ of evenly spread torsion hinges, rad/(N·m), by link."""
    last = len(lengths) - 1
    bounds.whole("torsion_joints", count, 0, last)  # one at each joint
    if count == 0:
        return {}
    half = _half_compliances(device, lengths, "torsional_stiffness")
    joints = half[:-1] + half[1:]
    joints[-1] += half[-1]
    edges = np.linspace(0, last, count + 1)
    sums = np.concatenate([[0.0], np.cumsum(joints)])
    total = np.interp(edges, np.arange(last + 1), sums)
    links = np.round((edges[:-1] + edges[1:]) / 2 + 0.5).astype(int)
    return dict(zip(links.tolist(), np.diff(total).tolist(), strict=True))
