"""Checkpoints: weights and numbers only, complete or not there at all."""

import hashlib
import io
import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictSequential

from cathsim_dmc import files
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.learner import Learner
from cathsim_dmc.agents.learners import config_from_dict
from cathsim_dmc.agents.networks import NetworkShapes, make_policy

FORMAT = 2
_DIRECTORY = "checkpoints"
_DESCRIPTION = "checkpoint.json"
_POLICY = "policy.pt"
_LEARNING = "learning.pt"


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
    """

    path: Path
    config: TrainingConfig
    shapes: NetworkShapes
    frames: int
    seconds: float
    sha256: Mapping[str, str]

    @classmethod
    def open(cls, path: str | Path) -> "Checkpoint":
        """Open a checkpoint, or the newest of a run; CheckpointError if damaged."""
        path = Path(path)
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
        with files.refused(CheckpointError, str(description), *wrong):
            values = json.loads(description.read_text())
            if values["format"] != FORMAT:
                raise ValueError(f"format is {values['format']!r}, not {FORMAT}")
            return cls(
                path=path,
                config=config_from_dict(values["config"]),
                shapes=NetworkShapes.from_dict(values["shapes"]),
                frames=int(values["frames"]),
                seconds=float(values["seconds"]),
                sha256={name: values["sha256"][name] for name in (_POLICY, _LEARNING)},
            )

    def policy_state(self) -> dict[str, Any]:
        """Weights and statistics on the CPU; CheckpointError if damaged or missing."""
        return self._load(_POLICY)

    def learning_state(self) -> dict[str, Any]:
        """Everything else that continuing the run needs; raises as `policy_state`."""
        return self._load(_LEARNING)

    def policy(self) -> TensorDictSequential:
        """The policy, raw observation in, action out; CheckpointError if damaged."""
        file = self.path / _POLICY
        return policy_of(file, self.policy_state(), self.shapes, self.config)

    def _load(self, name: str) -> dict[str, Any]:
        path = self.path / name
        data = read_bytes(path, self.sha256[name])
        # torch's reader of weights fails in many ways.
        with files.refused(CheckpointError, f"{path} holds no weights", Exception):
            # weights_only: a checkpoint from elsewhere must not be able to run code.
            return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)


def read_bytes(path: Path, sha256: str) -> bytes:
    """Content of a file; CheckpointError if it is missing or its checksum differs."""
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
    """A policy ready to act; CheckpointError if the weights are of another network."""
    text = f"{path} does not fit the network described beside it"
    with files.refused(CheckpointError, text, ValueError, TypeError, RuntimeError):
        policy = make_policy(shapes, config)
        policy.load_state_dict(dict(state))
    return policy.eval().requires_grad_(False)


def checkpoints_in(run: Path) -> list[Path]:
    """Complete checkpoints of a run, oldest first."""
    found = (Path(run) / _DIRECTORY).glob(f"*/{_DESCRIPTION}")
    complete = (file.parent for file in found if file.parent.name.isdecimal())
    return sorted(complete, key=lambda child: int(child.name))


def save_checkpoint(
    run: Path, learner: Learner, frames: int, seconds: float, learning: dict[str, Any]
) -> Path:
    """Write a checkpoint into a run's directory and drop the oldest ones.

    A directory with a checkpoint's name is always complete.

    Returns:
        Its directory.
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
    packages = ("torch", "torchrl", "mujoco", "dm-control")
    sums: dict[str, str] = {}
    description = {
        "format": FORMAT, "frames": frames, "seconds": seconds,
        "config": learner.config.to_dict(), "shapes": learner.shapes.to_dict(),
        "sha256": sums, "versions": {name: version(name) for name in packages},
    }  # fmt: skip
    with files.atomic_directory(target) as temporary:
        states = {_POLICY: learner.policy_state(), _LEARNING: learning}
        for file, state in states.items():
            # By way of memory: torch's own writer hides the cause on a full disk.
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
