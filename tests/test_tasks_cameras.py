"""MuJoCo's cameras: seen with software OpenGL, refused clearly without any."""

import os
import subprocess
import sys
import textwrap

import pytest

PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
renderer = mujoco.Renderer(model, 8, 8)
"""

SEEING = """
import numpy as np
from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation

options = {
    "observation": ["rgb", "depth", "segmentation"],
    "cameras": {"names": ["top", "side", "tip"], "size": [60, 80]},
}
def load():
    return suite.load("cathsim", "type1_bca", {"random": 3, **options})

env, batch = load(), BatchSimulation(load().task, 2, seeds=3)
timestep, observation = env.reset(), batch.reset()
action = np.zeros(21)
action[-1] = 1.0
for _ in range(12):
    first = timestep.observation
    timestep = env.step(action)
    observation = batch.step(np.tile(action, (2, 1))).observation
specs = env.observation_spec()
seen = timestep.observation
for key, value in seen.items():
    specs[key].validate(value)
    # Both paths see the same, whoever renders in between.
    np.testing.assert_array_equal(observation[key][0], value, err_msg=key)
for name in ("top", "side", "tip"):
    assert seen[f"rgb_{name}"].shape == (60, 80, 3)
    assert seen[f"rgb_{name}"].std() > 5, name
    assert (seen[f"rgb_{name}"] != first[f"rgb_{name}"]).any(), name
    depth = seen[f"depth_{name}"]
    assert (depth > 0).all() and np.isfinite(depth).all()

# The top camera's distance to what it sees of the arch.
task = env.task
surface = task.scene.anatomy.surface.vertices
model = env.physics.model.ptr
camera = env.physics.data.cam_xpos[model.camera("top").id]
depth = seen["depth_top"]
on_arch = depth[depth < 2]
away = np.abs(surface[:, 1] - camera[1])
assert abs(on_arch.min() - away.min()) < 0.01, (on_arch.min(), away.min())
# The endoscope sees the wall, not the device that carries it: a radius of the aorta
# away on the sides, farther ahead.
tip = seen["depth_tip"][..., 0]
assert tip.min() > 1e-3 and tip.max() < 0.2
assert tip[25:35, 35:45].mean() > tip[0].mean()
print("seen")
"""

REFUSED = """
from cathsim_dmc import suite
try:
    suite.load("cathsim", "simple1_bca", {"observation": "rgb"}).reset()
except ValueError as error:
    print(error)
env = suite.load("cathsim", "simple1_bca")
env.reset()
env.physics.render(8, 8)
"""


def python(code, gl):
    environment = {**os.environ, "MUJOCO_GL": gl, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_cameras_see_what_they_should():
    if python(PROBE, "osmesa").returncode != 0:
        pytest.skip("no software OpenGL (OSMesa) here")
    done = python(SEEING, "osmesa")
    assert done.returncode == 0, done.stderr
    assert "seen" in done.stdout


def test_without_opengl_the_message_says_what_to_do():
    done = python(REFUSED, "disable")
    for hint in ("MUJOCO_GL", "osmesa", "segmentation"):
        assert hint in done.stdout
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("RuntimeError"), done.stderr
    for text in ("MUJOCO_GL is disable", "egl", "cathsim_dmc.show(env)", "fluoroscopy"):
        assert text in last
