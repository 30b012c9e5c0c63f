"""Draws the follower robot at four insertions into docs/images/robot.png.

Run it with a software or hardware renderer: ``MUJOCO_GL=osmesa python
docs/scripts/robot_picture.py`` (or ``MUJOCO_GL=egl``).
"""

import argparse
import pathlib

import numpy as np
from dm_control import composer, mjcf
from matplotlib import image

from cathsim_dmc.entities.robot import CYCLE, DEVICE_RADIUS, Robot, follower_posture

IMAGE = pathlib.Path(__file__).parents[1] / "images" / "robot.png"
BACKGROUND = (0.93, 0.945, 0.96)
HERO, ABOVE = "hero", "above"


def scene() -> tuple[mjcf.Physics, Robot]:
    """The robot on a table, +y of its frame down, with a straight device."""
    arena = composer.Arena()
    root = arena.mjcf_model
    root.visual.map.znear = 0.02
    root.visual.quality.shadowsize = 4096
    root.visual.quality.offsamples = 8
    getattr(root.visual, "global").offwidth = 1600
    getattr(root.visual, "global").offheight = 1000
    root.visual.headlight.ambient = (0.42, 0.42, 0.44)
    root.visual.headlight.diffuse = (0.22, 0.22, 0.22)
    root.asset.add(
        "texture",
        name="sky",
        type="skybox",
        builtin="flat",
        rgb1=BACKGROUND,
        rgb2=BACKGROUND,
        width=32,
        height=192,
    )
    table = root.asset.add(
        "material", name="table", rgba=(*BACKGROUND, 1), specular=0.05
    )
    world = root.worldbody
    world.add("geom", type="plane", pos=(0, 0, -0.063), size=(3, 3, 1), material=table)
    world.add("light", pos=(-0.3, -0.3, 1.5), dir=(0.2, 0.2, -1), diffuse=[0.55] * 3)
    # The robot is shifted so that the middle of its rail is near the origin.
    for name, pos, target, fovy in (
        (HERO, (0.34, -0.52, 0.36), (-0.015, 0, -0.030), 19),
        (ABOVE, (0.0, -0.001, 1.2), (0, 0, -0.012), 5.2),
    ):
        body = world.add("body", name=f"{name}_target", pos=target)
        world.add(
            "camera", name=name, pos=pos, fovy=fovy, mode="targetbody", target=body
        )
    robot = Robot()
    # Robot +z to world +x, robot +y (down) to world -z.
    site = world.add(
        "site", pos=(0.19, 0, 0), xyaxes=(0, -1, 0, 0, 0, -1), size=(1e-4,)
    )
    arena.attach(robot, site)
    world.add(
        "geom",
        type="capsule",
        fromto=(-0.28, 0, 0, 0.25, 0, 0),
        size=(DEVICE_RADIUS,),
        rgba=(0.15, 0.65, 0.55, 1),
        mass=0,
        contype=0,
        conaffinity=0,
    )
    return mjcf.Physics.from_mjcf_model(root), robot


def render(physics, robot, insertion, camera, height, width) -> np.ndarray:
    """Pixels (height, width, 3) uint8 of the posed robot."""
    physics.bind(robot.joints).qpos = follower_posture(insertion, 8.0 * insertion)
    return physics.render(height, width, camera_id=camera)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=pathlib.Path, default=IMAGE)
    output = parser.parse_args().output
    physics, robot = scene()
    rows = [render(physics, robot, 0.25 * CYCLE, HERO, 500, 1100)]
    # Seen from above over one cycle: both hold, front holds, both hold, rear holds.
    rows += [
        render(physics, robot, phase * CYCLE, ABOVE, 190, 1100)
        for phase in (0.0, 0.25, 0.5, 0.75)
    ]
    output.parent.mkdir(parents=True, exist_ok=True)
    image.imsave(output, np.vstack(rows))
    print(f"{output}: {output.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
