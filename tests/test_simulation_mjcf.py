"""A task as files: another program that steps the scene gets what the task gets."""

import json

import mujoco
import numpy as np
import pytest
import trimesh
from dm_control import mjcf

from cathsim_dmc import suite
from cathsim_dmc.entities.sheath import CLEARANCE
from cathsim_dmc.physics import forces
from cathsim_dmc.physics.drives import hold
from cathsim_dmc.simulation.mjcf import describe, write_mjcf
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.objectives import Cannulation

TASK, SEED, STEPS = "type1_lcca", 3, 30


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    return write_mjcf(
        TASK, tmp_path_factory.mktemp("mjcf") / "scene", seed=np.int64(SEED)
    )


def actions():
    rng = np.random.RandomState(0)
    drawn = rng.uniform(-1, 1, (STEPS, 21))
    drawn[:, :20] *= 0.5
    drawn[:, 20] = 1.0  # onto the wall of the arch
    return drawn


@pytest.mark.slow
def test_the_scene_moves_nearly_as_the_task(exported):
    """Without a field: convex pieces and boxes stand for wall and sheath."""
    task = json.loads((exported / "task.json").read_text())
    model = mujoco.MjModel.from_xml_path(str(exported / "scene.xml"))
    assert not model.nuser_geom or not model.geom_user.any()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    np.testing.assert_array_equal(data.qpos, task["qpos"])
    mujoco.mj_forward(model, data)
    # The device stands clear of the wall, which it does not at qpos0.
    assert all(contact.dist > -0.1e-3 for contact in data.contact)
    held = data.act.copy()
    drives = hold(model, data)
    np.testing.assert_array_equal(data.act, held)
    bore = {"random": SEED, "sheath_clearance": CLEARANCE}  # as the scene has
    env = suite.load("cathsim", TASK, task_kwargs=bore)
    env.reset()
    order = [model.actuator(name).id for name in task["actuators"]]
    contacts = model.sensor(task["sensors"]["wall_contacts"])
    row = slice(contacts.adr[0], contacts.adr[0] + contacts.dim[0])
    assert contacts.dim[0] % task["contact_size"] == 0
    touched, apart = 0, []
    for action in actions():
        drives.follow(action[None, 20:])
        data.ctrl[order] = np.clip(action, -1, 1)
        for _ in range(task["substeps"]):
            mujoco.mj_step(model, data)
        env.step(action)
        head = data.site(task["head"]).xpos
        apart.append(np.linalg.norm(head - env.task.readings.head))
        found = forces.Contacts.from_sensor(data.sensordata[row])
        touched += found.present.any()
    assert touched > 5
    assert np.median(apart) < 3e-3
    insertion = data.joint(task["insertion"]).qpos[0]
    assert insertion == pytest.approx(env.task.readings.insertion, rel=1e-3)
    assert model.sensor(task["sensors"]["push_force"]).dim == 3
    assert model.sensor(task["sensors"]["load_cell"]).dim == 3


@pytest.mark.slow
def test_what_success_is_stands_beside_the_scene(exported):
    task = json.loads((exported / "task.json").read_text())
    objective = suite.make_task(TASK).objective
    assert task["goal"]["radius"] == objective.goal_radius
    np.testing.assert_array_equal(task["goal"]["position"], objective.goal)
    np.testing.assert_array_equal(task["branch"]["points"], objective.branch.points)
    assert task["branch"]["ostium"] == objective.ostium
    # A steerable device of 5 French, thirds of a millimetre.
    assert task["device_radius"] == pytest.approx(5e-3 / 6, rel=0.02)
    assert 2 * task["tip_joints"] + 1 == len(task["actuators"]) == 21
    assert task["max_steps"] == suite.make_task(TASK).config.max_steps
    assert task["substeps"] * 0.004 == pytest.approx(task["control_timestep"])


@pytest.mark.slow
def test_a_pair_is_written_as_its_chain_stands(tmp_path, cathsim):
    task, out = "simple1_lcca_pair", tmp_path / "pair"
    drawn = {"friction": [0.2, 0.2]}  # 0.037 otherwise
    code, told, _ = cathsim(
        *("export", task, "--out", out, "--seed", "2"),
        *("--randomisation", json.dumps(drawn)),
    )
    assert not code and told.strip() == str(out)
    model = mujoco.MjModel.from_xml_path(str(out / "scene.xml"))
    bore = {"random": 2, "sheath_clearance": CLEARANCE, "randomisation": drawn}
    env = suite.load("cathsim", task, bore)
    env.reset()
    own, chain = env.physics.model.ptr, env.task.scene.catheter
    close = dict(rtol=1e-9, atol=1e-15)
    for link in chain.links:
        found, expected = (m.body(link.full_identifier) for m in (model, own))
        for name in ("mass", "inertia", "ipos", "iquat", "gravcomp"):
            np.testing.assert_allclose(
                getattr(found, name, 0), getattr(expected, name, 0), **close
            )
        for joint in link.find_all("joint", immediate_children_only=True):
            found, expected = (m.joint(joint.full_identifier) for m in (model, own))
            np.testing.assert_allclose(found.stiffness, expected.stiffness, **close)
            np.testing.assert_allclose(
                model.dof_damping[found.dofadr],
                own.dof_damping[expected.dofadr],
                **close,
            )
            np.testing.assert_allclose(
                model.qpos_spring[found.qposadr],
                own.qpos_spring[expected.qposadr],
                **close,
            )
        for geom in link.find_all("geom", immediate_children_only=True):
            found, expected = (m.geom(geom.full_identifier) for m in (model, own))
            np.testing.assert_allclose(found.size, expected.size, **close)
            np.testing.assert_allclose(found.friction, expected.friction, **close)
    described = json.loads((out / "task.json").read_text())
    assert described["devices"] == ["wire_035_glide", "berenstein_5f"]
    np.testing.assert_array_equal(model.key("start").qpos, env.physics.data.qpos)


