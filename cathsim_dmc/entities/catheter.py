"""The catheter: a chain of rigid links with the bending stiffness of a real device."""

import numpy as np

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.arena import BLOOD_DENSITY
from cathsim_dmc.entities.chain import TIMESTEP, Chain, Links
from cathsim_dmc.entities.coaxial import carried_mass
from cathsim_dmc.entities.contact import device_contact

# Lag of the drives of the tip, s. It has no source; with 0.05 s, noise on the motors
# whips the tip into the wall (docs/soak.md).
STEERING_LAG = 0.2


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
        name: str = "catheter",
    ):
        """Builds the chain.

        Args:
            device: a device, or its name in `devices.DEVICES`.
            discretisation: division into links.
            stroke: longest insertion, m.
            rotation: whether the base has a rotation joint.
            friction: Coulomb coefficient; MuJoCo takes the larger of the two geoms'.
            timestep: physics step with which the chain will be simulated, s.
            name: name of the entity.
        """
        self._device = devices.get(device)
        self._discretisation = discretisation or devices.Discretisation()
        self._lengths = self._discretisation.link_lengths(self._device)
        self._first = len(self._lengths) - self._device.tip_links  # of the tip
        joints = range(1, len(self._lengths))
        links = Links(
            self._lengths,
            self._device.outer_radius,
            masses=(self._moved_mass * self._lengths).tolist(),
            compliances=[self._joint_compliance(index) for index in joints],
            rest_angles=[(0.0, self._rest_angle(index)) for index in joints],
            axial_stiffness=self._device.axial_stiffness,
            tip=self._first,
            twists=self._torsion_hinges(),
        )
        self._assemble(
            links,
            device_contact(friction),
            stroke=stroke,
            rotation=rotation,
            timestep=timestep,
            name=name,
        )

    def _section(self, index: int) -> devices.Section:
        return self._device.tip if index >= self._first else self._device.shaft

    def _joint_compliance(self, index: int) -> float:
        """Bending compliance of a joint, rad/(N·m): that of two half links."""
        return sum(
            self._lengths[neighbour] / 2 / self._section(neighbour).bending_stiffness
            for neighbour in (index - 1, index)
        )

    def _torsion_hinges(self) -> dict[int, float]:
        """Compliance of the torsion hinges, rad/(N·m), by link.

        The hinges divide the joints of the chain evenly. Each one lies in the middle
        of its part and has the compliance of all of it, ∫ds/GJ; the last one includes
        the distal half link.
        """
        count = self._discretisation.torsion_joints
        last = len(self._lengths) - 1
        if count > last:
            raise ValueError(
                f"torsion_joints is {count}, but the chain has {last} joints"
            )
        if count == 0:
            return {}
        half = np.array(
            [
                length / 2 / self._section(index).torsional_stiffness
                for index, length in enumerate(self._lengths)
            ]
        )
        joints = half[:-1] + half[1:]
        joints[-1] += half[-1]
        edges = np.linspace(0, last, count + 1)
        total = np.interp(
            edges, np.arange(last + 1), np.concatenate([[0.0], np.cumsum(joints)])
        )
        links = np.round((edges[:-1] + edges[1:]) / 2 + 0.5).astype(int)
        return dict(zip(links.tolist(), np.diff(total).tolist(), strict=True))

    def _rest_angle(self, index: int) -> float:
        start = self._lengths[index - 1 :].sum() - self._lengths[index - 1] / 2
        stop = self._lengths[index:].sum() - self._lengths[index] / 2
        return self._device.rest_angle(start, stop)

    @property
    def _moved_mass(self) -> float:
        """Mass per length that moves with the device across its axis, kg/m."""
        return self._device.linear_density + carried_mass(self.devices)

    def _build_motors(self):
        self._tip_motors = []
        if self._device.steerable:
            for index in range(self._first, len(self._lengths)):
                # This torque bends the free joint by the steering angle: a motor shifts
                # the rest shape and adds no stiffness.
                torque = self._device.steering_angle / self._joint_compliance(index)
                for axis in ("x", "y"):
                    joint = self._mjcf_root.find("joint", f"bend_{axis}_{index}")
                    self._tip_motors.append(
                        self._mjcf_root.actuator.add(
                            "general",
                            name=f"tip_{axis}_{index - self._first}",
                            joint=joint,
                            ctrllimited=True,
                            ctrlrange=(-1, 1),
                            dyntype="filterexact",
                            dynprm=[STEERING_LAG],
                            gainprm=[torque],
                        )
                    )
        super()._build_motors()

    @property
    def device(self) -> devices.Device:
        """The device."""
        return self._device

    @property
    def devices(self) -> tuple[devices.Device, ...]:
        """The device, as a tuple of one."""
        return (self._device,)

    @property
    def density(self) -> float:
        """Effective density, kg/m³: with the mass moved, its buoyancy in blood."""
        displaced = BLOOD_DENSITY * np.pi * self._device.outer_radius**2
        weight = max(0.0, self._device.linear_density - displaced)
        return BLOOD_DENSITY / (1 - weight / self._moved_mass)

    @property
    def tip_motors(self) -> tuple:
        """Motors of the tip from proximal to distal, x before y."""
        return tuple(self._tip_motors)
