"""Episodes as Minari datasets, read back by Minari, Gymnasium and TorchRL."""

import subprocess
import sys

import numpy as np
import pytest

minari = pytest.importorskip("minari")

from cathsim_dmc import suite  # noqa: E402
from cathsim_dmc.recording import EpisodeRecorder  # noqa: E402
from cathsim_dmc.recording.dataset import export  # noqa: E402

OPTIONS = {"max_steps": 12, "goal_radius": 0.01}
DATASET = "simple1_bca-v0"


def record(seeds, task="simple1_bca", **options):
    options = {**OPTIONS, **options}
    env = suite.load("cathsim", task, options)
    recorder = EpisodeRecorder(env, task, options)
    random = np.random.default_rng(0)

    def policy(timestep):
        action = random.uniform(-1, 1, 21).astype(np.float32)
        return action.astype(np.float64)

    return [
        recorder.record_episode(policy, seed, max_steps=9 + s)
        for s, seed in enumerate(seeds)
    ]


@pytest.fixture(scope="module")
def episodes():
    return record([3, 4, 5, 6])


@pytest.fixture
def directory(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path / DATASET


def test_a_dataset_holds_what_happened(episodes, directory):
    export(episodes, directory, observation=["tracking", "force"])
    dataset = minari.load_dataset(DATASET)
    assert dataset.total_episodes == 4
    assert dataset.total_steps == 9 + 10 + 11 + 12
    for episode, data in zip(episodes, dataset.iterate_episodes(), strict=True):
        np.testing.assert_array_equal(data.actions, episode.action)
        np.testing.assert_allclose(data.rewards, episode.reward, atol=1e-9)
        heads = data.observations["tracking_points"][:, -3:]
        # States of the record are those of the end of a step, one physics step on.
        np.testing.assert_allclose(heads, episode.head, atol=1e-4)
        np.testing.assert_allclose(
            data.infos["wall_force_max"][1:], episode.wall_force_max, atol=1e-9
        )
        assert data.actions.dtype == np.float32
        assert not data.terminations.any()
        assert data.truncations.tolist() == [False] * (episode.steps - 1) + [True]
    env = dataset.recover_environment()
    observation, _ = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    np.testing.assert_array_equal(
        observation["tracking_points"],
        next(dataset.iterate_episodes()).observations["tracking_points"][0],
    )


def test_images_are_bytes_in_the_dataset(episodes, directory):
    export(
        episodes[:1],
        directory,
        observation="image",
        task_kwargs={"fluoroscopy": {"size": 32, "biplane": "LATERAL", "noise": True}},
    )
    data = next(minari.load_dataset(DATASET).iterate_episodes())
    assert data.observations["image"].shape == (10, 32, 32, 2)
    assert data.observations["image"].dtype == np.uint8


@pytest.mark.slow
def test_torchrl_loads_the_dataset(episodes, directory):
    export(episodes, directory, observation="tracking")
    # In a process of its own, which knows nothing of cathsim_dmc.
    code = f"""
import sys
from torchrl.data.datasets import MinariExperienceReplay
root = {str(directory.parent / "torch")!r}
data = MinariExperienceReplay(
    {DATASET!r}, batch_size=8, root=root, load_from_local_minari=True
)
assert len(data) == 42, len(data)
batch = data.sample()
assert batch["action"].shape == (8, 21)
assert batch["observation", "tracking_points"].shape == (8, 24)
assert batch["next", "observation", "tracking_points"].shape == (8, 24)
assert "cathsim_dmc" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_what_cannot_be_repeated_is_refused(episodes, directory):
    with pytest.raises(ValueError, match="0 episodes"):
        export([], directory)
    with pytest.raises(ValueError, match="of its own"):
        export([episodes[0], *record([1], task="type1_lcca")], directory)
    with pytest.raises(ValueError, match="seed None"):
        export(record([None]), directory)
    with pytest.raises(ValueError, match="does not repeat"):
        export(
            episodes, directory, task_kwargs={"friction": 0.5, "reward": {"path": -1.0}}
        )
    with pytest.raises(ValueError, match="instead of"):
        export(episodes, directory, task_kwargs={"max_steps": 5})
    assert not directory.exists()
