"""The catheter: a chain of rigid links with the bending stiffness of a real device."""

import numpy as np

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.arena import BLOOD_DENSITY
from cathsim_dmc.entities.chain import TIMESTEP, TORSION_ARMATURE, Chain
from cathsim_dmc.entities.coaxial import carried_mass

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
        self._twists = []
        self._twist_compliances = self._torsion_hinges()
        self._assemble(
            self._lengths,
            self._device.outer_radius,
            stroke=stroke,
            rotation=rotation,
            friction=friction,
            timestep=timestep,
            name=name,
        )

    def _in_tip(self, index: int) -> bool:
        return index >= len(self._lengths) - self._device.tip_links

    def _section(self, index: int) -> devices.Section:
        return self._device.tip if self._in_tip(index) else self._device.shaft

    def _joint_compliance(self, index: int) -> float:
        """Bending compliance of a joint, rad/(N·m).

        A joint stands for the half links on both of its sides, l/2EI each.
        """
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

    def _axial_stiffness(self) -> float:
        return self._device.axial_stiffness

    def _rest_angles(self, index: int) -> tuple[float, float]:
        start = self._lengths[index - 1 :].sum() - self._lengths[index - 1] / 2
        stop = self._lengths[index:].sum() - self._lengths[index] / 2
        return 0.0, self._device.rest_angle(start, stop)

    def _link_mass(self, index: int) -> float:
        return self._moved_mass * self._lengths[index]

    @property
    def _moved_mass(self) -> float:
        """Mass per length that moves with the device across its axis, kg/m."""
        return self._device.linear_density + carried_mass(self.devices)

    def _add_twist(self, link, index: int) -> None:
        compliance = self._twist_compliances.get(index)
        if compliance is None:
            return
        twist = 1 / compliance
        self._twists.append(
            link.add(
                "joint",
                name=f"twist_{index}",
                axis=(0, 0, 1),
                stiffness=twist,
                damping=self._relaxation_time * twist,
                armature=TORSION_ARMATURE,
            )
        )

    def _build_motors(self):
        self._tip_motors = []
        if self._device.steerable:
            first = len(self._lengths) - self._device.tip_links
            for index in range(first, len(self._lengths)):
                # This torque bends the free joint by the steering angle: a motor shifts
                # the rest shape and adds no stiffness.
                compliance = self._joint_compliance(index)
                torque = self._device.steering_angle / compliance
                for axis in ("x", "y"):
                    joint = self._mjcf_root.find("joint", f"bend_{axis}_{index}")
                    self._tip_motors.append(
                        self._mjcf_root.actuator.add(
                            "general",
                            name=f"tip_{axis}_{index - first}",
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
    def hinges(self) -> tuple:
        """Hinges that represent the bending and torsion of the rod."""
        return (*self.bends, *self._twists)

    @property
    def tip_motors(self) -> tuple:
        """Motors of the tip from proximal to distal, x before y."""
        return tuple(self._tip_motors)
