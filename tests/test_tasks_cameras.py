"""MuJoCo's cameras: seen with software OpenGL, refused in words without any."""

import os
import subprocess
import sys
import types

import mujoco
import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.cameras import FARTHEST, CameraOptions
from cathsim_dmc.tasks.navigation import Navigation

BACK_ENDS = ("egl", "osmesa")  # that need no display
PROBE = "import mujoco as m; m.Renderer(m.MjModel.from_xml_string('<mujoco/>'), 8, 8)"
SEEING = """
import sys
import numpy as np
from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation

task, away = sys.argv[1], {}
options = {
    "observation": ["rgb", "depth", "endoluminal_distance"],
    "cameras": {"names": ["top", "tip"], "size": [30, 40]},
    "endoluminal_size": [30, 40],
}
env = suite.load("cathsim", task, {"random": 3, **options})
batch = BatchSimulation(suite.make_task(task, **options), 2, seeds=2)
first, seen = env.reset().observation, batch.reset().observation
action = np.zeros(batch.num_actions)
action[[0, 2] if task.endswith("_pair") else -1] = 1.0
for _ in range(5):
    mine = env.step(action).observation
    seen = batch.step(np.tile(action, (2, 1))).observation
for key, value in mine.items():
    env.observation_spec()[key].validate(value)
    # Both paths see the same, whoever renders in between.
    np.testing.assert_array_equal(seen[key][1], value, err_msg=key)
    assert (seen[key][0] != value).any()
assert mine["rgb"].shape == (30, 40, 6) and mine["depth"].shape == (30, 40, 2)
assert (mine["rgb"].std((0, 1)) > 1).all() and (mine["rgb"] != first["rgb"]).any()
top, tip = np.moveaxis(mine["depth"], -1, 0)
# The distance of the top camera from what it sees of the arch.
surface = env.task.scene.anatomy.surface.vertices
camera = env.physics.data.cam_xpos[env.physics.model.ptr.camera("top").id]
assert abs(top.min() - np.abs(surface[:, 1] - camera[1]).min()) < 0.01
# The endoscope sees the wall and not the device: what rays through the lumen meet.
along = mine["endoluminal_distance"][..., 0]
row, column = np.mgrid[:30, :40] - np.array([14.5, 19.5])[:, None, None]
along = along / np.sqrt(1 + (row**2 + column**2) / 15**2)
assert np.median(np.abs(tip - along)) < 0.3e-3, np.median(np.abs(tip - along))
# Its lamp lights the wall ahead; ambient light alone gives a level of 71.
assert np.median(mine["rgb"][..., 3]) > 73, np.median(mine["rgb"][..., 3])
snapshot = env.snapshot()
env.step(action)
np.testing.assert_array_equal(env.restore(snapshot).observation["rgb"], mine["rgb"])
print("seen")
"""


SHARING = """
import gc, os, signal, threading
import numpy as np
from cathsim_dmc import suite

def load(**options):
    return suite.load("cathsim", "simple1_bca", {"random": 3, **options})

def forked(act, expected=None):
    child = os.fork()
    if not child:
        signal.alarm(60)  # a fork that hangs
        status = 1
        try:
            act()
            status = 0 if expected is None else 2
        except RuntimeError as error:
            status = 0 if expected and expected in str(error) else 3
        finally:
            os._exit(status)
    assert os.waitpid(child, 0)[1] == 0

cameras = {"names": ["top", "tip"], "size": 48}
seeing = {"observation": ["rgb", "depth"], "cameras": cameras}
made = load(**seeing)
forked(made.reset)
forked(lambda: load(**seeing).reset())

action = np.zeros(made.action_spec().shape)
alone, others = made, load(**seeing)
episode = [alone.reset(), *(alone.step(action) for _ in range(4))]
forked(lambda: made.step(action), "spawn")
forked(lambda: load(**seeing).reset(), "spawn")

def film(env):
    return [env.physics.render(60, 90, camera_id=name) for name in ("top", "side")]

third = load()
third.reset()
still, step = film(third), others.reset()
for number, expected in enumerate(episode):
    for key, value in expected.observation.items():
        np.testing.assert_array_equal(step.observation[key], value, err_msg=key)
    np.testing.assert_array_equal(film(third), still)
    film(others)
    if number == 1:  # of which a context is freed
        fourth = load(**seeing)
        fourth.reset(), film(fourth)
    elif number == 2:
        del fourth
        gc.collect()
    went = []
    each = threading.Thread(target=lambda: went.append(others.step(action)))
    each.start(), each.join()
    (step,) = went
print("shared")
"""
DRAWN = """
import mujoco
import numpy as np
from cathsim_dmc import suite
from dm_control.mujoco.wrapper import MjvOption

options = MjvOption()
options.sitegroup[:] = 0
for task, randomised in (("simple1_bca", True), ("simple1_bca_pair", False)):
    env = suite.load("cathsim", task, {
        "random": 3, "observation": "rgb", "randomisation": randomised,
        "cameras": {"names": ["top", "side"], "size": 96},
    })
    env.reset()
    action = np.zeros(env.action_spec().shape)
    action[[0, -1]] = 1.0
    for _ in range(8):
        seen = env.step(action).observation["rgb"]
    mujoco.mj_kinematics(env.physics.model.ptr, env.physics.data.ptr)
    mujoco.mj_camlight(env.physics.model.ptr, env.physics.data.ptr)
    for number, name in enumerate(("top", "side")):
        drawn = env.physics.render(96, 96, camera_id=name, scene_option=options)
        mine = seen[..., 3 * number : 3 * number + 3]
        difference = np.abs(mine.astype(int) - drawn).max()
        assert difference < 30, (task, name, difference)
print("drawn")
"""


