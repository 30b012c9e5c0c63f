"""Recorded episodes as Minari datasets, read back by Minari."""

import dataclasses
import types

import numpy as np
import pytest

minari = pytest.importorskip("minari")

from cathsim_dmc.recording import dataset  # noqa: E402
from cathsim_dmc.recording.dataset import export, repeat_episodes  # noqa: E402
from cathsim_dmc.recording.recorder import EpisodeRecorder  # noqa: E402

TASK, SHORT = "simple1_bca", {"max_steps": 9}


@pytest.fixture(scope="module")
def episodes(shared_environment):
    env = shared_environment(TASK, **SHORT)
    recorder = EpisodeRecorder(env, TASK, {"random": 5, **SHORT})
    draw = np.random.default_rng(0)

    def policy(_):
        return draw.uniform(-1, 1, 21).astype(np.float32)

    return [recorder.record_episode(policy, seed, 9 - seed) for seed in (3, 4)]


def test_a_dataset_holds_what_happened(episodes, tmp_path):
    folder = tmp_path / "own-v0"
    size = {"size": 32, "noise": True}
    names = ["tracking", "image"]
    export(episodes, folder, observation=names, task_kwargs={"fluoroscopy": size})
    found = minari.MinariDataset(folder / "data")
    assert found.total_steps == 6 + 5
    for episode, data in zip(episodes, found.iterate_episodes(), strict=True):
        np.testing.assert_array_equal(data.actions, episode.action)
        np.testing.assert_allclose(data.rewards, episode.reward, atol=1e-9)
        forces = data.infos["wall_force_max"][1:]
        np.testing.assert_allclose(forces, episode.wall_force_max, atol=1e-9)
        heads = data.observations["tracking_points"][:, -3:]
        np.testing.assert_allclose(heads, episode.head, atol=1e-4)
        assert data.observations["image"].shape == (episode.steps + 1, 32, 32, 1)
        assert data.truncations.tolist() == [False] * (episode.steps - 1) + [True]
        assert not data.terminations.any() and data.actions.dtype == np.float32
    again = found.recover_environment()
    first = next(found.iterate_episodes()).observations["tracking_points"][0]
    shown = again.reset(seed=3)[0]["tracking_points"]
    np.testing.assert_array_equal(shown, first)


def test_a_time_limit_truncates_and_actions_keep_their_precision(
    shared_environment, tmp_path
):
    env, draw = shared_environment(TASK, **SHORT), np.random.default_rng(1)
    recorder = EpisodeRecorder(env, TASK, SHORT)
    episode = recorder.record_episode(lambda _: draw.uniform(-1, 1, 21), 6)
    export([episode], tmp_path / "own", observation="tracking")
    found = minari.MinariDataset(tmp_path / "own" / "data")
    (data,) = found.iterate_episodes()
    assert data.truncations.tolist() == [False] * 8 + [True]
    assert not data.terminations.any()
    np.testing.assert_array_equal(data.actions, episode.action)
    assert found.id == "own-v0"  # an id of Minari ends in a version


def test_room_for_the_arrays_of_all_episodes_is_asked_for(tmp_path, monkeypatch):
    """Compressed they take less, but noise does not."""
    asked = []
    monkeypatch.setattr(dataset, "fill", lambda path, size: asked.append(size))
    (tmp_path / "space").touch()
    images, force = np.zeros((20, 512, 512), np.uint8), {"force": np.zeros(20)}
    one = types.SimpleNamespace(observations={"image": images}, infos=force)
    one.actions = np.zeros((19, 3))
    dataset._check_space(tmp_path / "space", [one, one])
    assert 2.1 * images.nbytes < asked[0] < 3 * images.nbytes


def test_a_learner_repeats_actions_of_double_precision(shared_environment, tmp_path):
    """As a function of the user's own returns them; the learner rounds them."""
    env, draw = shared_environment(TASK, **SHORT), np.random.default_rng(1)
    recorder = EpisodeRecorder(env, TASK, SHORT)
    episode = recorder.record_episode(lambda _: draw.uniform(-1, 1, 21), 6)
    assert (episode.action != episode.action.astype(np.float32)).any()
    episode.save(tmp_path / "own.npz")
    (read,) = repeat_episodes(tmp_path, "tracking", task=TASK)
    np.testing.assert_array_equal(read.actions, episode.action.astype(np.float32))
    np.testing.assert_array_equal(-read.infos["distance"][1:], episode.reward)


def test_episodes_get_another_reward(episodes, tmp_path):
    reward = {"path": -1.0, "success": 10.0}
    export(episodes, tmp_path / "own", task_kwargs={"reward": reward})
    found = minari.MinariDataset(tmp_path / "own" / "data")
    for read, episode in zip(found.iterate_episodes(), episodes, strict=True):
        np.testing.assert_array_equal(read.rewards, read.infos["reward_path"][1:])
        assert (read.rewards != episode.reward).all()
    moved = dataclasses.replace(episodes[0], qpos=episodes[0].qpos + 1e-6)
    with pytest.raises(ValueError, match="positions 1e-06 apart, at step 0"):
        export([moved], tmp_path / "x", task_kwargs={"reward": reward})


def test_what_cannot_be_repeated_is_refused(episodes, tmp_path):
    first, second = episodes
    other = dataclasses.replace(second, task="type1_lcca")
    moved = dataclasses.replace(first, reward=first.reward + 1e-3)
    longer = {**second.meta, "task_kwargs": {"max_steps": 10}}
    for given, options, message in (
        ([], {}, "at least one Episode"),
        ([first, other], {}, "of its own"),
        ([first, dataclasses.replace(second, meta=longer)], {}, "of its own"),
        ([dataclasses.replace(first, seed=None)], {}, "seed None"),
        ([moved], {}, "does not repeat"),
        ([first], {"max_steps": 2}, "ends at step 1 instead of 5"),
        ([first], 3, "task_kwargs is 3"),
    ):
        with pytest.raises(ValueError, match=message):
            export(given, tmp_path / "x", task_kwargs=options)
    with pytest.raises(ValueError, match="an episode is 3"):
        export([3], tmp_path / "x")
    with pytest.raises(FileExistsError):
        export(episodes, tmp_path)
    assert not (tmp_path / "x").exists()
