"""Coaxial devices in the simulation: guidewire, guidewire in catheter, and so on."""

from collections.abc import Sequence

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.compiled import interpreted
from cathsim_dmc.entities import devices as library
from cathsim_dmc.entities.armature import hinge_armatures
from cathsim_dmc.entities.chain import TIMESTEP, Chain, Links
from cathsim_dmc.entities.coaxial import Stack, effective_density
from cathsim_dmc.entities.contact import FRICTION, MOST_FRICTION, device_contact
from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.torsion import rods_of
from cathsim_dmc.laws.hinges import unloaded_hinges

# Coulomb coefficient between a device and the lined lumen around it (Lin 2020).
LUMEN_FRICTION = 0.04
# Distance by which each device starts ahead of the one around it, m.
LEAD = 0.03


class DeviceStack(Chain):
    """Coaxial devices, each pushed and turned at its base, on one chain of links.

    The chain ends where the leading device does, the one that reaches farthest. Its
    single motor drives that device. `physics.sliding` moves the devices and writes the
    properties of the links once per control step. An action has two entries for each
    device, from the innermost outwards: translation and rotation.

    Attributes:
        device_names: Kind of each device, such as "guidewire" and "catheter".
        stack: Properties of the chain as functions of insertions and rotations.
        rods: Torsional rods of the devices.
        start_gaps: (K,), distances of the devices' ends from the end of the chain at
            start, m.
        friction: Coulomb coefficient of an uncoated device on the wall.
        lumen_friction: Coulomb coefficient between a device and the lumen around it.
    """

    coaxial = True

    def _build(
        self,
        devices: Sequence[str | Device] = ("wire_035_glide", "berenstein_5f"),
        discretisation: library.Discretisation | None = None,
        *,
        stroke: float = 0.25,
        lead: float = LEAD,
        friction: float = FRICTION,
        lumen_friction: float = LUMEN_FRICTION,
        timestep: float = TIMESTEP,
    ):
        """Builds the chain.

        Args:
            devices: devices from the innermost outwards, or their names in
                `devices.DEVICES`.
            stroke: longest insertion, m.
            lead: distance by which each device starts ahead of the one around it, m.
            friction: Coulomb coefficient of an uncoated device on the wall.
            lumen_friction: Coulomb coefficient between a device and the lumen around
                it.
            timestep: physics step with which the chain will be simulated, s.

        Raises:
            ValueError: if a device does not fit into the next one, or is steerable.
        """
        bounds.number("lead", lead, 0.0, unit="m")
        bounds.number("lumen_friction", lumen_friction, 0.0, MOST_FRICTION)
        self.devices = _passive(devices)
        division = library.discretised(discretisation)
        self.friction, self.lumen_friction = friction, lumen_friction
        self.stack = Stack(self.devices, division.link_lengths(*self.devices))
        self.rods = rods_of(self.devices, self.stack.nodes)
        self.start_gaps = lead * np.arange(len(self.devices), dtype=np.float64)
        overlap = self.stack.overlap(self.start_gaps)
        rest = np.empty((len(self.stack.spans), 2))
        bends = overlap.rest.sum(axis=0).astype(complex)
        interpreted(unloaded_hinges)(bends, rest)
        # Any device may lead, so each hinge has the least armature of all devices.
        alone = [hinge_armatures(one, self.stack.link_lengths) for one in self.devices]
        tip = self.stack.nodes <= self.devices[0].tip_length + 1e-9
        self.density = effective_density(self.devices)
        self._assemble(
            Links(
                self.stack.link_lengths,
                # The largest radius, so that the bounding volumes enclose all devices.
                max(device.outer_radius for device in self.devices),
                masses=self.stack.links(overlap, 0.0).mass.tolist(),
                compliances=overlap.compliance.tolist(),
                armatures=np.min(alone, axis=0).tolist(),
                rest_angles=[(x, y) for x, y in rest.tolist()],
                axial_stiffness=sum(device.axial_stiffness for device in self.devices),
                tip=int(tip.argmax()),
            ),
            {**device_contact(friction), "priority": 1},  # overrides the wall's
            stroke=stroke,
            rotation=False,
            timestep=timestep,
        )
        self.device_names = _names(self.devices)
        self.action_names = tuple(
            f"{name}/{motion}"
            for name in self.device_names
            for motion in ("insertion", "rotation")
        )
        self.translations = tuple(range(0, len(self.action_names), 2))


def _passive(given: Sequence[str | Device]) -> tuple[Device, ...]:
    """Devices as given or by name; ValueError if one is steerable, or for none."""
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        wanted = "names of devices from the innermost outwards, at least one"
        bounds.refuse("devices", given, wanted)
    devices = tuple(library.get(device) for device in given)
    for device in devices:
        if device.steerable:
            raise ValueError(
                f"device {device.name!r} has motors in its tip, but coaxial devices "
                "must be passive; give a passive one, or the option `device` for a "
                "single steerable device"
            )
    return devices


def _names(devices: Sequence[Device]) -> tuple[str, ...]:
    names: list[str] = []
    for device in devices:
        kind = "guidewire" if device.is_wire else "catheter"
        again = sum(name.startswith(kind) for name in names)
        names.append(f"{kind}_{again + 1}" if again else kind)
    return tuple(names)
