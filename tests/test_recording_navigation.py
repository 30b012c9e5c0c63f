"""The recorder on the navigation task."""

import dataclasses

import mujoco
import numpy as np
import pytest
from conftest import twin
from recording_samples import same
from scipy.spatial.transform import Rotation
from test_own_objective import advancing
from test_recording_rerun_log import Recording

from cathsim_dmc import suite
from cathsim_dmc.analysis.force_statistics import recorded_forces
from cathsim_dmc.anatomy.arch.arch import ARCHES, build_arch
from cathsim_dmc.entities.devices import DEVICES
from cathsim_dmc.pictures import record
from cathsim_dmc.recording import dataset, recorder
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.recording.rerun_log import write_rrd
from cathsim_dmc.recording.rerun_scene import body_geoms

STEPS = 40
# Rerun's shapes by the types of MuJoCo's geoms, and their entities.
KINDS = {3: "Capsules3D", 5: "Cylinders3D", 6: "Boxes3D"}
SHAPES = {"Capsules3D": "capsule", "Cylinders3D": "cylinder", "Boxes3D": "box"}


@pytest.fixture(scope="module")
def env():
    options = {"anatomy": build_arch(ARCHES["simple1"]), "goal": "bca", "random": 0}
    return suite.load("cathsim", "navigate", options)


def bend_and_push(timestep):
    action = np.zeros(21)
    action[0:20:2], action[20] = 1.0, 1.0
    return action


@pytest.fixture(scope="module")
def episode(env):
    made = EpisodeRecorder(env, "navigate", {"goal": "bca"})
    return made.record_episode(bend_and_push, seed=2, max_steps=STEPS)


def test_a_record_from_a_snapshot_is_the_rest_of_the_episode(env, episode, tmp_path):
    env.random_state.seed(2)
    timestep = env.reset()
    for _ in range(10):
        timestep = env.step(bend_and_push(timestep))
    start = env.snapshot()
    path, given = tmp_path / "rest.rrd", {"start": start, "max_steps": STEPS - 10}
    rest = record(env, lambda seen: bend_and_push(None), path, seed=9, **given)
    assert rest.seed is None and rest.meta["started"] and path.exists()
    for name in ("time", "qpos", "head"):
        assert np.array_equal(getattr(rest, name), getattr(episode, name)[10:])
    assert np.array_equal(rest.reward, episode.reward[10:])
    assert np.array_equal(rest.push_force, episode.push_force[10:])
    assert "started" not in episode.meta
    with pytest.raises(ValueError, match="seed is 2, but start has the random state"):
        EpisodeRecorder(env).record_episode(bend_and_push, 2, start=start)
    with pytest.raises(ValueError, match=r"snapshot is 'a.npz'; .*Snapshot\.load"):
        record(env, bend_and_push, start="a.npz")


def test_a_snapshot_of_an_ended_episode_is_not_recorded():
    env = suite.load("cathsim", "simple1_bca", {"max_steps": 1})
    env.reset()
    env.step(np.zeros(21))
    with pytest.raises(ValueError, match=r"start has ended \(truncated\)"):
        record(env, "push", start=env.snapshot())


def test_the_command_records_from_a_snapshot(tmp_path, cathsim):
    env = suite.load("cathsim", "simple1_bca", {"max_steps": 8})
    env.reset()
    for _ in range(3):
        env.step(np.zeros(21))
    env.snapshot().save(tmp_path / "start.npz")
    code, out, err = cathsim(
        *("record", "expert", "--task", "simple1_bca", "--max-steps", 8),
        *("--start", tmp_path / "start.npz", "--out", tmp_path / "rest.npz"),
    )
    assert code == 0 and "5 steps, truncated" in out, err
    rest = Episode.load(tmp_path / "rest.npz")
    assert rest.time[0] == pytest.approx(0.12) and rest.seed is None


@pytest.mark.parametrize("name", ["start.npz", "start.rrd"])
def test_a_record_does_not_replace_the_snapshot_that_it_starts_from(
    name, tmp_path, cathsim, shared_environment
):
    env, start = shared_environment("simple1_bca"), tmp_path / "start.npz"
    env.reset()
    env.snapshot().save(start)
    before = start.read_bytes()
    code, _, err = cathsim(
        *("record", "push", "--task", "simple1_bca", "--max-steps", 2),
        *("--start", start, "--out", tmp_path / name),
    )
    assert code == 2 and "would replace the snapshot" in err
    assert start.read_bytes() == before and list(tmp_path.iterdir()) == [start]


