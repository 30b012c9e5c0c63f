"""Demonstrations as datasets: what they hold, and who may read them how."""

import json
import shutil

import h5py
import numpy as np
import pytest
import torch
from recording_samples import make_episode

from cathsim_dmc.agents import make_env, record_demonstrations
from cathsim_dmc.agents.demonstrations import EXPERT_ACTION, load_transitions
from cathsim_dmc.agents.networks import NetworkShapes
from cathsim_dmc.policies import Teacher, View
from cathsim_dmc.policies.expert import ExpertPolicy
from cathsim_dmc.recording import dataset
from cathsim_dmc.recording.dataset import DatasetError, read_episodes
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.suite import make_task

TASK = "simple1_bca"
# The goal is reached within a second or two of steps.
OPTIONS = {"goal_radius": 0.045}
EXPERT = f"infos/{EXPERT_ACTION}"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    out = tmp_path_factory.mktemp("demos") / "near-v0"
    return record_demonstrations(
        TASK, out, 3, observation=["tracking", "force"], noise=0.1, task_kwargs=OPTIONS
    )


@pytest.fixture
def copied(recorded, tmp_path):
    return shutil.copytree(recorded.path, tmp_path / "copy-v0")


@pytest.fixture(scope="module")
def shapes():
    env = make_env(TASK, observation="tracking", task_kwargs=OPTIONS)
    return NetworkShapes.of(env.observation_spec, env.action_spec)


def test_a_dataset_repeats_in_its_own_environment(recorded, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(recorded.path.parent))
    data = minari.load_dataset("near-v0")
    assert data.total_episodes == recorded.episodes == recorded.successes == 3
    assert data.total_steps == recorded.steps
    episode = next(data.iterate_episodes())
    env = data.recover_environment()
    observation, _ = env.reset(seed=2_000_000)
    for step, action in enumerate(episode.actions):
        for key, value in observation.items():
            np.testing.assert_array_equal(value, episode.observations[key][step])
        observation, reward, terminated, _, info = env.step(action)
        assert reward == episode.rewards[step]
        assert info["wall_force_max"] == episode.infos["wall_force_max"][step + 1]
    assert terminated and info["success"]
    env.close()


def test_noise_is_in_the_action_and_not_in_what_the_expert_would_do(recorded):
    for episode in read_episodes(recorded.path):
        expert = episode.infos[EXPERT_ACTION][:-1]
        noise = episode.actions - expert
        assert np.abs(episode.actions).max() <= 1
        assert 0.08 < noise[np.abs(expert) < 0.6].std() < 0.12


def test_the_same_seed_gives_the_same_demonstrations(recorded, tmp_path, monkeypatch):
    # Into a relative path this time.
    monkeypatch.chdir(tmp_path)
    again = record_demonstrations(
        TASK, "again", 1, observation="tracking", seed=2_000_001, noise=0.1,
        task_kwargs=OPTIONS,
    )  # fmt: skip
    (one,), many = read_episodes(again.path), list(read_episodes(recorded.path))
    np.testing.assert_array_equal(one.actions, many[1].actions)
    assert not np.array_equal(one.actions[:10], many[0].actions[:10])


def follows(env, transitions, steps):
    """An environment that is given the actions shows the observations, bit for bit."""
    state = env.reset()
    for row in range(steps):
        expected, key = transitions[row], "observation_vector"
        assert torch.equal(state[key][0], expected[key])
        state["action"] = expected["action"][None]
        state = env.step(state)["next"]
        torch.testing.assert_close(state["reward"][0], expected["next", "reward"])
        assert torch.equal(state[key][0], expected["next", key])


def test_transitions_are_what_an_environment_gives(recorded, shapes):
    transitions = load_transitions(recorded.path, "tracking", shapes)
    assert len(transitions) == recorded.steps
    env = make_env(
        TASK, observation="tracking", seed=2_000_000, task_kwargs=OPTIONS
    )  # the numbers of the first episode
    follows(env, transitions, 4)
    ends = transitions["next", "done"].flatten().nonzero().flatten()
    assert len(ends) == 3 and transitions["next", "terminated"][ends].all()


def test_what_does_not_fit_is_refused(recorded, shapes, tmp_path):
    with pytest.raises(DatasetError, match="lacks .*com_inertia.*tracking_points"):
        load_transitions(recorded.path, "internal", shapes)
    with pytest.raises(DatasetError, match="actions=21.*actions=22"):
        other = NetworkShapes(shapes.vector, None, 22)
        load_transitions(recorded.path, "tracking", other)
    with pytest.raises(DatasetError, match="no dataset in"):
        load_transitions(tmp_path, "tracking", shapes)
    with pytest.raises(DatasetError, match="a.npz is a file: .*into a folder"):
        load_transitions("a.npz", "tracking", shapes)
    with pytest.raises(FileExistsError, match="choose another"):
        record_demonstrations(TASK, recorded.path, 1)
    with pytest.raises(FileNotFoundError, match="create it"):
        record_demonstrations(TASK, tmp_path / "not" / "there", 1)
    with pytest.raises(ValueError, match="episodes is 0"):
        record_demonstrations(TASK, tmp_path / "none", 0)
    with pytest.raises(ValueError, match="noise is -1"):
        record_demonstrations(TASK, tmp_path / "none", 1, noise=-1)


