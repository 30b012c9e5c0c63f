"""The image task where there is no OpenGL library at all."""

import os
import subprocess
import sys

CODE = """
import sys

class NoOpenGL:
    \"\"\"Refuses every way to OpenGL.\"\"\"

    refused = []
    roots = {"OpenGL", "glfw", "OpenGL_accelerate"}
    modules = {"mujoco.egl", "mujoco.osmesa", "mujoco.glfw", "mujoco.cgl"}

    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in self.roots or name in self.modules:
            self.refused.append(name)
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None

sys.meta_path.insert(0, NoOpenGL())
import ctypes.util
find_library = ctypes.util.find_library
ctypes.util.find_library = lambda name: (
    None if name.lower() in {"gl", "egl", "osmesa", "glfw"} else find_library(name)
)

import numpy as np
from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation

options = {
    "observation": ["image", "sequential", "segmentation", "tracking_2d"],
    "fluoroscopy": {"noise": True, "biplane": "LATERAL"},
}
env = suite.load("cathsim", "simple1_bca", {"random": 0, **options})
env.reset()
batch = BatchSimulation(env.task, 2)
batch.reset()
action = np.zeros(21)
action[-1] = 1.0
for _ in range(5):
    timestep = env.step(action)
    step = batch.step(np.tile(action, (2, 1)))
assert timestep.observation["image"].shape == (128, 128, 2)
images = step.observation["image"][0], timestep.observation["image"]
np.testing.assert_array_equal(*images)

with open("/proc/self/maps") as maps:
    loaded = [line for line in maps if "libGL" in line or "libOSMesa" in line
              or "libEGL" in line]
print("loaded:", loaded)
print("modules:", sorted(m for m in sys.modules if m.split(".")[0] in NoOpenGL.roots))
"""


def test_images_need_no_opengl_library():
    # Nothing says which backend to use, as on a bare server.
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    environment |= {"OMP_NUM_THREADS": "1"}
    environment.pop("DISPLAY", None)
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "loaded: []" in done.stdout
    assert "modules: []" in done.stdout
