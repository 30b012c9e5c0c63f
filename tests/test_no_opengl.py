"""Images and commands where there is no OpenGL library at all."""

import json
import os
import subprocess
import sys

import pytest
from conftest import slow

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


# PyOpenGL without the library that it is told to use.
BROKEN = """
import sys

class Broken:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("OpenGL", "glfw"):
            raise AttributeError("'NoneType' object has no attribute 'glGetError'")

sys.meta_path.insert(0, Broken())
sys.argv = ["cathsim", *sys.argv[1:]]
from cathsim_dmc.cli import main
main()
"""


def run_broken(backend, *arguments):
    return subprocess.run(
        [sys.executable, "-c", BROKEN, *arguments],
        env={**os.environ, "MUJOCO_GL": backend},
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.mark.parametrize("backend", ["egl", *slow("osmesa")])
def test_a_command_that_draws_nothing_needs_no_opengl(backend):
    done = run_broken(backend, "list", "--json")
    assert done.returncode == 0, done.stderr
    assert "type1_lcca" in json.loads(done.stdout)["tasks"]
    (line,) = done.stderr.splitlines()
    assert f"MUJOCO_GL={backend}" in line and "MUJOCO_GL=disable" in line


@pytest.mark.slow
def test_bad_input_stays_bad_input_without_opengl():
    done = run_broken("osmesa", "eval", "no_such_policy", "--task", "type1_lcca")
    assert done.returncode == 2, done.stderr
    assert "no_such_policy" in done.stderr and "Traceback" not in done.stderr


def test_other_faults_are_not_taken_for_those_of_opengl():
    done = run_broken("nonsense", "list")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "MUJOCO_GL" in line and "nonsense" in line and "disable" in line
