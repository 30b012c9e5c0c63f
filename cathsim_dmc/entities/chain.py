"""A chain of rigid links with a driven base, the model of slender devices."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from dm_control import composer, mjcf

from cathsim_dmc.entities.device import Device
from cathsim_dmc.entities.posture import x_first

# Physics step of the tasks, s. An implicit step of length h damps a spring like a
# relaxation time of h, so the hinges have that much less.
TIMESTEP = 4e-3
# Rotor inertia of the hinges, kg·m². With the damping it acts within 2 ms, far below
# the relaxation time. It sets the mass scale of the contact solver, at which the wall
# is as hard as silicone (docs/physics.md).
HINGE_ARMATURE = 1e-6
# Rotor inertia of the torsion hinges, kg·m². They are softer, so a larger one would
# delay the twist by more than a few milliseconds.
TORSION_ARMATURE = 1e-7
CARRIAGE_MASS = 0.2  # kg, platform of the follower that pushes the device
MAX_PUSH_FORCE = 5.0  # N, slip of the clamps
MAX_PUSH_SPEED = 0.04  # m/s
# Stiffness of the servo of the carriage, N/m. The largest force moves the carriage in a
# time step of 4 ms by less than the servo's linear range, F/k = 0.5 mm, or the force
# would jump from one limit to the other.
CARRIAGE_STIFFNESS = 1e4

# Damping ratio of the carriage on the spring at the base. The links are rigid; the
# spring has the axial compliance of the whole device, L / EA. Without it a jam stops
# the carriage within a step, and the push force oscillates.
COMPRESSION_DAMPING = 0.5
COMPRESSION_ARMATURE = 1e-3  # kg, about the mass of the device

ROTOR_INERTIA = 1e-4  # kg·m², rotary unit: a 0.3 kg clamp of 2 cm
MAX_TORQUE = 0.02  # N·m, slip of the clamps
MAX_ROTATION_SPEED = 3.14  # rad/s
ROTATION_STIFFNESS = 0.4  # N·m/rad, of the servo
SERVO_DAMPING = 1.0  # of the critical damping: the speed does not overshoot

_VISIBLE_SHAFT = 0.45  # m, drawn behind the simulated part at full insertion
COLOUR = (0.85, 0.32, 0.08, 1.0)
TIP_COLOUR = (0.95, 0.75, 0.1, 1.0)


def hinge_time(material: Any, timestep: float) -> Any:
    """Damping over stiffness of a hinge whose material has a relaxation time, s.

    Args:
        material: relaxation time of the material, s; a number or an array.
        timestep: physics step, s.
    """
    return np.maximum(material - timestep, 0.0)


class Links(NamedTuple):
    """What a chain of n links is made of, from proximal to distal.

    Attributes:
        lengths: (n,), m.
        radius: of all links, m.
        masses: n, kg.
        compliances: n - 1 of the joints in bending, rad/(N·m).
        rest_angles: n - 1 pairs, of the hinges about x and y, rad.
        axial_stiffness: EA of the whole device, N.
        tip: number of the first link that is drawn as part of the tip.
        twists: compliance of the torsion hinges, rad/(N·m), by link.
    """

    lengths: np.ndarray
    radius: float
    masses: Sequence[float]
    compliances: Sequence[float]
    rest_angles: Sequence[tuple[float, float]]
    axial_stiffness: float
    tip: int
    twists: Mapping[int, float] = MappingProxyType({})


class Chain(composer.Entity):
    """Links with hinges about x and y; +z of every link points to the distal end.

    The origin of the entity is the position of the distal end at zero insertion.
    `Catheter` and `DeviceStack` say what the links are made of.

    Attributes:
        coaxial: Whether the devices are coaxial ones, each moved by itself.
    """

    coaxial = False

    def _assemble(
        self,
        links: Links,
        contact: dict[str, Any],
        *,
        stroke: float,
        rotation: bool,
        timestep: float,
        name: str,
    ) -> None:
        """Builds base, links, head, motors and sensors.

        Args:
            links: what the chain is made of.
            contact: attributes of the geoms.
            stroke: longest insertion, m.
            rotation: whether the base has a rotation joint.
            timestep: physics step with which the chain will be simulated, s.
        """
        if not stroke > 0:
            raise ValueError(f"stroke is {stroke} m; it must be positive")
        self._made, self._contact, self._stroke = links, contact, stroke
        self._lengths, self._radius = links.lengths, links.radius
        self._timestep = timestep
        self._mjcf_root = mjcf.RootElement(model=name)
        self._mjcf_root.compiler.angle = "radian"
        self._links = []
        self._link_geoms = []
        self._bends, self._twists = [], []
        self._build_base(rotation)
        for index in range(1, len(self._lengths)):
            self._build_link(index)
        self._head = self._links[-1].add(
            "site",
            name="head",
            pos=(0, 0, self._lengths[-1]),
            size=[self._radius],
            rgba=TIP_COLOUR,
            group=4,
        )
        self._build_motors()
        self._build_sensors()

    @property
    def device(self) -> Device:
        """The device; of coaxial devices the outermost."""
        raise NotImplementedError

    @property
    def devices(self) -> tuple[Device, ...]:
        """The devices, from the innermost outwards."""
        raise NotImplementedError

    @property
    def density(self) -> float:
        """Effective density, kg/m³, that determines the buoyancy in blood."""
        raise NotImplementedError

    # Assembly.

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
        stiffness = self._made.axial_stiffness / self._lengths.sum()
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
        # The part of the device that the follower holds, drawn only.
        base.add(
            "geom",
            name="shaft",
            type="capsule",
            fromto=(0, 0, -_VISIBLE_SHAFT - self._stroke, 0, 0, 0),
            size=[self._radius],
            mass=0,
            contype=0,
            conaffinity=0,
            group=2,
            rgba=COLOUR,
        )

    def _build_link(self, index: int):
        link = self._links[-1].add(
            "body", name=f"link_{index}", pos=(0, 0, self._lengths[index - 1])
        )
        self._links.append(link)
        stiffness = 1 / self._made.compliances[index - 1]
        rest = dict(zip("xy", self._made.rest_angles[index - 1], strict=True))
        if index in self._made.twists:
            twist = 1 / self._made.twists[index]
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
        bends = {
            axis: link.add(
                "joint",
                name=f"bend_{axis}_{index}",
                axis=(1, 0, 0) if axis == "x" else (0, 1, 0),
                stiffness=stiffness,
                damping=self._relaxation_time * stiffness,
                springref=rest[axis],
                armature=HINGE_ARMATURE,
            )
            for axis in ("xy" if x_first(index) else "yx")
        }
        self._bends += [bends["x"], bends["y"]]
        self._add_capsule(link, index)

    def _add_capsule(self, body, index: int):
        length = self._lengths[index]
        self._link_geoms.append(
            body.add(
                "geom",
                name=f"link_{index}",
                type="capsule",
                fromto=(0, 0, 0, 0, 0, length),
                size=[self._radius],
                mass=self._made.masses[index],
                rgba=TIP_COLOUR if index >= self._made.tip else COLOUR,
                **self._contact,
            )
        )

    def _build_motors(self):
        self._insertion_motor = self._add_servo(
            self._insertion, CARRIAGE_STIFFNESS, MAX_PUSH_SPEED, MAX_PUSH_FORCE
        )
        self._rotation_motor = None
        if self._rotation is not None:
            self._rotation_motor = self._add_servo(
                self._rotation, ROTATION_STIFFNESS, MAX_ROTATION_SPEED, MAX_TORQUE
            )

    def _add_servo(self, joint, stiffness, max_speed, max_effort):
        """A servo on the integral of a speed, see `physics.drives`."""
        damping = 2 * SERVO_DAMPING * (stiffness * joint.armature) ** 0.5
        return self._mjcf_root.actuator.add(
            "general",
            name=joint.name,
            joint=joint,
            ctrllimited=True,
            ctrlrange=(-1, 1),
            forcelimited=True,
            forcerange=(-max_effort, max_effort),
            dyntype="integrator",
            gainprm=[stiffness * max_speed],
            biastype="affine",
            biasprm=[0, -stiffness, -damping],
        )

    def _build_sensors(self):
        grip = self._links[0].add("site", name="grip", size=[1e-3], group=4)
        sensors = self._mjcf_root.sensor
        self._push_force = sensors.add("force", name="push_force", site=grip)
        self._push_torque = sensors.add("torque", name="push_torque", site=grip)

    @property
    def _relaxation_time(self) -> float:
        """Damping over stiffness of the hinges, s."""
        return float(hinge_time(self.device.relaxation_time, self._timestep))

    @property
    def timestep(self) -> float:
        """Physics step with which the chain is simulated, s."""
        return self._timestep

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The MJCF model of the chain."""
        return self._mjcf_root

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
    def hinges(self) -> tuple:
        """Hinges that represent the bending and torsion of the rod."""
        return (*self._bends, *self._twists)

    @property
    def push_force(self):
        """Sensor of the force on the base."""
        return self._push_force

    @property
    def push_torque(self):
        """Sensor of the torque on the base."""
        return self._push_torque

    @property
    def tip_motors(self) -> tuple:
        """Motors of the tip from proximal to distal, x before y."""
        return ()

    @property
    def actuators(self) -> tuple:
        """All actuators: tip, insertion, rotation."""
        rotation = () if self._rotation_motor is None else (self._rotation_motor,)
        return (*self.tip_motors, self._insertion_motor, *rotation)

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the entries of an action: those of the actuators."""
        return tuple(actuator.name for actuator in self.actuators)

    @property
    def translations(self) -> tuple[int, ...]:
        """Indices of the translations in the action."""
        return (len(self.tip_motors),)

    @property
    def action_groups(self) -> tuple[int, ...]:
        """Group index of each entry of an action.

        The tip motors of one bending axis form a group; every other entry is its own.
        """
        tip = len(self.tip_motors)
        axes = [number % 2 for number in range(tip)]
        first = min(tip, 2)
        return (*axes, *range(first, first + len(self.action_names) - tip))

    @property
    def joints(self) -> tuple:
        """All joints in the order of the chain, of each link x before y."""
        joints = self._mjcf_root.find_all("joint")
        bends = iter(self._bends)
        mine = set(self._bends)
        return tuple(next(bends) if joint in mine else joint for joint in joints)
