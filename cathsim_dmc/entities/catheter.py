"""The catheter: a chain of rigid links with the bending stiffness of a real device."""

import numpy as np
from dm_control import composer, mjcf

from cathsim_dmc.entities import devices
from cathsim_dmc.entities.contact import device_contact

# Relaxation time of bending: joint damping = time * stiffness, s. It lumps the loss
# inside the polymer with the drag of blood: a 0.2 m cantilever of 50 N·mm² with a drag
# of 0.15 N·s/m² relaxes in c L⁴ / (12.4 EI) = 0.4 s. With half of it, a buckled shaft
# that snaps through outruns steps of 4 ms (docs/soak.md).
BENDING_RELAXATION_TIME = 0.4
# Rotor inertia of the hinges, kg·m². Next to the damping it acts within 2 ms, far
# below the relaxation time, and it gives the contact solver the scale of mass at
# which the wall is as hard as silicone (docs/physics.md).
HINGE_ARMATURE = 1e-6
# The same of the torsion hinges. They are softer: more would delay the twist by more
# than a few milliseconds.
TORSION_ARMATURE = 1e-7
# Lag of the drives of the tip, s.
STEERING_LAG = 0.05

CARRIAGE_MASS = 0.2  # kg, platform of the follower that pushes the device
MAX_PUSH_FORCE = 5.0  # N, slip of the clamps
MAX_PUSH_SPEED = 0.04  # m/s
CARRIAGE_GAIN = 100.0  # N·s/m, stiff: 1 N of load costs 1 cm/s

# The links are rigid; the axial compliance of the whole device, L / EA, sits in a
# spring at its base. Without it a jam stops the carriage within a step, and the push
# force chatters. Damping ratio of the carriage on that spring.
COMPRESSION_DAMPING = 0.5
COMPRESSION_ARMATURE = 1e-3  # kg, about the mass of the device

# Rotary unit as seen by the device, kg·m²: a 0.3 kg clamp of 2 cm. The bounded torque
# then changes the speed by less in a time step than the range in which the servo is
# linear (4 rad/s); a rotor 100 times lighter went bang-bang between 0 and 80 rad/s.
ROTOR_INERTIA = 1e-4
MAX_TORQUE = 0.02  # N·m
MAX_ROTATION_SPEED = 3.14  # rad/s
ROTATION_GAIN = 0.01  # N·m·s/rad

_VISIBLE_SHAFT = 0.45  # m of device behind the simulated part, at full insertion
_COLOUR = (0.85, 0.32, 0.08, 1.0)
_TIP_COLOUR = (0.95, 0.75, 0.1, 1.0)


