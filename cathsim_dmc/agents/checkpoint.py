"""Checkpoints: weights and numbers only, written whole or not at all."""

import hashlib
import io
import itertools
import json
import pickletools
import re
import shutil
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictSequential
from torch.utils._pytree import tree_leaves

from cathsim_dmc import bounds, files
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.learner import Learner
from cathsim_dmc.agents.learners import config_from_dict
from cathsim_dmc.agents.networks import NetworkShapes, make_policy

FORMAT = 2
_DIRECTORY = "checkpoints"
_DESCRIPTION = "checkpoint.json"
_POLICY = "policy.pt"
_LEARNING = "learning.pt"
_OTHER_NETWORK = "does not fit the network described beside it"
_WRONG = ValueError, TypeError, AttributeError, RuntimeError, OSError
# Globals in a pickle of tensors, numbers and texts.
_GLOBALS = {"torch._utils _rebuild_tensor_v2", "collections OrderedDict"}
_STORAGE = re.compile(r"torch \w+Storage")


class CheckpointError(RuntimeError):
    """A checkpoint is missing, incomplete, damaged or of another kind."""


@dataclass(frozen=True)
class Checkpoint:
    """A complete checkpoint on disk.

    Attributes:
        path: Directory of the checkpoint.
        config: Settings of the run that wrote it.
        shapes: Sizes of observation and action.
        frames: Number of frames that the run had seen.
        seconds: Wall time that the run had taken, over all its processes.
        sha256: Checksums of the files with the weights, by file name.
        versions: Versions of the packages that trained it, by name.
    """

    path: Path
    config: TrainingConfig
    shapes: NetworkShapes
    frames: int
    seconds: float
    sha256: Mapping[str, str]
    versions: Mapping[str, str]

    @classmethod
    def open(cls, path: str | Path) -> "Checkpoint":
        """Open a checkpoint, or the newest of a run; CheckpointError if damaged."""
        path = files.as_path("path", path)
        if not (path / _DESCRIPTION).exists():
            found = checkpoints_in(path)
            if not found:
                raise CheckpointError(
                    f"no checkpoint in {path}: give a run's directory or one of its "
                    f"{_DIRECTORY}/<frames>."
                )
            path = found[-1]
        description = path / _DESCRIPTION
        wrong = OSError, LookupError, TypeError, AttributeError, ValueError
        with files.refused(CheckpointError, str(description), wrong):
            values = json.loads(description.read_text())
            if values["format"] != FORMAT:
                raise ValueError(f"format is {values['format']!r}, not {FORMAT}")
            return cls(
                path=path,
                config=config_from_dict(values["config"]),
                shapes=NetworkShapes.from_dict(values["shapes"]),
                frames=bounds.whole("frames", values["frames"], 0),
                seconds=bounds.number("seconds", values["seconds"], 0.0),
                sha256={name: values["sha256"][name] for name in (_POLICY, _LEARNING)},
                versions=dict(values.get("versions", {})),
            )

    def policy_state(self) -> dict[str, Any]:
        """Return weights and statistics on the CPU; CheckpointError if damaged."""
        return self._load(_POLICY)

    def learning_state(self) -> dict[str, Any]:
        """Return the rest of the state for resuming; raises as `policy_state`."""
        return self._load(_LEARNING)

    def policy(self) -> TensorDictSequential:
        """Return the policy, raw observation in, action out; or CheckpointError."""
        file = self.path / _POLICY
        return policy_of(file, self.policy_state(), self.shapes, self.config)

    def require_sizes(self) -> None:
        """Raise CheckpointError unless the networks have the sizes in the config.

        Called before the networks of a resumed run are allocated.
        """
        file, state = self.path / _POLICY, self.policy_state()
        with files.refused(CheckpointError, f"{file} {_OTHER_NETWORK}", _WRONG):
            _require_sizes(state, self.shapes, self.config)
            # For images only the critic has hidden layers, which are in the other file.
            widths = self.config.hidden
            least = 4 * sum(a * b for a, b in itertools.pairwise(widths))
            sizes = [(self.path / name).stat().st_size for name in self.sha256]
            if least > sum(sizes):
                raise ValueError(f"hidden is {list(widths)}, larger than its files")

    def _load(self, name: str) -> dict[str, Any]:
        path = self.path / name
        data = read_bytes(path, self.sha256[name])
        # torch's reader of weights fails in many ways.
        with files.refused(CheckpointError, f"{path} holds no weights", Exception):
            # weights_only: a checkpoint from elsewhere must not be able to run code.
            _require_plain(data)
            state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
            _require_stored(state)
            return state