SEVERAL = """
import sys
import numpy as np
from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation

pair = {"devices": ["wire_035_glide", "berenstein_5f"]}
own = pair if sys.argv[1] == "pair" else {}
options = {
    "observation": ["rgb", "depth"], "goal": "bca", "working_length": 0.25, **own,
    "cameras": {"names": ["top", "side", "tip"], "size": [40, 48]},
}
exact = {"start_radius": 0.0}
if not own:  # friction and others differ between simulations
    exact |= {"friction": [0.04, 0.04], "roll": [0.3, 0.3]}
options["randomisation"] = exact
names = ["simple1", "type1", "simple2"]

def made(anatomy, seed=0):
    return suite.make_task("navigate", random=seed, anatomy=anatomy, **options)

batch = BatchSimulation(made(names), 6, num_threads=1)
pool = suite.environment(made(names, 1))  # which does not draw the first one first
alone = {name: BatchSimulation(made(name), 1, num_threads=1) for name in names}
action = np.zeros(batch.num_actions)
action[[0, 2] if own else -1] = 1.0
visited = set()
for episode in range(2):  # in which simulations change their anatomies
    seen, single = batch.reset(), pool.reset()
    for step in range(4):
        told = [one.anatomy for one in batch.conditions]
        visited |= {*told}
        expected = {}
        for name, one in alone.items():
            state = one.reset() if not step else one.step(action[None])
            expected[name] = state.observation
        for number, name in enumerate(told):
            for key, value in expected[name].items():
                mine = seen.observation[key][number]
                np.testing.assert_array_equal(mine, value[0], err_msg=(key, name))
        here = pool.task.conditions.anatomy
        assert episode or here == "type1"
        for key, value in expected[here].items():
            np.testing.assert_array_equal(single.observation[key], value[0])
        seen = batch.step(np.tile(action, (6, 1)))
        single = pool.step(action)
assert visited == {*names}
top = [one["depth"][0, ..., 0] for one in expected.values()]
assert all((a != b).mean() > 0.02 for a, b in zip(top, top[1:]))
print("several")
"""


MOVING = """
import numpy as np
from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation

def made(motion, anatomy="type1", seed=0):
    return suite.make_task(
        "navigate", random=seed, anatomy=anatomy, goal="bca", access="descending",
        observation=["rgb", "depth", "endoluminal_distance"],
        vessel={"motion": motion}, randomisation={"start_radius": 0.0},
        cameras={"names": ["top", "side", "tip"], "size": [30, 40]},
        endoluminal_size=[30, 40],
    )

# A vessel whose motion has no amplitude is drawn as one at rest.
still = {"heart": 0.0, "breathing": 0.0, "distensibility": 0.0}
batches = [BatchSimulation(made(one), 1, num_threads=1) for one in (still, False)]
one, other = (batch.reset().observation for batch in batches)
np.testing.assert_allclose(one["depth"], other["depth"], atol=2e-5)
assert np.abs(one["rgb"].astype(int) - other["rgb"]).max() < 3

heart, names = {"phase": [0.0, 1.0]}, ["type1", "type2"]
batch = BatchSimulation(made(heart, names), 3, num_threads=1)
env = suite.environment(made(heart, names, 1))
batch.reset(), env.reset()
action = np.zeros(batch.num_actions)
action[-1] = 0.5
for _ in range(25):
    seen = batch.step(np.tile(action, (3, 1))).observation
    mine = env.step(action).observation
assert {one.anatomy for one in batch.conditions} == {*names}
for key, value in mine.items():
    np.testing.assert_array_equal(seen[key][1], value, err_msg=key)
row, column = np.mgrid[:30, :40] - np.array([14.5, 19.5])[:, None, None]
for number in range(3):
    # What rays through the moved lumen meet.
    along = seen["endoluminal_distance"][number, ..., 0]
    along = along / np.sqrt(1 + (row**2 + column**2) / 15**2)
    away = np.median(np.abs(seen["depth"][number, ..., 2] - along))
    surface = batch.rollout.case(number).scene.anatomy.surface.vertices
    moved = np.abs(batch.rollout.moving.surface(number).vertices - surface).max()
    assert moved > 3e-3 and away < 0.1e-3, (number, moved, away)
print("moving")
"""


@pytest.fixture(scope="module")
def back_end():
    """Name of a back end of OpenGL that works here."""
    found = (name for name in BACK_ENDS if not python(name, PROBE).returncode)
    return next(found, None) or pytest.skip("neither EGL nor OSMesa works here")