class Catheter(composer.Entity):
    """A serial chain of links; +z of every link points to the distal end.

    The origin of the entity is the place of the distal end at zero insertion.
    """

    def _build(
        self,
        device: str | devices.Device = "steerable_5f",
        discretisation: devices.Discretisation | None = None,
        *,
        stroke: float = 0.25,
        rotation: bool = False,
        friction: float = 0.0,
        name: str = "catheter",
    ):
        """Builds the chain.

        Args:
          device: what it is made of, or its name in `devices.DEVICES`.
          discretisation: how it is divided into links.
          stroke: longest insertion, m.
          rotation: whether the base can be rotated.
          friction: Coulomb coefficient; MuJoCo takes the larger of the two bodies'.
          name: of the entity.
        """
        self._device = devices.get(device)
        self._discretisation = discretisation or devices.Discretisation()
        self._stroke = stroke
        if not stroke > 0:
            raise ValueError(f"stroke is {stroke} m; it must be positive")
        self._lengths = self._discretisation.link_lengths(self._device)
        self._mjcf_root = mjcf.RootElement(model=name)
        self._mjcf_root.compiler.angle = "radian"
        self._contact = device_contact(friction)
        self._links = []
        self._link_geoms = []
        self._bends = []
        self._twists = []
        self._twist_compliances = self._torsion_hinges()
        self._build_base(rotation)
        for index in range(1, len(self._lengths)):
            self._build_link(index)
        self._head = self._links[-1].add(
            "site",
            name="head",
            pos=(0, 0, self._lengths[-1]),
            size=[self._device.outer_radius],
            rgba=_TIP_COLOUR,
            group=4,
        )
        self._build_motors()
        self._build_sensors()

    def _build_base(self, rotation: bool):
        base = self._mjcf_root.worldbody.add(
            "body", name="link_0", pos=(0, 0, -self._lengths.sum())
        )
        self._insertion = base.add(
            "joint",
            name="insertion",
            type="slide",
            axis=(0, 0, 1),
            armature=CARRIAGE_MASS,
            limited=True,
            range=(0.0, self._stroke),
        )
        stiffness = self._device.axial_stiffness / self._lengths.sum()
        base.add(
            "joint",
            name="compression",
            type="slide",
            axis=(0, 0, 1),
            stiffness=stiffness,
            damping=2 * COMPRESSION_DAMPING * (stiffness * CARRIAGE_MASS) ** 0.5,
            armature=COMPRESSION_ARMATURE,
        )
        self._rotation = None
        if rotation:
            self._rotation = base.add(
                "joint",
                name="rotation",
                type="hinge",
                axis=(0, 0, 1),
                armature=ROTOR_INERTIA,
            )
        self._links.append(base)
        self._add_capsule(base, 0)
        # The rest of the device, which the follower holds; for looks only.
        base.add(
            "geom",
            name="shaft",
            type="capsule",
            fromto=(0, 0, -_VISIBLE_SHAFT - self._stroke, 0, 0, 0),
            size=[self._device.outer_radius],
            mass=0,
            contype=0,
            conaffinity=0,
            group=2,
            rgba=_COLOUR,
        )

    def _build_link(self, index: int):
        link = self._links[-1].add(
            "body", name=f"link_{index}", pos=(0, 0, self._lengths[index - 1])
        )
        self._links.append(link)
        stiffness = 1 / self._joint_compliance(index)
        start = self._lengths[index - 1 :].sum() - self._lengths[index - 1] / 2
        stop = self._lengths[index:].sum() - self._lengths[index] / 2
        rest = self._device.rest_angle(start, stop)
        twist_compliance = self._twist_compliances.get(index)
        if twist_compliance is not None:
            twist = 1 / twist_compliance
            self._twists.append(
                link.add(
                    "joint",
                    name=f"twist_{index}",
                    axis=(0, 0, 1),
                    stiffness=twist,
                    damping=BENDING_RELAXATION_TIME * twist,
                    armature=TORSION_ARMATURE,
                )
            )
        for axis, direction in (("x", (1, 0, 0)), ("y", (0, 1, 0))):
            self._bends.append(
                link.add(
                    "joint",
                    name=f"bend_{axis}_{index}",
                    axis=direction,
                    stiffness=stiffness,
                    damping=BENDING_RELAXATION_TIME * stiffness,
                    springref=rest if axis == "y" else 0.0,
                    armature=HINGE_ARMATURE,
                )
            )
        self._add_capsule(link, index)

    def _add_capsule(self, body, index: int):
        length = self._lengths[index]
        self._link_geoms.append(
            body.add(
                "geom",
                name=f"link_{index}",
                type="capsule",
                fromto=(0, 0, 0, 0, 0, length),
                size=[self._device.outer_radius],
                mass=self._device.linear_density * length,
                rgba=_TIP_COLOUR if self._in_tip(index) else _COLOUR,
                **self._contact,
            )
        )

    def _in_tip(self, index: int) -> bool:
        return index >= len(self._lengths) - self._device.tip_links

    def _section(self, index: int) -> devices.Section:
        return self._device.tip if self._in_tip(index) else self._device.shaft

    def _joint_compliance(self, index: int) -> float:
        """Compliance in rad/(N·m) of the bending of the rod next to a joint.

        A joint stands for the half links on both of its sides, l/2EI each.
        """
        return sum(
            self._lengths[neighbour] / 2 / self._section(neighbour).bending_stiffness
            for neighbour in (index - 1, index)
        )

    def _torsion_hinges(self) -> dict[int, float]:
        """Compliance in rad/(N·m) of the torsion hinges, by the link they turn.

        The hinges share the joints of the chain evenly. Each one lies in the middle
        of its share and stands for the twist of the whole of it, l/GJ, whatever
        sections it spans; the last one also for the distal half link.
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

    def _build_motors(self):
        self._tip_motors = []
        if self._device.steerable:
            first = len(self._lengths) - self._device.tip_links
            for index in range(first, len(self._lengths)):
                # The torque that bends the free joint by the steering angle: a motor
                # shifts the rest shape and adds no stiffness.
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
        self._insertion_motor = self._add_velocity_motor(
            "insertion",
            self._insertion,
            CARRIAGE_GAIN,
            MAX_PUSH_SPEED,
            MAX_PUSH_FORCE,
        )
        self._rotation_motor = None
        if self._rotation is not None:
            self._rotation_motor = self._add_velocity_motor(
                "rotation",
                self._rotation,
                ROTATION_GAIN,
                MAX_ROTATION_SPEED,
                MAX_TORQUE,
            )

    def _add_velocity_motor(self, name, joint, gain, max_speed, max_effort):
        return self._mjcf_root.actuator.add(
            "general",
            name=name,
            joint=joint,
            ctrllimited=True,
            ctrlrange=(-1, 1),
            forcelimited=True,
            forcerange=(-max_effort, max_effort),
            gainprm=[gain * max_speed],
            biastype="affine",
            biasprm=[0, 0, -gain],
        )

    def _build_sensors(self):
        grip = self._links[0].add("site", name="grip", size=[1e-3], group=4)
        self._mjcf_root.sensor.add("force", name="push_force", site=grip)
        self._mjcf_root.sensor.add("torque", name="push_torque", site=grip)

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The MJCF model of the chain."""
        return self._mjcf_root

    @property
    def device(self) -> devices.Device:
        """What the catheter is made of."""
        return self._device

    @property
    def link_lengths(self) -> np.ndarray:
        """Lengths (n,) of the links from proximal to distal, m."""
        return self._lengths

    @property
    def stroke(self) -> float:
        """Longest insertion, m."""
        return self._stroke

    @property
    def links(self) -> tuple:
        """Bodies from proximal to distal."""
        return tuple(self._links)

    @property
    def link_geoms(self) -> tuple:
        """Capsules of the links from proximal to distal."""
        return tuple(self._link_geoms)

    @property
    def head(self):
        """Site at the distal end."""
        return self._head

    @property
    def insertion(self):
        """Slide joint of the base."""
        return self._insertion

    @property
    def rotation(self):
        """Hinge joint of the base, or None."""
        return self._rotation

    @property
    def bends(self) -> tuple:
        """Bending hinges from proximal to distal, x before y."""
        return tuple(self._bends)

    @property
    def joints(self) -> tuple:
        """All joints in the order of the chain."""
        return tuple(self._mjcf_root.find_all("joint"))

    @property
    def tip_motors(self) -> tuple:
        """Motors of the tip from proximal to distal, x before y."""
        return tuple(self._tip_motors)

    @property
    def actuators(self) -> tuple:
        """All actuators in the order of the action: tip, insertion, rotation."""
        rotation = () if self._rotation_motor is None else (self._rotation_motor,)
        return (*self._tip_motors, self._insertion_motor, *rotation)

    @property
    def action_groups(self) -> tuple[int, ...]:
        """Number of the group of each actuator: motors that bend about one axis."""
        tip = len(self._tip_motors)
        axes = [number % 2 for number in range(tip)]
        first = min(tip, 2)
        return (*axes, *range(first, first + len(self.actuators) - tip))
