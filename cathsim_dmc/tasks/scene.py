"""The scene of a navigation task: entities, and where each is attached."""

import dataclasses

import numpy as np

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.arena import AngiographyArena
from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.entities.phantom import Phantom
from cathsim_dmc.entities.robot import Robot
from cathsim_dmc.entities.sheath import Sheath, straight
from cathsim_dmc.tasks import placement
from cathsim_dmc.tasks.config import NavigationConfig

# Joints of the shaft that twist, where the base turns.
_TORSION_JOINTS = 4


@dataclasses.dataclass(frozen=True)
class Scene:
    """Entities of a task.

    Attributes:
      arena: the root, with light and the density of blood.
      phantom: wall, goals and load cell.
      catheter: the device.
      sheath: holds the device before the inlet.
      robot: the follower, which moves along with the device.
    """

    arena: AngiographyArena
    phantom: Phantom
    catheter: Catheter
    sheath: Sheath
    robot: Robot

    @classmethod
    def build(
        cls,
        anatomy: Anatomy,
        device: devices.Device,
        place: placement.Placement,
        config: NavigationConfig,
    ) -> "Scene":
        """Builds the entities and attaches them to the arena."""
        area = np.pi * device.outer_radius**2
        torsion = config.torsion_joints
        if torsion is None:
            torsion = _TORSION_JOINTS if config.rotation else 0
        scene = cls(
            arena=AngiographyArena(device_density=device.linear_density / area),
            phantom=Phantom(anatomy, config.friction, goal_radius=config.goal_radius),
            catheter=Catheter(
                device,
                devices.Discretisation(
                    working_length=place.working_length,
                    shaft_link=config.shaft_link,
                    torsion_joints=torsion,
                ),
                stroke=place.stroke,
                rotation=config.rotation,
                friction=config.friction,
            ),
            sheath=Sheath(
                straight(place.working_length - place.start_depth),
                device_radius=device.outer_radius,
            ),
            robot=Robot(device_radius=device.outer_radius),
        )
        scene.arena.attach(scene.phantom)
        for entity, position in (
            (scene.sheath, place.inlet),
            (scene.catheter, place.start),
            (scene.robot, place.robot),
        ):
            site = scene.arena.mjcf_model.worldbody.add(
                "site",
                name=f"{entity.mjcf_model.model}_mount",
                group=5,
                pos=position,
                quat=place.quaternion,
            )
            scene.arena.attach(entity, site)
        scene.sheath.guide(scene.catheter, place.start_depth)
        scene.phantom.stand(scene.catheter.links[0])
        placement.add_cameras(scene.arena, anatomy)
        return scene
