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


def test_replay_files_of_another_kind_are_refused(tmp_path):
    folder = tmp_path / "replay"
    state = written_replay(folder).state()
    path = folder / "pixels.npy"
    data = path.read_bytes()
    np.save(folder / "other.npy", np.zeros((8, 1), np.int64))
    np.save(folder / "fewer.npy", np.zeros((7, 1), np.uint8))
    others = [(folder / f"{name}.npy").read_bytes() for name in ("other", "fewer")]
    np.save(folder / "object.npy", np.array([{}] * 8), allow_pickle=True)
    others.append((folder / "object.npy").read_bytes())
    for wrong in (data[:-1], b"", *others):
        path.write_bytes(wrong)
        with pytest.raises(ReplayError, match=r"pixels.npy .*without_replay") as caught:
            replay(folder).load(state)
        assert "\n" not in str(caught.value)
        assert path.read_bytes() == wrong
    path.write_bytes(data)
    for name, value in (("size", 9), ("cursor", 8), ("size", -1), ("capacity", None)):
        with pytest.raises(ReplayError, match="replay"):
            replay(folder).load({**state, name: value})
    replay(folder).load(state)


def checkpoint_of(folder):
    return Checkpoint.open(folder).path


@pytest.mark.parametrize(
    ("group", "name", "value", "match"),
    [
        (None, "format", "2", "format is"),
        (None, "frames", -5, "frames=-5 .* >= 0"),
        (None, "seconds", float("nan"), "seconds=nan .*a finite number"),
        (None, "sha256", {"policy.pt": 3}, "sha256=.* names, each with"),
        ("config", "algorithm", "dqn", "algorithm .* is unknown.*ppo"),
        ("config", "hidden", [10**9], "hidden=.* not allowed"),
        ("config", "strange", 1, "no field .*strange"),
        ("shapes", "vector", 10**12, "shapes.vector="),
        ("shapes", "pixels", [1, 2, 0], "shapes.pixels="),
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


def rewritten(source, folder, **changes):
    """A copy of a run with other entries in learning.pt, and a checksum that fits."""
    shutil.copytree(source, folder)
    path = checkpoint_of(folder)
    state = torch.load(path / "learning.pt", weights_only=True)
    torch.save({**state, **changes}, path / "learning.pt")
    values = json.loads((path / "checkpoint.json").read_text())
    digest = hashlib.sha256((path / "learning.pt").read_bytes()).hexdigest()
    values["sha256"]["learning.pt"] = digest
    (path / "checkpoint.json").write_text(json.dumps(values))
    return state


@pytest.mark.parametrize("name", ["rng", "learner", "episodes"])
def test_a_checkpoint_that_learning_cannot_use_says_so(tmp_path, trained, name):
    for value in (None, {}, "x"):
        folder = tmp_path / str(value)
        rewritten(trained / "ppo", folder, **{name: value})
        with pytest.raises(CheckpointError, match="cannot be continued") as caught:
            run(small_ppo(total_frames=1_024), folder, resume=True)
        assert "\n" not in str(caught.value)


def test_learning_that_is_not_a_number_is_named(tmp_path, trained):
    state = Checkpoint.open(trained / "ppo").learning_state()
    state["learner"]["critic"]["module.value.bias"].fill_(float("nan"))
    rewritten(trained / "ppo", tmp_path / "run", learner=state["learner"])
    with pytest.raises(CheckpointError, match="learning.pt has NaN.*initial_policy"):
        run(small_ppo(total_frames=1_024), tmp_path / "run", resume=True)