def test_a_record_names_the_options_that_are_objects(episode, tmp_path):
    """Without them the task is another one, which repeats nothing."""
    assert set(episode.meta["objects"]) == {"anatomy"}
    own = dataclasses.replace(DEVICES["steerable_4f"], name="own")
    env = suite.load("cathsim", "simple1_bca", {"device": own, "max_steps": 9})
    bent = record(env, lambda seen: bend_and_push(None), seed=2, max_steps=2)
    assert bent.meta["task_kwargs"] == {"max_steps": 9}
    assert list(bent.meta["objects"]) == ["device"]
    assert "name='own'" in bent.meta["objects"]["device"]
    bent.save(tmp_path / "own.npz")
    options = {"task": "simple1_bca", "max_steps": 9}
    with pytest.raises(dataset.DatasetError, match="without device, which no file"):
        next(iter(dataset.repeat_episodes(tmp_path, "tracking", **options)))
    plain = suite.load("cathsim", "simple1_bca", {"max_steps": 9})
    assert "objects" not in record(plain, "push", seed=2, max_steps=1).meta


def test_contacts_make_up_the_forces_of_the_task(env, episode):
    assert len(episode.contact_step) > 0
    size = np.linalg.norm(episode.contact_force, axis=1)
    total, largest = np.zeros((2, STEPS))
    np.add.at(total, episode.contact_step, size)
    np.maximum.at(largest, episode.contact_step, size)
    np.testing.assert_allclose(total, episode.wall_force_sum, atol=1e-9)
    np.testing.assert_allclose(largest, episode.wall_force_max, atol=1e-9)
    peaks = np.array(episode.meta["wall_force_peak_max"])
    assert (peaks >= episode.wall_force_max - 1e-12).all()
    means = np.array(episode.meta["wall_force_mean_max"])
    assert (means <= peaks + 1e-12).all() and 0 < means.max() < peaks.max()
    forces = recorded_forces(episode)
    assert (forces.peak_force, forces.max_force) == (peaks.max(), means.max())
    assert episode.push_force[-1] == env.task.readings.push_force


def test_contacts_lie_on_the_wall_and_press_outwards(env, episode):
    depth = env.task.scene.anatomy.lumen(episode.contact_position)
    assert np.abs(depth).max() < 2e-3
    firm = np.linalg.norm(episode.contact_force, axis=1) > 1e-3
    unit = episode.contact_force[firm]
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    outside = episode.contact_position[firm] + 3e-3 * unit
    assert (env.task.scene.anatomy.lumen(outside) < depth[firm]).mean() > 0.95


def test_poses_are_those_of_the_task(env, episode):
    np.testing.assert_array_equal(episode.catheter[-1], env.task.readings.centreline)
    assert episode.insertion[-1] == env.task.readings.insertion
    distance = env.task.info()["distance"]
    np.testing.assert_allclose(episode.meta["distance"][-1], distance)
    np.testing.assert_allclose(np.diff(episode.time), 0.04)
    # Published reward: minus the distance in metres.
    np.testing.assert_allclose(episode.reward, -np.array(episode.meta["distance"])[1:])


def test_the_record_follows_the_simulation(env, episode):
    assert (episode.steps, episode.termination, episode.success) == (
        STEPS, "truncated", False
    )  # fmt: skip
    np.testing.assert_array_equal(episode.qpos[-1], env.physics.data.qpos)
    np.testing.assert_array_equal(episode.head[-1], env.task.readings.head)
    np.testing.assert_array_equal(episode.action[0], bend_and_push(None))
    meta = episode.meta
    assert meta["action_names"] == env.action_spec().name.split("\t")
    assert meta["task_kwargs"] == {"goal": "bca"}
    assert meta["versions"]["mujoco"] == mujoco.__version__
    radius = env.task.scene.catheter.device.outer_radius
    np.testing.assert_allclose(meta["catheter_radius"], radius)
    assert meta["goal_radius"] == 8e-3 and meta["control_timestep"] == 0.04
    np.testing.assert_array_equal(meta["goal_position"], env.task.goal_position)
    assert set(meta["reward_terms"]) == set(env.task.objective.weights)
    link = meta["body_names"].index("catheter/link_2")
    np.testing.assert_array_equal(episode.catheter[:, 2], episode.body_pos[:, link])


def test_the_goal_of_a_record_is_the_shifted_one():
    plain = suite.make_task("simple1_bca").objective.goal
    options = {"randomisation": {"goal_shift": (3e-3, 5e-3)}}
    env = suite.load("cathsim", "simple1_bca", options)
    made = EpisodeRecorder(env).record_episode(bend_and_push, seed=1, max_steps=2)
    goal, shift = made.meta["goal_position"], made.meta["conditions"]["goal_shift"]
    assert np.linalg.norm(goal - plain) == pytest.approx(shift, rel=0.05)
    distance = np.linalg.norm(made.head - goal, axis=-1)
    np.testing.assert_allclose(made.meta["distance"], distance)


def test_sides_of_the_patient_are_told_where_they_are_known(env, monkeypatch):
    here = env.task.scene.anatomy
    assert EpisodeRecorder(env).present().meta["upright"] is True  # a phantom
    monkeypatch.setattr(recorder, "is_upright", lambda anatomy: anatomy is not here)
    assert EpisodeRecorder(env).present().meta["upright"] is False


