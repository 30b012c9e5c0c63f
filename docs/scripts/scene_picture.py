"""Draws docs/images/scene.png: the whole scene, and the arch with the catheter in it.

Needs an OpenGL library: MUJOCO_GL=egl or osmesa python docs/scripts/scene_picture.py
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

OUT = Path(__file__).parents[1] / "images" / "scene.png"
HEIGHT = 640


def draw(physics, target, distance, azimuth, elevation, width, fovy=30.0):
    from dm_control.mujoco import engine

    physics.model.vis.global_.fovy = fovy
    camera = engine.MovableCamera(physics, HEIGHT, width)
    camera.set_pose(target, distance, azimuth, elevation)
    camera.option.geomgroup[3] = 0
    camera.option.geomgroup[4] = 0
    camera.option.sitegroup[:] = 0
    camera.option.sitegroup[4] = 1
    image = camera.render().copy()
    camera._scene.free()
    return image


def main():
    from cathsim_dmc import policies, suite
    from cathsim_dmc.simulation.episodes import play_alone

    env = suite.load("cathsim", "type1_lcca", task_kwargs={"random": 3})
    act = policies.in_environment(policies.make_policy("expert"), env)
    for _ in play_alone(env, act):
        pass
    physics = env.physics
    physics.model.vis.global_.offwidth = 1600
    physics.model.vis.global_.offheight = HEIGHT
    whole = draw(physics, (0.14, 0.02, -0.21), 1.3, 118, -22, 420, 38.0)
    arch = draw(physics, (0.02, 0.01, 0.055), 0.42, 140, -8, 400)
    Image.fromarray(np.concatenate([whole, arch], axis=1)).save(OUT)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    main()
