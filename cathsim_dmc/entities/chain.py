"""A chain of rigid links with a driven base, the model of slender devices."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from dm_control import composer, mjcf

from cathsim_dmc import bounds
from cathsim_dmc.entities import contact
from cathsim_dmc.entities.device import LONGEST, Device
from cathsim_dmc.entities.posture import x_first

# Physics step of the tasks, s. An implicit step of length h damps a spring like a
# relaxation time of h, so the dampers of the hinges are weaker by that much.
TIMESTEP = 4e-3
# Rotor inertia of the torsion hinges, kg·m². They are softer, so a larger one would
# delay the twist by more than a few milliseconds.
TORSION_ARMATURE = 1e-7
CARRIAGE_MASS = 0.2  # kg, platform of the follower that pushes the device
MAX_PUSH_FORCE = 5.0  # N, slip of the clamps
MAX_PUSH_SPEED = 0.04  # m/s
# Largest acceleration of the platforms, m/s² and rad/s², at a reversal of the full
# speed; a start or a stop has half of it. No figure of the robot was found: assumed,
# half of gravity for the carriage.
MAX_PUSH_ACCELERATION = 5.0
MAX_ROTATION_ACCELERATION = 150.0

# Damping ratio of the carriage on the spring at the base. The links are rigid; the
# spring has the axial compliance of the whole device, L / EA. Without it a jam stops
# the carriage within a step, and the push force oscillates.
COMPRESSION_DAMPING = 0.5
COMPRESSION_ARMATURE = 1e-3  # kg, about the mass of the device

# Lag of the drives of the tip, s. It has no source; with 0.05 s, noise on the motors
# whips the tip into the wall (docs/soak.md).
STEERING_LAG = 0.2
ROTOR_INERTIA = 1e-4  # kg·m², rotary unit: a 0.3 kg clamp of 2 cm
MAX_TORQUE = 0.02  # N·m, slip of the clamps
MAX_ROTATION_SPEED = 3.14  # rad/s

_VISIBLE_SHAFT = 0.45  # m, drawn behind the simulated part at full insertion
COLOUR = (0.85, 0.32, 0.08, 1.0)
TIP_COLOUR = (0.95, 0.75, 0.1, 1.0)


def servo_stiffness(inertia: float, speed: float, acceleration: float) -> float:
    """Stiffness of a critically damped servo from the limits of its platform.

    A command that reverses from the speed v to -v accelerates such a platform of mass m
    by at most 2 v √(K/m) / e. The servo must be so soft that its largest force F moves
    the platform by less than F/K within a physics step.

    Args:
        inertia: kg or kg·m².
        speed: m/s or rad/s.
        acceleration: m/s² or rad/s².

    Returns:
        N/m or N·m/rad.
    """
    return inertia * (np.e * acceleration / (2 * speed)) ** 2


def hinge_time(material: Any, timestep: float) -> Any:
    """Damping divided by stiffness of a hinge, s: relaxation time less physics step.

    Args:
        material: relaxation time of the material, s; a number or an array.
        timestep: physics step, s.
    """
    return np.maximum(material - timestep, 0.0)


class Links(NamedTuple):
    """Properties of a chain of n links, from proximal to distal.

    Attributes:
        lengths: (n,), m.
        radius: radius of all links, m.
        masses: n masses, kg.
        compliances: n - 1 bending compliances of the joints, rad/(N·m).
        armatures: n - 1 rotor inertias of their hinges, kg·m², see `armature`.
        rest_angles: n - 1 pairs, rest angles of the hinges about x and y, rad.
        axial_stiffness: EA of the whole device, N.
        tip: index of the first link that is drawn as part of the tip.
        steering: torque of the motors about x and y at full command, N·m, by link.
        twists: compliance of the torsion hinges, rad/(N·m), by link.
    """

    lengths: np.ndarray
    radius: float
    masses: Sequence[float]
    compliances: Sequence[float]
    armatures: Sequence[float]
    rest_angles: Sequence[tuple[float, float]]
    axial_stiffness: float
    tip: int
    steering: Mapping[int, float] = MappingProxyType({})
    twists: Mapping[int, float] = MappingProxyType({})


class Chain(composer.ModelWrapperEntity):
    """Links with hinges about x and y; +z of every link points to the distal end.

    The origin of the entity is the position of the distal end at zero insertion.
    `Catheter` and `DeviceStack` define the properties of the links.

    Attributes:
        coaxial: Whether the devices are coaxial, each moved by its own drives.
        devices: The devices, from the innermost outwards.
        device: The device; of coaxial devices the outermost, which the sheath guides.
        density: Effective density, kg/m³, that determines the buoyancy in blood.
        timestep: Physics step with which the chain is simulated, s.
        stroke: Longest insertion, m.
        link_lengths: (n,), of the links from proximal to distal, m.
        distal_shares: (n - 1,), fraction of each joint's compliance that belongs to the
            half link distal of it; of coaxial devices, as for a uniform rod.
        links: Bodies from proximal to distal.
        link_geoms: Their capsules.
        head: Site at the distal end.
        insertion: Slide joint of the base.
        rotation: Hinge joint of the base, or None.
        bends: Bending hinges from proximal to distal, x before y.
        hinges: Hinges that represent the bending and torsion of the rod.
        joints: All joints in the order of the chain, of each link x before y.
        tip_motors: Motors of the tip from proximal to distal, x before y.
        actuators: All actuators: tip, insertion, rotation.
        action_names: Names of the entries of an action.
        translations: Indices of the translations in the action.
        push_force: Sensor of the force on the base.
        push_torque: Sensor of the torque on the base.
    """

    coaxial = False
    devices: tuple[Device, ...]
    density: float
    action_names: tuple[str, ...]
    translations: tuple[int, ...]

    def _assemble(
        self,
        links: Links,
        surface: dict[str, Any],
        *,
        stroke: float,
        rotation: bool,
        timestep: float,
    ) -> None:
        """Builds base, links, head, motors and sensors; `devices` must be set."""
        bounds.number("stroke", stroke, 0.0, LONGEST, "m", positive=True)
        bounds.number("timestep", timestep, unit="s", positive=True)
        self.device = self.devices[-1]
        self.stroke, self.timestep, self.link_lengths = stroke, timestep, links.lengths
        self.distal_shares = links.lengths[1:] / (
            links.lengths[1:] + links.lengths[:-1]
        )
        root = mjcf.RootElement(model="catheter")
        root.compiler.angle = "radian"
        super()._build(root)
        bodies = [self._add_base(links, rotation)]
        bends, twists, joints = [], [], root.find_all("joint")
        for index in range(1, len(links.lengths)):
            place = (0, 0, links.lengths[index - 1])
            bodies.append(bodies[-1].add("body", name=f"link_{index}", pos=place))
            if index in links.twists:
                name, twist = f"twist_{index}", links.twists[index]
                hinge = self._add_hinge(
                    bodies[-1], name, (0, 0, 1), twist, armature=TORSION_ARMATURE
                )
                twists.append(hinge)
                joints.append(hinge)
            pair = self._add_bends(bodies[-1], index, links)
            bends += pair
            joints += pair
        self.links, self.bends = tuple(bodies), tuple(bends)
        self.link_geoms = tuple(
            _add_capsule(body, index, links, surface)
            for index, body in enumerate(bodies)
        )
        self._add_shaft(links)
        self.hinges = (*bends, *twists)
        self.joints = tuple(joints)
        self.head = bodies[-1].add(
            "site",
            name="head",
            pos=(0, 0, links.lengths[-1]),
            size=[links.radius],
            rgba=TIP_COLOUR,
            group=4,
        )
        self._add_motors(links)
        grip = bodies[0].add("site", name="grip", size=[1e-3], group=4)
        self.push_force = root.sensor.add("force", name="push_force", site=grip)
        self.push_torque = root.sensor.add("torque", name="push_torque", site=grip)

    def _add_base(self, links: Links, rotation: bool):
        length = links.lengths.sum()
        base = self.mjcf_model.worldbody.add("body", name="link_0", pos=(0, 0, -length))
        along = {"type": "slide", "axis": (0, 0, 1)}
        self.insertion = base.add(
            "joint",
            name="insertion",
            **along,
            armature=CARRIAGE_MASS,
            limited=True,
            range=(0.0, self.stroke),
        )
        stiffness = links.axial_stiffness / length
        base.add(
            "joint",
            name="compression",
            **along,
            stiffness=stiffness,
            damping=2 * COMPRESSION_DAMPING * (stiffness * CARRIAGE_MASS) ** 0.5,
            armature=COMPRESSION_ARMATURE,
        )
        self.rotation = None
        if rotation:
            turn = {"type": "hinge", "axis": (0, 0, 1), "armature": ROTOR_INERTIA}
            self.rotation = base.add("joint", name="rotation", **turn)
        return base

    def _add_shaft(self, links: Links):
        """Adds the part of the device that the follower holds, drawn only."""
        self.links[0].add(
            "geom",
            name="shaft",
            type="capsule",
            fromto=(0, 0, -_VISIBLE_SHAFT - self.stroke, 0, 0, 0),
            size=[links.radius],
            **contact.DRAWN,
            rgba=COLOUR,
        )

    def _add_hinge(self, body, name: str, axis, compliance: float, **attributes):
        stiffness = 1 / compliance
        time = float(hinge_time(self.device.relaxation_time, self.timestep))
        return body.add(
            "joint",
            name=name,
            axis=axis,
            stiffness=stiffness,
            damping=time * stiffness,
            **attributes,
        )

    def _add_bends(self, body, index: int, links: Links):
        """Adds the bending hinges of a link; returns them, x before y."""
        compliance = links.compliances[index - 1]
        rest = dict(zip("xy", links.rest_angles[index - 1], strict=True))
        ways = {"x": (1, 0, 0), "y": (0, 1, 0)}
        bends = {
            axis: self._add_hinge(
                body,
                f"bend_{axis}_{index}",
                ways[axis],
                compliance,
                springref=rest[axis],
                armature=links.armatures[index - 1],
            )
            for axis in ("xy" if x_first(index) else "yx")
        }
        return bends["x"], bends["y"]

    def _add_motors(self, links: Links):
        """Adds the motors of the tip, without stiffness, and the servos of the base."""
        drives, tip = self.mjcf_model.actuator, []
        bounded = {"ctrllimited": True, "ctrlrange": (-1, 1)}
        for number, (index, torque) in enumerate(links.steering.items()):
            for axis, joint in zip("xy", self.bends[2 * index - 2 :], strict=False):
                motor = {"name": f"tip_{axis}_{number}", "joint": joint, **bounded}
                lag = {"dyntype": "filterexact", "dynprm": [STEERING_LAG]}
                tip.append(drives.add("general", **motor, **lag, gainprm=[torque]))
        servos = []
        push = MAX_PUSH_SPEED, MAX_PUSH_ACCELERATION, MAX_PUSH_FORCE
        turn = MAX_ROTATION_SPEED, MAX_ROTATION_ACCELERATION, MAX_TORQUE
        for joint, limits in ((self.insertion, push), (self.rotation, turn)):
            if joint is None:
                continue
            speed, acceleration, effort = limits
            # The servo follows the integral of a speed, see `laws.drive`.
            stiffness = servo_stiffness(joint.armature, speed, acceleration)
            damping = 2 * (stiffness * joint.armature) ** 0.5
            servos.append(
                drives.add(
                    "general",
                    name=joint.name,
                    joint=joint,
                    **bounded,
                    forcelimited=True,
                    forcerange=(-effort, effort),
                    dyntype="integrator",
                    gainprm=[stiffness * speed],
                    biastype="affine",
                    biasprm=[0, -stiffness, -damping],
                )
            )
        self.tip_motors, self.actuators = tuple(tip), (*tip, *servos)
        self.action_names = tuple(actuator.name for actuator in self.actuators)
        self.translations = (len(tip),)

    @property
    def action_groups(self) -> tuple[int, ...]:
        """Group index of each entry of an action.

        The tip motors of one bending axis form a group; every other entry is its own.
        """
        tip = len(self.tip_motors)
        axes = [number % 2 for number in range(tip)]
        first = min(tip, 2)
        return (*axes, *range(first, first + len(self.action_names) - tip))


def _add_capsule(body, index: int, links: Links, surface: dict[str, Any]):
    return body.add(
        "geom",
        name=f"link_{index}",
        type="capsule",
        fromto=(0, 0, 0, 0, 0, links.lengths[index]),
        size=[links.radius],
        mass=links.masses[index],
        rgba=TIP_COLOUR if index >= links.tip else COLOUR,
        **surface,
    )
