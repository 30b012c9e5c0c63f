"""The scene of a navigation task: entities and their placement."""

import dataclasses
import operator
from collections.abc import Sequence

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Anatomy, Goal
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.arena import AngiographyArena
from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.entities.contact import MOST_FRICTION
from cathsim_dmc.entities.device_stack import DeviceStack
from cathsim_dmc.entities.phantom import Phantom
from cathsim_dmc.entities.robot import Robot
from cathsim_dmc.entities.sheath import Sheath, straight
from cathsim_dmc.physics import effects
from cathsim_dmc.physics.motion import add_clock
from cathsim_dmc.physics.wall import soften
from cathsim_dmc.tasks import placement
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.objectives import GOAL_RADIUS

# Radius of the hole for the sheath minus that of its bore, m: room for the wall of a
# tilted sheath.
AROUND_SHEATH = 2e-3
# Number of torsion joints in the shaft of a device whose base rotates.
_TORSION_JOINTS = 4
# Chains of up to this many links are faster with dense Jacobians: 1.1 to 1.4 times in
# free motion, and as fast in a jam. MuJoCo's own limit is 60 degrees of freedom.
_DENSE_LINKS = 50

# Options that shape the device, the sheath or the arena.
_SHAPING = (
    "device", "devices", "lead", "lumen_friction", "rotation", "friction", "shaft_link",
    "working_length", "sheath_clearance", "physics_timestep", "solver_tolerance",
    "vessel", "randomisation.farthest_shift",
)  # fmt: skip

# Cameras and their axes, right and up: the published top view, and one from the side.
# Seen from the front, the patient's left is on the right of the image.
VIEWS = {"top": (1, 0, 0, 0, 0, 1), "side": (0, 1, 0, 0, 0, 1)}


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Entities of a task, attached to the arena.

    Attributes:
        anatomy: lumen, wall and goals.
        goal: where the device is to go.
        placement: poses of device, sheath and robot.
        arena: the root, with light and the density of blood.
        phantom: wall, goals and load cell.
        catheter: the device, or the stack of coaxial devices.
        sheath: holds the device before the inlet.
        robot: the follower, which moves along with the device.
        config: options with which the scene was built.
    """

    anatomy: Anatomy
    goal: Goal
    placement: placement.Placement
    arena: AngiographyArena
    phantom: Phantom
    catheter: Chain
    sheath: Sheath
    robot: Robot
    config: NavigationConfig

    @classmethod
    def build(
        cls,
        anatomy: Anatomy,
        goal: str | Goal,
        config: NavigationConfig,
        *,
        goal_radius: float = GOAL_RADIUS,
        drawn: bool = True,
        one_goal: bool = False,
    ) -> "Scene":
        """Builds the entities and attaches all to the arena.

        Args:
            goal: Name in `anatomy.goals`, or a goal inside the lumen.
            goal_radius: Radius of the goal markers, m, which are only visual.
            drawn: Whether the arena has a mesh of the lumen's surface.
            one_goal: Whether only this goal has a marker, so that anatomies with other
                goals can share a model.

        Raises:
            ValueError: if goal, device or vessel options do not fit the anatomy.
        """
        bounds.instance("config", config, NavigationConfig)
        bounds.instance("anatomy", anatomy, Anatomy)
        goal = placement.resolve_goal(anatomy, goal)
        config.vessel.check(anatomy)
        chosen, shift = chosen_devices(config), config.randomisation.farthest_shift
        _check_friction(chosen, config)
        length, play = config.working_length, config.sheath_clearance or 0.0
        place = placement.place_device(
            anatomy, goal, longest_tip(chosen), length, shift, play
        )
        friction = config.friction
        if config.devices is None:  # in a stack, it differs from link to link
            friction *= chosen[0].friction_ratio
        catheter = _chain(chosen, place, config, friction)
        if config.vessel.wall is not None:
            soften(catheter)
        radius = catheter.device.outer_radius
        marked = {"own": goal} if one_goal else None
        bore = straight(place.working_length - place.start_depth)
        scene = cls(
            anatomy=anatomy,
            goal=goal,
            placement=place,
            arena=AngiographyArena(catheter.density, config.solver_tolerance),
            phantom=Phantom(anatomy, friction, goal_radius, drawn, marked),
            catheter=catheter,
            sheath=Sheath(bore, radius, clearance=config.sheath_clearance),
            robot=Robot(device_radius=radius),
            config=config,
        )
        scene._attach()
        scene._add_cameras(drawn)
        return scene

    def check(self, config: NavigationConfig) -> None:
        """Raises ValueError if options that shape a scene are not those of this one."""
        bounds.instance("config", config, NavigationConfig)
        for name in _SHAPING:
            given, own = map(operator.attrgetter(name), (config, self.config))
            if given != own:
                raise ValueError(
                    f"config has {name}={given!r}, but the scene was built with "
                    f"{own!r}; give Scene.build and Navigation the same config"
                )

    def _add_cameras(self, drawn: bool):
        """Adds the cameras of `VIEWS`."""
        low, high = self.anatomy.lumen.box
        if drawn:
            vertices = self.anatomy.surface.vertices
            low, high = vertices.min(0), vertices.max(0)
        centre, distance = _aimed(low, high)
        for name, axes in VIEWS.items():
            self.arena.add_camera(name, centre, distance, axes)

    def _attach(self):
        moving = self.config.vessel.motion is not None
        own = self.config.effects_on(self.catheter)
        if user_data := effects.userdata_size(own, self.catheter):
            self.arena.mjcf_model.size.nuserdata = user_data
        if len(self.catheter.links) <= _DENSE_LINKS or moving:
            self.arena.mjcf_model.option.jacobian = "dense"
        self.arena.attach(self.phantom)
        place = self.placement
        for entity, position in (
            (self.sheath, place.inlet),
            (self.catheter, place.start),
            (self.robot, place.robot),
        ):
            site = self.arena.mjcf_model.worldbody.add(
                "site",
                name=f"{entity.mjcf_model.model}_mount",
                group=5,
                pos=position,
                quat=place.quaternion,
            )
            self.arena.attach(entity, site)
        self.phantom.add_wall(
            self.catheter.links[0], self.sheath.bore_radius + AROUND_SHEATH, moving
        )
        if moving:
            add_clock(self.arena.mjcf_model)


def _aimed(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """Point that cameras look at, and their distance from it, m, for a box."""
    return (low + high) / 2, 2.6 * float((high - low).max())


def camera_position(name: str, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Position (3,) of a camera of `VIEWS` for a box with these corners, m."""
    axes, (centre, distance) = VIEWS[name], _aimed(low, high)
    return centre + distance * np.cross(axes[:3], axes[3:])


