"""The recorder on the navigation task."""

import mujoco
import numpy as np
import pytest
from conftest import twin
from recording_samples import same
from test_own_objective import advancing

from cathsim_dmc import suite
from cathsim_dmc.analysis.force_statistics import recorded_forces
from cathsim_dmc.anatomy.arch.arch import ARCHES, build_arch
from cathsim_dmc.recording import recorder
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.recording.rerun_log import write_rrd
from cathsim_dmc.recording.rerun_scene import body_geoms

STEPS = 40


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
    assert meta["goal_radius"] == 8e-3
    np.testing.assert_array_equal(meta["goal_position"], env.task.goal_position)
    assert set(meta["reward_terms"]) == set(env.task.objective.weights)
    link = meta["body_names"].index("catheter/link_2")
    np.testing.assert_array_equal(episode.catheter[:, 2], episode.body_pos[:, link])


def test_sides_of_the_patient_are_told_where_they_are_known(env, monkeypatch):
    here = env.task.scene.anatomy
    assert EpisodeRecorder(env).present().meta["upright"] is True  # a phantom
    monkeypatch.setattr(recorder, "is_upright", lambda anatomy: anatomy is not here)
    assert EpisodeRecorder(env).present().meta["upright"] is False


def test_a_seed_repeats_the_episode(env, episode):
    recorder = EpisodeRecorder(env, "navigate", {"goal": "bca"})
    again = recorder.record_episode(bend_and_push, seed=2, max_steps=STEPS)
    assert same(again, episode)
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


def test_the_episode_is_drawn_with_its_robot(env, episode, tmp_path):
    geoms = tuple(body_geoms(env.physics))
    assert {g.body_name.split("/")[0] for g in geoms} == {"robot", "sheath"}
    # The tube that is seen, not the thick sides of the bore that the device touches.
    assert {g.kind for g in geoms if g.body_name.startswith("sheath")} == {"cylinder"}
    loaded = Episode.load(episode.save(tmp_path / "e.npz"))
    path = write_rrd(
        loaded, env.task.scene.anatomy.surface, tmp_path / "e.rrd", robot_geoms=geoms
    )
    assert path.stat().st_size < 5e6
    forces = recorded_forces(loaded)
    assert 0 < forces.max.mean <= forces.max.maximum <= forces.peak_max.maximum
    assert forces.sum.mean < forces.sum.mean_in_contact
