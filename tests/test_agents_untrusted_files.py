"""Files of a run from elsewhere: what is wrong in them is named."""

import hashlib
import json
import shutil

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from test_agents_training import run, small_ppo

from cathsim_dmc.agents import Checkpoint, CheckpointError
from cathsim_dmc.agents.replay import ReplayError, ReplayMemory


def transitions(count, size=3):
    return TensorDict(
        {
            "observation_vector": torch.arange(count * size).reshape(count, size) / 7,
            "pixels": torch.arange(count, dtype=torch.uint8)[:, None, None],
            "next": {"done": torch.arange(count)[:, None] % 2 == 0},
        },
        [count],
    )


def replay(folder, capacity=8, max_bytes=2**20):
    keys = ["observation_vector", "pixels", ("next", "done")]
    return ReplayMemory(folder, keys, capacity, max_bytes)


def written_replay(folder, capacity=8, count=10):
    memory = replay(folder, capacity)
    memory.extend(transitions(count)[:6])
    memory.extend(transitions(count)[6:])
    return memory


def test_a_replay_comes_back_as_it_was(tmp_path):
    memory = written_replay(tmp_path / "replay")
    assert memory.state()["cursor"] == 2 and len(memory) == 8
    again = replay(tmp_path / "replay")
    again.load(json.loads(json.dumps(memory.state())))
    torch.manual_seed(0)
    expected = memory.sample(50)
    torch.manual_seed(0)
    found = again.sample(50)
    assert (found == expected).all()
    assert found["next", "done"].dtype == torch.bool
    whole = again._storage["pixels"].flatten().tolist()
    assert whole == [8, 9, 2, 3, 4, 5, 6, 7]
    # Both processes map the same files.
    again.extend(transitions(1))
    assert memory._storage["pixels"].flatten().tolist()[2] == 0


def test_a_replay_takes_its_room_on_the_disk_at_once(tmp_path):
    memory = replay(tmp_path / "replay", 1_000)
    memory.extend(transitions(1, size=64))
    size = (tmp_path / "replay" / "observation_vector.npy").stat()
    assert size.st_size > 1_000 * 64 * 4
    assert size.st_blocks * 512 >= size.st_size
    huge = replay(tmp_path / "other", 2**45, 2**60)
    with pytest.raises(OSError, match="lower replay_bytes"):
        huge.extend(transitions(1))


def test_replay_files_that_are_lost_are_named(tmp_path):
    folder = tmp_path / "replay"
    state = written_replay(folder).state()
    path = folder / "pixels.npy"
    data = path.read_bytes()
    np.save(folder / "object.npy", np.array([{}] * 8), allow_pickle=True)
    np.save(folder / "fewer.npy", np.zeros((7, 1), np.uint8))
    others = [(folder / f"{name}.npy").read_bytes() for name in ("object", "fewer")]
    for wrong in (data[:-1], b"", *others):
        path.write_bytes(wrong)
        with pytest.raises(ReplayError, match=r"pixels.npy .*without_replay") as caught:
            replay(folder).load(state)
        assert "\n" not in str(caught.value)
        assert path.read_bytes() == wrong


def checkpoint_of(folder):
    return Checkpoint.open(folder).path


@pytest.mark.parametrize(
    ("group", "name", "value", "match"),
    [
        (None, "format", "2", "format is"),
        (None, "sha256", 3, "sha256|subscript"),
        ("config", "hidden", [0], "hidden"),
        ("shapes", "vector", "x", "shapes.vector is"),
    ],
)
def test_a_wrong_description_names_the_field(
    tmp_path, trained, group, name, value, match
):
    shutil.copytree(trained / "ppo", tmp_path / "run")
    path = checkpoint_of(tmp_path / "run")
    values = json.loads((path / "checkpoint.json").read_text())
    (values if group is None else values[group])[name] = value
    (path / "checkpoint.json").write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=match) as caught:
        Checkpoint.open(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", ["policy.pt", "learning.pt"])
def test_a_damaged_file_of_a_checkpoint_is_named(tmp_path, trained, name):
    shutil.copytree(trained / "ppo", tmp_path / "run")
    path = checkpoint_of(tmp_path / "run")
    (path / name).write_bytes((path / name).read_bytes()[:-1])
    with pytest.raises(CheckpointError, match=f"{name} is damaged"):
        run(small_ppo(total_frames=1_024), tmp_path / "run", resume=True)
    # With a checksum that fits.
    values = json.loads((path / "checkpoint.json").read_text())
    values["sha256"][name] = hashlib.sha256((path / name).read_bytes()).hexdigest()
    (path / "checkpoint.json").write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=f"{name} holds no weights") as caught:
        run(small_ppo(total_frames=1_024), tmp_path / "run", resume=True)
    assert "\n" not in str(caught.value)