def chosen_devices(config: NavigationConfig) -> tuple[devices.Device, ...]:
    """The devices of a task, from the innermost outwards."""
    if config.devices is None:
        return (devices.get(config.device),)
    return tuple(devices.get(one, "a name in devices") for one in config.devices)


def count_actions(config: NavigationConfig) -> int:
    """Number of entries of an action; no entity is built."""
    chosen = chosen_devices(config)
    if config.devices is not None:
        return 2 * len(chosen)
    motors = 2 * chosen[0].tip_links * chosen[0].steerable
    return motors + 1 + config.rotation


def longest_tip(chosen: Sequence[devices.Device]) -> devices.Device:
    """The device with the longest tip, which limits the start depth."""
    return max(chosen, key=lambda device: device.tip_length)


def _check_friction(chosen: Sequence[devices.Device], config: NavigationConfig) -> None:
    """Raise ValueError if the friction of a device on the wall can be out of range."""
    drawn = config.randomisation.friction
    largest = max(drawn) if isinstance(drawn, Sequence) else 0.0
    friction = max(config.friction, largest)
    for device in chosen:
        ratio = device.friction_ratio
        if ratio * friction > MOST_FRICTION:
            raise ValueError(
                f"friction is {friction:g} for an uncoated device, and device "
                f"{device.name!r} has a friction_ratio of {ratio:g}; their product "
                f"must be at most {MOST_FRICTION:g}"
            )


def _chain(
    chosen: Sequence[devices.Device],
    place: placement.Placement,
    config: NavigationConfig,
    friction: float,
) -> Chain:
    torsion = _TORSION_JOINTS if config.rotation else 0
    length, link = place.working_length, config.shaft_link
    discretisation = devices.Discretisation(length, link, torsion)
    common = {
        "stroke": place.stroke,
        "friction": friction,
        "timestep": config.physics_timestep,
    }
    if config.devices is None:
        return Catheter(chosen[0], discretisation, rotation=config.rotation, **common)
    own = {"lead": config.lead, "lumen_friction": config.lumen_friction}
    return DeviceStack(chosen, discretisation, **own, **common)