CUBE = 0.01 * np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])


class Beside(Navigation):
    """A mesh on a hinge, and a body that the episode puts somewhere."""

    def __init__(self, scene, *arguments, **options):
        root = scene.arena.mjcf_model
        file = trimesh.convex.convex_hull(CUBE).export(file_type="stl")
        root.asset.add("mesh", name="cube", file=mjcf.Asset(file, ".stl"))
        swing = root.worldbody.add("body", name="swing", pos=(1, 0, 0))
        swing.add("joint", name="swing", axis=(0, 1, 0))
        swing.add("geom", type="mesh", mesh="cube", contype=0, conaffinity=0)
        hand = root.worldbody.add("body", name="hand", mocap=True)
        hand.add("site", name="hand")
        super().__init__(scene, *arguments, **options)

    def initialize_episode(self, physics, random_state):
        super().initialize_episode(physics, random_state)
        physics.named.data.qvel["swing"] = 0.5
        physics.named.data.mocap_pos["hand"] = (1, 2, 3)


def test_bodies_beside_the_device_are_written_as_they_are(tmp_path):
    definition = suite.TaskDefinition("Beside.", "type1", "bca", task=Beside)
    if "cube_bca" not in suite.TASKS:
        suite.register("cube_bca", definition)
    out = write_mjcf("cube_bca", tmp_path / "cube", wall="prisms")
    model = mujoco.MjModel.from_xml_path(str(out / "scene.xml"))
    corners = model.mesh_vert[model.mesh_vertadr[model.mesh("cube").id] :][:8]
    sides = np.ptp(corners, axis=0)
    assert model.mesh("cube").vertnum == 8
    np.testing.assert_allclose(sides, 0.01, rtol=1e-6)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    assert data.joint("swing").qvel == 0.5
    np.testing.assert_array_equal(data.mocap_pos, [[1, 2, 3]])


def test_a_scene_has_the_drawn_stiffness_of_motors_and_friction_of_the_wall(tmp_path):
    drawn = {"stiffness": [1.25, 1.25], "friction": [0.02, 0.02]}  # 0.037 otherwise
    options = {"randomisation": drawn}
    out = write_mjcf(
        "type1_bca", tmp_path / "stiff", wall="prisms", task_kwargs=options
    )
    model = mujoco.MjModel.from_xml_path(str(out / "scene.xml"))
    bore = {"random": 0, "sheath_clearance": CLEARANCE}
    env = suite.load("cathsim", "type1_bca", {**bore, **options})
    env.reset()
    own = env.physics.model.ptr
    for motor in env.task.scene.catheter.tip_motors:
        found, expected = (m.actuator(motor.full_identifier) for m in (model, own))
        joint = model.joint(found.trnid[0])
        assert joint.stiffness == own.joint(joint.name).stiffness
        np.testing.assert_array_equal(found.gainprm, expected.gainprm)
    # MuJoCo takes the larger coefficient of two geoms.
    assert model.geom("wall_000").friction[0] == own.geom("wall").friction[0] == 0.02


class Inserted(Cannulation):
    """Success after 3 cm."""

    def success(self, measurement):
        return measurement.readings.insertion > 0.03


class Heavy(Cannulation):
    """A cannulation with another reward."""

    TERMS = {**Cannulation.TERMS, "weight": lambda self, m: m.readings.insertion}


@pytest.mark.parametrize(("kind", "known"), [(Inserted, False), (Heavy, True)])
def test_the_branch_stands_for_the_success_of_a_cannulation(kind, known, monkeypatch):
    definition = suite.TaskDefinition("Own.", "type1", "bca", objective=kind.to)
    monkeypatch.setitem(suite.TASKS, "own_bca", definition)
    env = suite.environment(suite.make_task("own_bca", random=0))
    env.reset()
    assert (describe(env)["branch"] is not None) == known


@pytest.mark.slow
def test_what_cannot_be_written_is_refused_before(tmp_path):
    with pytest.raises(ValueError, match="type9.*type1_bca"):
        write_mjcf("type9", tmp_path / "a")
    with pytest.raises(FileExistsError, match="exists"):
        write_mjcf(TASK, tmp_path)
    with pytest.raises(ValueError, match="pool=1"):
        write_mjcf("arch_bca", tmp_path / "b", task_kwargs={"pool": 2})
    with pytest.raises(ValueError, match="wall.*merged, prisms, coacd"):
        write_mjcf(TASK, tmp_path / "c", wall="boxes")
    assert not list(tmp_path.iterdir())