def _require_plain(data: bytes) -> None:
    """Raise ValueError unless a file of `torch.save` holds uncompressed tensors only.

    Torch would decompress entries, and allocate a buffer or a tensor of any size that
    the file names.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(one.file_size for one in archive.infolist()) > len(data):
            raise ValueError("its entries are larger than the file")
        (name,) = (one for one in archive.namelist() if one.endswith("/data.pkl"))
        for operation, named, _ in pickletools.genops(archive.read(name)):
            known = named in _GLOBALS or _STORAGE.fullmatch(str(named))
            if operation.name == "STACK_GLOBAL" or (
                operation.name in ("GLOBAL", "INST") and not known
            ):
                raise ValueError(f"it names {named!r}, which is no tensor")


def _require_stored(state: Any) -> None:
    """Raise ValueError if a tensor is larger than its storage."""
    for one in tree_leaves(state):
        if isinstance(one, torch.Tensor):
            held = one.untyped_storage().nbytes()
            if one.numel() * one.element_size() > held:
                raise ValueError(
                    f"a tensor of shape {tuple(one.shape)} has {held} bytes"
                )


def read_bytes(path: Path, sha256: str) -> bytes:
    """Return a file's content; CheckpointError if missing or its checksum differs."""
    with files.refused(CheckpointError, f"{path} cannot be read", OSError):
        data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != sha256:
        raise CheckpointError(
            f"{path} is damaged: its SHA-256 is not {sha256[:12]}…, as the JSON file "
            "beside it says. Use another copy, or an older checkpoint of the run."
        )
    return data


def policy_of(
    path: Path, state: Mapping[str, Any], shapes: NetworkShapes, config: TrainingConfig
) -> TensorDictSequential:
    """Return a policy in evaluation mode; CheckpointError if the weights do not fit."""
    with files.refused(CheckpointError, f"{path} {_OTHER_NETWORK}", _WRONG):
        _require_sizes(state, shapes, config)
        policy = make_policy(shapes, config)
        policy.load_state_dict(dict(state))
    return policy.eval().requires_grad_(False)


def _require_sizes(
    state: Mapping[str, Any], shapes: NetworkShapes, config: TrainingConfig
) -> None:
    """Raise ValueError unless weights have the shapes of the network described.

    The network is not allocated: the description may ask for any size.
    """
    if len(config.hidden) + len(config.convolutions) > len(state):
        raise ValueError("it has fewer weights than the network has layers")
    with torch.device("meta"):  # shapes without memory
        wanted = make_policy(shapes, config).state_dict()
    sizes = {name: tuple(one.shape) for name, one in wanted.items()}
    found = {name: tuple(one.shape) for name, one in state.items()}
    wrong = [n for n in {**sizes, **found} if sizes.get(n) != found.get(n)]
    if wrong:
        raise ValueError(
            f"{wrong[0]} has the shape {found.get(wrong[0])} in the weights and "
            f"{sizes.get(wrong[0])} in the network"
        )


def checkpoints_in(run: Path) -> list[Path]:
    """Return the complete checkpoints of a run, oldest first."""
    found = (Path(run) / _DIRECTORY).glob(f"*/{_DESCRIPTION}")
    complete = (file.parent for file in found if file.parent.name.isdecimal())
    return sorted(complete, key=lambda child: int(child.name))


def read_newest(path: str | Path, read: Callable[[Checkpoint], Any]) -> Any:
    """Return what a function reads from a checkpoint, or from the newest of a run.

    It is called again where a training has deleted the checkpoint meanwhile, as with
    `keep_checkpoints=1`, and has a newer one.

    Args:
        path: Directory of a checkpoint or of a run.
        read: Function of the open checkpoint.

    Raises:
        CheckpointError: see `Checkpoint.open`, or raised by `read`.
    """
    newest = checkpoints_in(Path(path))[-1:]
    while True:
        try:
            return read(Checkpoint.open(path))
        except CheckpointError:
            before, newest = newest, checkpoints_in(Path(path))[-1:]
            if newest == before:
                raise


def save_checkpoint(
    run: Path, learner: Learner, frames: int, seconds: float, learning: dict[str, Any]
) -> Path:
    """Write a checkpoint into a run's directory and delete the oldest ones.

    A directory with a checkpoint's name is always complete.

    Returns:
        Directory of the checkpoint.
    """
    directory = Path(run) / _DIRECTORY
    files.require_folder(directory, make=True)
    for one in set(directory.iterdir()) - set(checkpoints_in(run)):
        if one.is_dir() and re.fullmatch(r"\d{10,}|\.\d{10,}\..*partial", one.name):
            shutil.rmtree(one)  # of a process that was killed
    target = directory / f"{frames:010d}"
    if target.exists():
        # No frame was added since, as when a run is interrupted right after saving.
        return target
    packages = ("cathsim-dmc", "torch", "torchrl", "mujoco", "dm-control")
    sums: dict[str, str] = {}
    description = {
        "format": FORMAT, "frames": frames, "seconds": seconds,
        "config": learner.config.to_dict(), "shapes": learner.shapes.to_dict(),
        "sha256": sums, "versions": {name: version(name) for name in packages},
    }  # fmt: skip
    with files.atomic_directory(target) as temporary:
        states = {_POLICY: learner.policy_state(), _LEARNING: learning}
        for file, state in states.items():
            # Through memory: torch's file writer hides the cause on a full disk.
            stream = io.BytesIO()
            torch.save(dict(state), stream)
            data = stream.getvalue()
            sums[file] = hashlib.sha256(data).hexdigest()
            files.write_bytes(temporary / file, data)
        files.write_json(temporary / _DESCRIPTION, description)
    for old in checkpoints_in(run)[: -learner.config.keep_checkpoints]:
        (old / _DESCRIPTION).unlink()  # first: without it, it is no checkpoint
        shutil.rmtree(old)
    return target