def python(back_end, *arguments):
    environment = {**os.environ, "MUJOCO_GL": back_end, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "last", "arguments"),
    [
        pytest.param(SEEING, "seen", ["type1_bca"], id="what they should"),
        pytest.param(SEEING, "seen", ["type1_bca_pair"], id="what they should, pair"),
        # Randomisation rolls the base of the device, coaxial devices have other radii.
        pytest.param(DRAWN, "drawn", [], id="the device where it is"),
        # As a task with this anatomy alone does, bit for bit.
        pytest.param(SEVERAL, "several", ["single"], id="the anatomy of each"),
        pytest.param(SEVERAL, "several", ["pair"], id="the anatomy of each, pair"),
        pytest.param(MOVING, "moving", [], id="a vessel where it has moved to"),
    ],
)
def test_cameras_show(script, last, arguments, back_end):
    done = python(back_end, script, *arguments)
    assert last in done.stdout, done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_contexts_of_others_threads_forks_and_the_exit(back_end):
    """Each environment of a process sees what it sees alone, whoever else renders."""
    done = python(back_end, SHARING)
    assert "shared" in done.stdout, done.stderr
    assert done.returncode == 0
    # Contexts that are freed after the end of EGL say so.
    assert "Error" not in done.stderr, done.stderr


def test_without_opengl_the_message_says_what_to_do(shared_environment, monkeypatch):
    def fail(*_):
        raise OSError("no display")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    task = twin(shared_environment("simple1_bca").task, observation="rgb")
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.raises(ValueError, match="it is disabled.*osmesa.*segmentation"):
        suite.environment(task)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with pytest.raises(ValueError, match="MUJOCO_GL.*no display.*osmesa.*segmentation"):
        suite.environment(task).reset()
    task = twin(shared_environment("simple1_bca").task, observation="rgb")
    with pytest.raises(ValueError, match="MUJOCO_GL.*no display"):
        BatchSimulation(task, 2)  # before any work


class Lister:
    """Lists the geoms that MuJoCo would draw, without OpenGL."""

    _gl_context = types.SimpleNamespace(make_current=lambda: None)

    def __init__(self, model, rows, columns):
        self._model, self._image = model, np.zeros((rows, columns, 3), np.uint8)
        self.scene = mujoco.MjvScene(model, 1000)

    def update_scene(self, data, camera, options):
        chosen = mujoco.MjvCamera()
        chosen.type, chosen.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
        kinds = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self._model, data, options, None, chosen, kinds, self.scene
        )
        for geom in self.scene.geoms[: self.scene.ngeom]:
            name = self._model.geom(geom.objid).name
            Lister.drawn[name] = [*geom.pos.round(6), *geom.size.round(6)]

    def render(self):
        return self._image

    def disable_depth_rendering(self):
        pass

    close = disable_depth_rendering


class Beside(Navigation):
    """Balls that the start of an episode moves and enlarges."""

    def __init__(self, scene, *arguments, others=None, **options):
        rest = list(others or ())
        for each in (scene, *(other for other, _ in rest)):
            world = each.arena.mjcf_model.worldbody
            for name, mocap in (("hand", True), ("stone", False)):
                body = world.add("body", name=name, mocap=mocap)
                untouched = {"contype": 0, "conaffinity": 0}
                body.add("geom", name=name, type="sphere", size=[0.01], **untouched)
        super().__init__(scene, *arguments, others=rest or None, **options)

    def initialize_episode(self, physics, random_state):
        super().initialize_episode(physics, random_state)
        physics.named.data.mocap_pos["hand"] = (1, 2, 3)
        physics.named.model.body_pos["stone"] = (4, 5, 6)
        physics.named.model.geom_size["stone"] = 0.02


@pytest.mark.parametrize("anatomy", ["simple1", ["simple1", "simple2"]])
def test_cameras_show_bodies_where_hooks_have_put_them(anatomy, monkeypatch):
    monkeypatch.setattr(mujoco, "Renderer", Lister)
    monkeypatch.setattr(Lister, "drawn", {}, raising=False)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    definition = suite.TaskDefinition("Beside.", anatomy, "bca", task=Beside)
    monkeypatch.setitem(suite.TASKS, "balls", definition)
    suite.environment(suite.make_task("balls", observation="rgb", random=0)).reset()
    assert Lister.drawn["hand"] == [1, 2, 3, 0.01, 0.01, 0.01]
    assert Lister.drawn["stone"] == [4, 5, 6, 0.02, 0.02, 0.02]


@pytest.mark.parametrize("names", ["back", [], ["top", "top"], [1], 3, None])
def test_names_of_cameras_are_checked(names):
    with pytest.raises(ValueError, match="different ones of top, side, tip"):
        CameraOptions(names)


def test_specs_follow_the_options():
    options = {"names": ["tip", "side"], "size": (20, 30)}
    task = suite.make_task("simple1_bca", observation=["rgb", "depth"], cameras=options)
    specs = task.observation_specs
    assert specs["rgb"].shape == (20, 30, 6) and specs["rgb"].dtype == np.uint8
    assert specs["depth"].shape == (20, 30, 2) and specs["depth"].maximum == FARTHEST
