"""Bodies and motors that a subclass of Navigation adds to the arena."""

import numpy as np
import pytest
from dm_control import mjcf
from test_recording_rerun_log import Recording

from cathsim_dmc import suite
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.pictures import record
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.navigation import Navigation

MASS, FORCE, PERIOD = 0.01, 0.05, 0.04  # kg, N, s


class Beside(Navigation):
    """A body on a slide far from the vessel, with a motor."""

    def __init__(self, scene, *arguments, **options):
        root = scene.arena.mjcf_model
        body = root.worldbody.add("body", name="own", pos=(1, 0, 0))
        self.slide = body.add("joint", name="own", type="slide", axis=(1, 0, 0))
        body.add("geom", type="sphere", size=[0.01], mass=MASS, conaffinity=0)
        # The drives of the device have the same dynamics.
        integrator = {"dyntype": "integrator", "gainprm": [1.0]}
        root.actuator.add("general", name="own", joint=self.slide, **integrator)
        self.own = body
        super().__init__(scene, *arguments, **options)


class Still(Effect):
    """A law that adds no force."""

    @staticmethod
    def law(_, time, links):
        links.xfrc_applied[0, 0] += 0.0 * time


@pytest.fixture(scope="module")
def task_name():
    """Name of a task with a body of its own."""
    name = "beside_bca"
    if name not in suite.TASKS:
        definition = suite.TaskDefinition("Beside.", "type1", "bca", task=Beside)
        suite.register(name, definition)
    return name


def _pushed(env):
    env.add_extra_hook("before_step", _push)
    env.reset()
    env.step(np.zeros(env.action_spec().shape))
    return env.physics.bind(env.task.slide).qvel[0]


def _push(physics, action, random_state):
    physics.named.data.xfrc_applied["own", 0] = FORCE


def test_motors_beside_the_device_get_none_of_its_actions(task_name):
    for device in ("steerable_5f", "diagnostic_5f_simmons"):
        options = {"device": device, "random": 0}
        env = suite.load("cathsim", task_name, options)
        alone = suite.load("cathsim", "type1_bca", options)
        batch = BatchSimulation(suite.make_task(task_name, device=device), 1)
        env.reset(), alone.reset(), batch.reset()
        for _ in range(3):
            action = env.action_spec().maximum
            step, _, _ = batch.step(action[None]), env.step(action), alone.step(action)
        inserted = alone.task.readings.insertion
        assert env.task.readings.insertion == step.readings.insertion[0] == inserted
        assert env.physics.bind(env.task.slide).qpos[0] == 0.0


def test_a_force_on_a_body_beside_the_device_acts_with_the_laws_of_effects(task_name):
    env = suite.load("cathsim", task_name, {"random": 0, "effects": [Still()]})
    assert _pushed(env) == pytest.approx(FORCE / MASS * PERIOD)


def test_a_repeated_control_step_has_what_hooks_have_written_before_it(task_name):
    env = suite.load("cathsim", task_name, {"random": 0})
    env.task.stepper.deepest = -1.0  # every control step is too coarse
    assert _pushed(env) == pytest.approx(FORCE / MASS * PERIOD)
    assert env.task.stepper.repeated[0]


def test_a_moving_vessel_moves_no_joint_beside_the_device(task_name):
    options = {"vessel": {"motion": True}, "random": 0}
    env = suite.load("cathsim", task_name, options)
    alone = suite.load("cathsim", "type1_bca", options)
    env.reset(), alone.reset()
    for _ in range(4):
        env.step(env.action_spec().maximum)
        alone.step(env.action_spec().maximum)
    assert env.physics.bind(env.task.slide).qpos[0] == 0.0
    found, expected = env.task.readings.centreline, alone.task.readings.centreline
    np.testing.assert_allclose(found, expected, atol=1e-12)


CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * 0.02


class Stone(Navigation):
    """A body with a mesh, a cube in the first scene and a slab in the others."""

    stretch = 3.0  # of the slab along x

    def __init__(self, scene, *arguments, others=None, **options):
        rest = list(others or ())
        self._add(scene, "cube", 3.0)
        for other, _ in rest:
            self._add(other, "slab", self.stretch)
        super().__init__(scene, *arguments, others=rest or None, **options)

    @staticmethod
    def _add(scene, shown, stretch):
        own = mjcf.RootElement(model="own")
        for name, along in (("cube", 1.0), ("slab", stretch)):
            vertices = CORNERS * (along, 1.0, 1.0)
            own.asset.add("mesh", name=name, vertex=vertices.ravel())
        own.worldbody.add("geom", name="stone", type="mesh", mesh=shown, conaffinity=0)
        # Attached after the vessel, whose mesh only the first scene has.
        scene.arena.mjcf_model.attach(own)


def _in_two_anatomies(monkeypatch):
    definition = suite.TaskDefinition("Stones.", ["type1", "type2"], "bca", task=Stone)
    monkeypatch.setitem(suite.TASKS, "stones", definition)
    return suite.make_task("stones", random=0)


def test_each_anatomy_shows_the_meshes_of_its_own_scene(monkeypatch):
    env = suite.environment(_in_two_anatomies(monkeypatch))
    model, seen = env.physics.model.ptr, {}
    while len(seen) < 2:
        env.reset()
        mesh = model.mesh(model.geom("own/stone").dataid[0])
        seen[env.task.conditions.anatomy] = mesh.name
    assert seen == {"type1": "own/cube", "type2": "own/slab"}


def test_anatomies_share_no_model_with_other_meshes_of_one_name(monkeypatch):
    monkeypatch.setattr(Stone, "stretch", 2.0)
    with pytest.raises(ValueError, match="same meshes of your own"):
        _in_two_anatomies(monkeypatch)


def test_a_recording_shows_a_body_beside_the_device(task_name, tmp_path):
    env = suite.load("cathsim", task_name)
    env.add_extra_hook("before_step", _push)
    idle = np.zeros(env.action_spec().shape)
    path = tmp_path / "e.rrd"
    episode = record(env, lambda seen: idle, path, seed=2, max_steps=3)
    file = Recording(path)
    places = file.temporal["/world/bodies/own"]["Transform3D:translation"]
    body = env.physics.model.name2id("own", "body")
    assert np.allclose([one.as_py()[0] for one in places], episode.body_pos[:, body])
    assert np.ptp(episode.body_pos[:, body, 0]) > 1e-3
    shape = file.static["/world/bodies/own/sphere"]["Ellipsoids3D:half_sizes"]
    assert np.allclose(shape[-1].as_py(), [[0.01, 0.01, 0.01]])