def test_a_seed_repeats_the_episode(env, episode):
    recorder = EpisodeRecorder(env, "navigate", {"goal": "bca"})
    again = recorder.record_episode(bend_and_push, seed=2, max_steps=STEPS)
    assert same(again, episode)
    pushes = iter([bend_and_push(None)] * STEPS)  # then StopIteration
    assert same(recorder.record_episode(lambda seen: next(pushes), seed=2), episode)
    for seed in (3, None):
        other = recorder.record_episode(bend_and_push, seed=seed, max_steps=1)
        assert other.seed == seed
        assert not np.array_equal(other.qpos[0], again.qpos[0])


def test_success_ends_the_episode():
    near = suite.environment(advancing())  # 20 mm are success
    episode = EpisodeRecorder(near).record_episode(bend_and_push, seed=0)
    assert episode.success and episode.meta["discount"] == 0.0
    assert 10 < episode.steps < 40


@pytest.mark.parametrize("raises", [True, False])
def test_a_diverged_step_is_left_out(env, raises):
    wild = suite.environment(twin(env.task), raise_exception_on_physics_error=raises)

    def diverge(timestep):
        if wild.task.rollout.steps[0] == 3:
            wild.physics.data.ptr.qvel[:] = np.nan
        return bend_and_push(timestep)

    episode = EpisodeRecorder(wild).record_episode(diverge, seed=0)
    assert episode.termination == "physics_error" and episode.meta["error"]
    assert episode.steps == 3


def test_wrong_actions_are_refused(env):
    recorder = EpisodeRecorder(env)
    for wrong, message in (
        (np.zeros(2), r"shape \(2,\)"),
        (np.full(21, np.nan), "nan"),
    ):
        with pytest.raises(ValueError, match=message):
            recorder.record_episode(lambda timestep, wrong=wrong: wrong)
    with pytest.raises(ValueError, match="at least 1"):
        recorder.record_episode(bend_and_push, max_steps=0)


def test_the_robot_in_the_file_stands_where_the_simulator_has_it(env, tmp_path):
    recorded = EpisodeRecorder(env).record_episode(bend_and_push, seed=2, max_steps=3)
    recorded = Episode.load(recorded.save(tmp_path / "e.npz"))
    geoms, path = tuple(body_geoms(env.physics)), tmp_path / "e.rrd"
    surface = env.task.scene.anatomy.surface
    file = Recording(write_rrd(recorded, surface, path, robot_geoms=geoms))
    model, data = env.physics.model.ptr, env.physics.data.ptr
    drawn = {}
    for geom in np.flatnonzero(model.geom_group < 3):  # as in MuJoCo's viewers
        name = model.body(model.geom_bodyid[geom]).name
        if name.startswith(("robot/", "sheath/")):
            kind = KINDS[model.geom_type[geom]]
            drawn.setdefault((name, kind), []).append(geom)
    assert sum(map(len, drawn.values())) == len(geoms) > 80
    assert {kind for name, kind in drawn if name.startswith("sheath")} == {
        "Cylinders3D"
    }
    moving = set()
    for (name, kind), own in drawn.items():
        rows = file.static | file.temporal
        pose, shape = rows[f"/world/{name}"], rows[f"/world/{name}/{SHAPES[kind]}"]
        moving |= {name} & {each.removeprefix("/world/") for each in file.temporal}
        place, turn = (
            pose[f"Transform3D:{part}"][-1].as_py()[0]
            for part in ("translation", "quaternion")
        )
        shape = {
            part.partition(":")[2]: np.array(values[-1].as_py())
            for part, values in shape.items()
            if part.startswith(kind)
        }
        turn, turned = (Rotation.from_quat(q) for q in (turn, shape["quaternions"]))
        size, middle = shape.get("half_sizes"), shape.get("centers")
        if size is None:
            size = np.column_stack([shape["radii"], shape["lengths"] / 2])
        if middle is None:  # Rerun starts a capsule at its lower end
            upwards = turned.as_matrix()[..., 2]
            middle = shape["translations"] + size[:, 1:] * upwards
        found = turn.apply(middle) + place
        np.testing.assert_allclose(found, data.geom_xpos[own], atol=1e-6)
        found = (turn * turned).as_matrix().reshape(-1, 9)
        np.testing.assert_allclose(found, data.geom_xmat[own], atol=1e-6)
        wanted = model.geom_size[own][:, : size.shape[1]]
        np.testing.assert_allclose(size, wanted, rtol=1e-6)
        material = model.geom_matid[own]
        rgba = np.where(material[:, None] < 0, model.geom_rgba[own],
                        model.mat_rgba[material])  # fmt: skip
        rgba[:, 3] *= 0.3 if name.startswith("sheath") else 1.0
        found = shape["colors"].astype(">u4").view(np.uint8).reshape(-1, 4)
        np.testing.assert_array_equal(found, np.round(255 * rgba))
    assert {"robot/catheter_platform", "robot/catheter_ring"} & moving
    assert "robot/rail" not in moving  # what stands still is written once
