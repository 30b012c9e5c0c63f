"""Checkpoints: weights and numbers only, complete or not there at all."""

import hashlib
import io
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
from torch.utils._pytree import tree_leaves

from cathsim_dmc import files
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.fields import require, require_type
from cathsim_dmc.agents.learners import config_from_dict, make_policy
from cathsim_dmc.agents.networks import NetworkShapes

FORMAT = 2
_DIRECTORY = "checkpoints"
_DESCRIPTION = "checkpoint.json"
_POLICY = "policy.pt"
_LEARNING = "learning.pt"
_UNFINISHED = ".unfinished-"
_MAX_DESCRIPTION = 2**20  # bytes
_FIELDS = {
    "config": Mapping[str, Any],
    "shapes": Mapping[str, Any],
    "sha256": Mapping[str, str],
    "frames": int,
    "seconds": float,
}


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
        """Open a checkpoint, or the newest one of a run.

        Args:
            path: Directory of a checkpoint or of a run.

        Raises:
            CheckpointError: there is none, or its description cannot be used; the
                message names the field, what was given and what is allowed.
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
        description = path / _DESCRIPTION
        values = _read_description(description)
        try:
            for name, kind in _FIELDS.items():
                require_type(name, values.get(name), kind)
            for name in ("frames", "seconds"):
                require(values[name] >= 0, name, values[name], ">= 0")
            sums = values["sha256"]
            require({_POLICY, _LEARNING} <= set(sums), "sha256", sums, "of both files")
            return cls(
                path=path,
                config=config_from_dict(values["config"]),
                shapes=NetworkShapes.from_dict(values["shapes"]),
                frames=values["frames"],
                seconds=float(values["seconds"]),
                sha256=sums,
            )
        except ValueError as error:
            raise CheckpointError(f"{description}: {error}") from error

    def policy_state(self) -> dict[str, Any]:
        """Weights and statistics of the policy, on the CPU.

        Raises:
            CheckpointError: the file is missing, is not what was written, or holds
                weights of another network.
        """
        state = self._load(_POLICY)
        require_fit(self.path / _POLICY, state, self.shapes, self.config)
        return state

    def learning_state(self) -> dict[str, Any]:
        """Everything else that continuing the run needs.

        Raises:
            CheckpointError: the file is missing, is not what was written, or has NaN.
        """
        state = self._load(_LEARNING)
        tensors = (v for v in tree_leaves(state) if isinstance(v, torch.Tensor))
        if any(bool(one.isnan().any()) for one in tensors):
            raise CheckpointError(
                f"{self.path / _LEARNING} has NaN, so learning cannot go on: delete "
                f"{self.path} to resume from the checkpoint before it, or start a new "
                "run with this policy (initial_policy)."
            )
        return state

    def policy(self) -> TensorDictSequential:
        """The policy, ready to act: raw observation in, action out.

        Raises:
            CheckpointError: the weights are damaged or of another network.
        """
        state = self.policy_state()
        policy = make_policy(self.shapes, self.config)
        policy.load_state_dict(state)
        return policy.eval().requires_grad_(False)

    def _load(self, name: str) -> dict[str, Any]:
        path = self.path / name
        try:
            data = path.read_bytes()
        except OSError as error:
            raise CheckpointError(f"{path} cannot be read: {error}.") from error
        given = hashlib.sha256(data).hexdigest()
        if given != self.sha256[name]:
            raise CheckpointError(
                f"{path} is damaged: its SHA-256 is {given[:12]}…, {_DESCRIPTION} says "
                f"{self.sha256[name][:12]}…. Use an older checkpoint of the run."
            )
        try:
            # weights_only: a checkpoint from elsewhere must not be able to run code.
            state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        except Exception as error:  # torch's reader of weights fails in many ways
            raise CheckpointError(f"{path} holds no weights: {_line(error)}") from error
        if not isinstance(state, dict):
            raise CheckpointError(
                f"{path} holds a {type(state).__name__}; it must be a dictionary of "
                "weights and numbers."
            )
        return state


def require_fit(
    path: Path,
    state: Mapping[str, Any],
    shapes: NetworkShapes,
    config: TrainingConfig,
) -> None:
    """Check weights before a network of the size described is built.

    Args:
        path: Path of the file, for the message.
        state: Weights and statistics of a policy by name.
        shapes: Sizes of its observation and action.
        config: Settings of its network.

    Raises:
        CheckpointError: they are of another network, or not finite.
    """
    try:
        # Takes no memory for the weights.
        with torch.device("meta"):
            make_policy(shapes, config).load_state_dict(dict(state), assign=True)
        broken = [name for name, one in state.items() if not one.isfinite().all()]
    except Exception as error:  # torch fails in many ways
        raise CheckpointError(
            f"{path} does not fit the network described beside it: {_line(error)}"
        ) from error
    if broken:
        raise CheckpointError(
            f"{path} holds weights that are not finite ({', '.join(broken[:3])}): "
            "use an older checkpoint, or train anew."
        )


def _read_description(path: Path) -> dict[str, Any]:
    """A checkpoint.json of this format."""
    try:
        values = files.read_json(path, _MAX_DESCRIPTION, "a checkpoint's description")
    except ValueError as error:
        raise CheckpointError(f"{error}.") from error
    if not isinstance(values, dict):
        raise CheckpointError(f"{path} is no JSON object.")
    if type(values.get("format")) is not int or values["format"] != FORMAT:
        raise CheckpointError(
            f"{path}: format is {values.get('format')!r}; this version reads {FORMAT}."
        )
    return values


def _line(error: Exception) -> str:
    """The first line that says something."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:2])[:200] or type(error).__name__


def checkpoints_in(run: Path) -> list[Path]:
    """Complete checkpoints of a run, oldest first."""
    directory = Path(run) / _DIRECTORY
    if not directory.is_dir():
        return []
    complete = (
        child
        for child in directory.iterdir()
        if child.name.isdecimal() and (child / _DESCRIPTION).exists()
    )
    return sorted(complete, key=lambda child: int(child.name))


def save_checkpoint(
    run: Path,
    *,
    config: TrainingConfig,
    shapes: NetworkShapes,
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

    Raises:
        OSError: it cannot be written, as on a full disk; the others stay.
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
    checksums = {}
    for file, state in ((_POLICY, policy), (_LEARNING, learning)):
        # By way of memory: torch's own writer hides the cause on a full disk.
        stream = io.BytesIO()
        torch.save(dict(state), stream)
        data = stream.getvalue()
        checksums[file] = hashlib.sha256(data).hexdigest()
        files.write_bytes(temporary / file, data)
    description = {
        "format": FORMAT,
        "frames": frames,
        "seconds": seconds,
        "config": config.to_dict(),
        "shapes": shapes.to_dict(),
        "sha256": checksums,
        "versions": {
            name: version(name) for name in ("torch", "torchrl", "mujoco", "dm-control")
        },
    }
    files.write_text(temporary / _DESCRIPTION, json.dumps(description, indent=2) + "\n")
    os.rename(temporary, target)
    for old in checkpoints_in(run)[: -config.keep_checkpoints]:
        # Killed while it removes, it must not leave half a checkpoint with a name.
        dropped = old.with_name(f"{_UNFINISHED}{old.name}")
        os.rename(old, dropped)
        shutil.rmtree(dropped)
    return target