def test_nothing_is_left_of_a_dataset_that_fails(tmp_path, monkeypatch):
    from minari.dataset._storages.hdf5_storage import HDF5Storage

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(HDF5Storage, "update_episodes", full)
    with pytest.raises(OSError, match="No space"):
        record_demonstrations(TASK, tmp_path / "full", 1, task_kwargs=OPTIONS)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_told_before_hdf5_meets_it(tmp_path, small_disk):
    with small_disk(50_000), pytest.raises(OSError, match="too large.*full-v0"):
        record_demonstrations(TASK, tmp_path / "full-v0", 1, task_kwargs=OPTIONS)
    assert not list(tmp_path.iterdir())


def test_a_second_writer_of_a_dataset_is_refused_before_the_work(tmp_path):
    out = tmp_path / "one-v0"
    episode = make_episode(task=TASK, seed=1)
    writers = {
        "demos": lambda: record_demonstrations(TASK, out, 1, say=work),
        "export": lambda: dataset.export([episode], out),
    }

    def work(text):
        raise AssertionError("work was begun")

    def second(text):
        for write in writers.values():
            words = f"another process writes {out}; wait for its end, or choose another"
            with pytest.raises(FileExistsError, match=words):
                write()
        called.append(True)

    called = []
    record_demonstrations(TASK, out, 1, task_kwargs=OPTIONS, say=second)
    assert called and [one.name for one in tmp_path.iterdir()] == ["one-v0"]


def test_reading_a_dataset_runs_nothing_that_it_names(copied, shapes):
    """Minari makes the environment of a dataset without spaces."""
    file = copied / "data" / "metadata.json"
    values = json.loads(file.read_text())
    del values["observation_space"]
    file.write_text(json.dumps(values))
    with pytest.raises(DatasetError, match="lacks the spaces"):
        load_transitions(copied, "tracking", shapes)


def edit(directory, change):
    with h5py.File(directory / "data" / "main_data.hdf5", "r+") as file:
        change(file["episode_1"])


def replace(group, name, value):
    del group[name]
    group[name] = value


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g: replace(g, "actions", np.array([b"text"])), "cannot be used"),
        (lambda g: replace(g, "actions", np.zeros((3, 21))), "finite rows"),
        (lambda g: g["actions"].__setitem__((0, 0), np.nan), "finite rows"),
        (lambda g: g.__delitem__("rewards"), "rewards"),
        (lambda g: g[EXPERT].__setitem__(slice(None), np.nan), "of finite numbers"),
        (lambda g: replace(g, EXPERT, g[EXPERT][:, :3]), "float32 of shape"),
    ],
)
def test_a_damaged_dataset_is_refused(copied, shapes, change, message):
    edit(copied, change)
    with pytest.raises(DatasetError, match=message):
        load_transitions(copied, "tracking", shapes)


def test_actions_are_learnt_as_the_drives_clip_them(copied, shapes):
    edit(copied, lambda g: g["actions"].__setitem__((0, 0), 3.0))
    assert load_transitions(copied, "tracking", shapes)["action"].max() == 1.0


def test_failed_episodes_are_no_demonstrations(recorded, copied, shapes):
    edit(copied, lambda g: g["infos/success"].__setitem__(slice(None), False))
    lengths = [len(episode.actions) for episode in read_episodes(recorded.path)]
    kept = load_transitions(copied, "tracking", shapes)
    assert len(kept) == lengths[0] + lengths[2]


@pytest.fixture(scope="module")
def task():
    return make_task("type1_lcca")


def test_the_teacher_agrees_with_the_expert_that_it_watches(task):
    """While it needs no second attempt, the expert's action is the teacher's."""
    simulation = BatchSimulation(task, 2, seeds=7)
    simulation.reset()
    view, everyone = View(simulation), np.ones(2, dtype=bool)
    expert, teacher = ExpertPolicy(), Teacher(view)
    expert.reset(view, everyone)
    teacher.reset(everyone)
    last = np.zeros((2, view.num_actions))
    for _ in range(25):
        action = expert.act(None)
        np.testing.assert_allclose(teacher.act(last), action, atol=1e-12)
        last = action
        simulation.step(action)


def test_the_teacher_goes_on_from_what_was_really_done(task):
    """The expert alone believes in commands that it gave and nobody carried out."""
    simulation = BatchSimulation(task, 1, seeds=7)
    simulation.reset()
    view, everyone = View(simulation), np.ones(1, dtype=bool)
    expert, followed, teacher = ExpertPolicy(), ExpertPolicy(), Teacher(view)
    for one in (expert, followed):
        one.reset(view, everyone)
    teacher.reset(everyone)
    done = np.zeros((1, view.num_actions))
    done[0, 0:20:2], done[0, -1] = 0.5, 0.3
    last = np.zeros_like(done)
    for _ in range(12):
        alone, told, taught = expert.act(None), followed.act(None), teacher.act(last)
        followed.follow(done)
        simulation.step(done)
        last = done
    np.testing.assert_allclose(told, taught, atol=1e-12)
    # One correction is at most max_bend_rate / steering_angle.
    assert np.abs(taught[0, :20] - done[0, :20]).max() < 0.5
    assert np.abs(alone[0, :20] - done[0, :20]).max() > 0.4


def test_demonstrations_of_coaxial_devices_are_what_an_environment_gives(tmp_path):
    task, options = "simple1_bca_pair", {**OPTIONS, "max_steps": 150}
    recorded = record_demonstrations(task, tmp_path / "shown", 1, task_kwargs=options)
    assert recorded.successes == 1
    env = make_env(task, observation="tracking", seed=2_000_000, task_kwargs=options)
    size = env.observation_spec["observation_vector"].shape[-1]
    shapes = NetworkShapes(size, None, 4)
    transitions = load_transitions(recorded.path, "tracking", shapes)
    assert len(transitions) == recorded.steps
    follows(env, transitions, 3)
