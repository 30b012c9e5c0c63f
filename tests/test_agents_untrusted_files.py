"""Files of a run from elsewhere: what is wrong in them is named."""

import hashlib
import io
import json
import shutil
import zipfile

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from test_agents_training import run, small_ppo

from cathsim_dmc.agents import (
    Checkpoint,
    CheckpointError,
    checkpoint,
    learner,
    networks,
    pretrained,
)
from cathsim_dmc.agents.learners import config_from_dict
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


def replay(folder, capacity=8, max_bytes=2**20, expected=None):
    keys = ["observation_vector", "pixels", ("next", "done")]
    return ReplayMemory(folder, keys, capacity, max_bytes, expected or capacity)


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
    # A short run takes less, and more when it is resumed to be longer.
    sparse = {"folder": tmp_path / "short", "capacity": 100_000, "max_bytes": 2**30}
    short = replay(**sparse, expected=1_000)
    short.extend(transitions(1, size=64))
    path = tmp_path / "short" / "observation_vector.npy"
    assert 1_000 * 64 * 4 <= path.stat().st_blocks * 512 < 2_000 * 64 * 4
    assert path.stat().st_size > 100_000 * 64 * 4
    longer = replay(**sparse, expected=2_000)
    longer.load(short.state())
    assert 2_000 * 64 * 4 <= path.stat().st_blocks * 512 < 3_000 * 64 * 4
    assert (longer.sample(1)["pixels"] == 0).all()
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
    with pytest.raises(CheckpointError, match=rf"^\S*{name} is damaged"):
        run(small_ppo(total_frames=1_024), tmp_path / "run", resume=True)
    # With a checksum that fits.
    values = json.loads((path / "checkpoint.json").read_text())
    values["sha256"][name] = hashlib.sha256((path / name).read_bytes()).hexdigest()
    (path / "checkpoint.json").write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=rf"^\S*{name} holds no w") as caught:
        run(small_ppo(total_frames=1_024), tmp_path / "run", resume=True)
    assert "\n" not in str(caught.value)
    edited(path / "checkpoint.json", None, "frames", -5)
    with pytest.raises(CheckpointError, match="frames is -5"):
        Checkpoint.open(path)


# What a description asks for is never made before the weights are seen to hold it.

HUGE = [
    ("config", "hidden", [20_000, 20_000]),
    ("config", "hidden", [1] * 100_000),
    ("config", "cnn_features", 60_000),
    ("config", "convolutions", [[60_000, 1, 1], [60_000, 1, 1]]),
    ("shapes", "vector", 10**9),
    ("shapes", "actions", 10**12),
    ("shapes", "pixels", [3, 10**6, 10**6]),
]


@pytest.fixture
def only_shapes(monkeypatch):
    """Networks may be described, and not made."""

    def make_policy(shapes, config):
        assert torch.empty(1).device.type == "meta", "a network was made"
        return networks.make_policy(shapes, config)

    monkeypatch.setattr(checkpoint, "make_policy", make_policy)
    monkeypatch.setattr(learner, "make_policy", make_policy)


def edited(path, group, name, value):
    values = json.loads(path.read_text())
    (values if group is None else values[group])[name] = value
    path.write_text(json.dumps(values))


@pytest.mark.parametrize(("group", "name", "value"), HUGE)
def test_a_description_of_a_huge_network_is_refused_before_it_is_made(
    tmp_path, trained, only_shapes, group, name, value
):
    shutil.copytree(trained / "ppo", tmp_path / "run")
    path = checkpoint_of(tmp_path / "run")
    edited(path / "checkpoint.json", group, name, value)
    images = name in ("cnn_features", "convolutions")
    if images:
        edited(path / "checkpoint.json", "shapes", "pixels", [1, 80, 80])
    found = Checkpoint.open(path)
    with pytest.raises(CheckpointError, match="does not fit the network"):
        found.policy()
    if group == "config" and not images:
        edited(tmp_path / "run" / "config.json", None, name, value)
        with pytest.raises(CheckpointError, match="does not fit the network"):
            config = config_from_dict(
                json.loads((tmp_path / "run" / "config.json").read_text())
            )
            run(config.replace(total_frames=9_999), tmp_path / "run", resume=True)


@pytest.mark.parametrize(("group", "name", "value"), HUGE)
def test_a_card_of_a_huge_network_is_refused_before_it_is_made(
    tmp_path, only_shapes, group, name, value
):
    for path in pretrained.DIRECTORY.glob("navigator_image.*"):
        shutil.copy(path, tmp_path)
    edited(tmp_path / "navigator_image.json", group, name, value)
    if name in ("cnn_features", "convolutions"):
        edited(tmp_path / "navigator_image.json", "shapes", "pixels", [1, 80, 80])
    with pytest.raises(CheckpointError, match="does not fit the network"):
        pretrained.read_pretrained(tmp_path / "navigator_image.safetensors")


class Makes:
    """A pickle that makes what a function returns."""

    def __init__(self, function, *arguments):
        self.made = function, arguments

    def __reduce__(self):
        return self.made


def as_file(state, packing=zipfile.ZIP_STORED):
    """A file of `torch.save` with another packing."""
    stream, packed = io.BytesIO(), io.BytesIO()
    torch.save(state, stream)
    with zipfile.ZipFile(stream) as old, zipfile.ZipFile(packed, "w", packing) as new:
        for one in old.infolist():
            new.writestr(one.filename, old.read(one))
    return packed.getvalue()


# What a file holds, and what is said of it.
FILES = {
    "entries are larger": lambda: as_file(
        {"a": torch.zeros(10**6)}, zipfile.ZIP_DEFLATED
    ),
    "names .*bytearray": lambda: as_file({"a": Makes(bytearray, 10**9)}),
    "names .*torch Tensor": lambda: as_file({"a": Makes(torch.Tensor, 10**9)}),
    "names .*exec": lambda: as_file({"a": Makes(exec, "raise SystemExit")}),
    "of shape .1000000000000": lambda: as_file({"a": torch.zeros(1).expand(10**12)}),
    "not a zip": lambda: b"no archive",
    "does not fit": lambda: as_file([torch.zeros(1)]),
}


@pytest.mark.parametrize("message", FILES)
def test_weights_that_would_grow_are_refused(tmp_path, trained, message):
    shutil.copytree(trained / "ppo", tmp_path / "run")
    path, data = checkpoint_of(tmp_path / "run"), FILES[message]()
    (path / "policy.pt").write_bytes(data)
    values = json.loads((path / "checkpoint.json").read_text())
    values["sha256"]["policy.pt"] = hashlib.sha256(data).hexdigest()
    (path / "checkpoint.json").write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=f"policy.pt .*{message}"):
        Checkpoint.open(path).policy()
