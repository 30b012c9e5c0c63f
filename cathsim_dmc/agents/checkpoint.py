"""Checkpoints: weights and numbers only, complete or not there at all."""

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictSequential

from cathsim_dmc.agents.configs import TrainingConfig, config_from_dict
from cathsim_dmc.agents.networks import Signature, make_policy

FORMAT = 1
_DIRECTORY = "checkpoints"
_DESCRIPTION = "checkpoint.json"
_POLICY = "policy.pt"
_LEARNING = "learning.pt"
_UNFINISHED = ".unfinished-"


class CheckpointError(RuntimeError):
    """A checkpoint is missing, incomplete or of another kind."""


@dataclass(frozen=True)
class Checkpoint:
    """A complete checkpoint on disk.

    Attributes:
        path: its directory.
        config: of the run that wrote it.
        signature: sizes of observation and action.
        frames: frames the run had seen.
        seconds: wall time the run had taken, over all its processes.
    """

    path: Path
    config: TrainingConfig
    signature: Signature
    frames: int
    seconds: float

    @classmethod
    def open(cls, path: str | Path) -> "Checkpoint":
        """Open a checkpoint, or the newest one of a run.

        Args:
            path: a checkpoint's directory or a run's directory.

        Raises:
            CheckpointError: there is none, or it cannot be read.
        """
        path = Path(path)
        if not (path / _DESCRIPTION).exists():
            found = checkpoints_in(path)
            if not found:
                raise CheckpointError(
                    f"no checkpoint in {path}: give a run's directory or one of its "
                    f"{_DIRECTORY}/<frames>."
                )
            path = found[-1]
        try:
            values = json.loads((path / _DESCRIPTION).read_text())
        except ValueError as error:
            raise CheckpointError(f"{path / _DESCRIPTION}: {error}") from error
        if values.get("format") != FORMAT:
            raise CheckpointError(
                f"{path} has format {values.get('format')!r}, this version reads "
                f"{FORMAT}."
            )
        return cls(
            path=path,
            config=config_from_dict(values["config"]),
            signature=Signature.from_dict(values["signature"]),
            frames=values["frames"],
            seconds=values["seconds"],
        )

    def policy_state(self) -> dict[str, Any]:
        """Weights and statistics of the policy, on the CPU."""
        return _load(self.path / _POLICY)

    def learning_state(self) -> dict[str, Any]:
        """Everything else that continuing the run needs."""
        return _load(self.path / _LEARNING)

    def policy(self) -> TensorDictSequential:
        """The policy, ready to act: raw observation in, action out."""
        policy = make_policy(self.signature, self.config)
        policy.load_state_dict(self.policy_state())
        return policy.eval().requires_grad_(False)


def _load(path: Path) -> dict[str, Any]:
    # weights_only: a checkpoint from elsewhere must not be able to run code.
    return torch.load(path, map_location="cpu", weights_only=True)


def checkpoints_in(run: Path) -> list[Path]:
    """Complete checkpoints of a run, oldest first."""
    directory = Path(run) / _DIRECTORY
    if not directory.is_dir():
        return []
    complete = (
        child
        for child in directory.iterdir()
        if child.name.isdigit() and (child / _DESCRIPTION).exists()
    )
    return sorted(complete, key=lambda child: int(child.name))


def save_checkpoint(
    run: Path,
    *,
    config: TrainingConfig,
    signature: Signature,
    frames: int,
    seconds: float,
    policy: Mapping[str, Any],
    learning: Mapping[str, Any],
) -> Path:
    """Write a checkpoint into a run's directory and drop the oldest ones.

    It is written under another name, flushed to disk and renamed, so a directory
    with a checkpoint's name is always complete.

    Returns:
        Its directory.
    """
    directory = Path(run) / _DIRECTORY
    directory.mkdir(parents=True, exist_ok=True)
    for leftover in directory.glob(f"{_UNFINISHED}*"):
        shutil.rmtree(leftover)
    name = f"{frames:010d}"
    target = directory / name
    if target.exists():
        # No frame was added since, as when a run is interrupted right after saving.
        return target
    temporary = directory / f"{_UNFINISHED}{name}"
    temporary.mkdir()
    for file, state in ((_POLICY, policy), (_LEARNING, learning)):
        with open(temporary / file, "wb") as stream:
            torch.save(dict(state), stream)
            _flush(stream)
    description = {
        "format": FORMAT,
        "frames": frames,
        "seconds": seconds,
        "config": config.to_dict(),
        "signature": signature.to_dict(),
        "versions": {
            name: version(name) for name in ("torch", "torchrl", "mujoco", "dm-control")
        },
    }
    with open(temporary / _DESCRIPTION, "w") as stream:
        json.dump(description, stream, indent=2)
        _flush(stream)
    os.rename(temporary, target)
    for old in checkpoints_in(run)[: -config.keep_checkpoints]:
        shutil.rmtree(old)
    return target


def _flush(stream: Any) -> None:
    stream.flush()
    os.fsync(stream.fileno())
