"""Policies that ship with the package: weights in safetensors, and a card."""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from cathsim_dmc import files
from cathsim_dmc.agents.checkpoint import CheckpointError, require_fit
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.learners import config_from_dict
from cathsim_dmc.agents.networks import NetworkShapes

FORMAT = 1
PREFIX = "pretrained:"
SUFFIX = ".safetensors"
DIRECTORY = Path(__file__).parents[1] / "pretrained"
_NAME = re.compile(r"[a-z0-9][a-z0-9_]*")
_MAX_CARD = 2**20  # bytes
_PARTS: Mapping[str, type] = {
    "name": str,
    "task": str,
    "task_kwargs": dict,
    "config": dict,
    "shapes": dict,
    "sha256": str,
    "training": dict,
    "evaluation": dict,
}


def pretrained_names(directory: str | Path = DIRECTORY) -> list[str]:
    """Names of the policies that ship, as in "pretrained:NAME"."""
    return sorted(path.stem for path in Path(directory).glob(f"*{SUFFIX}"))


def pretrained_path(name: str) -> Path:
    """Weights of the policy that ships under a name.

    Raises:
        CheckpointError: there is none of that name (lists those that exist).
    """
    name = name.removeprefix(PREFIX)
    names = pretrained_names()
    if name not in names:
        there = ", ".join(PREFIX + one for one in names) or "none yet"
        raise CheckpointError(f"no policy {PREFIX}{name}; there are {there}.")
    return DIRECTORY / f"{name}{SUFFIX}"


def read_pretrained(
    weights: str | Path,
) -> tuple[dict[str, Any], dict[str, torch.Tensor], NetworkShapes, TrainingConfig]:
    """Card, weights and statistics by name, sizes and settings of a policy.

    Args:
        weights: Path of the `.safetensors` file; the card lies beside it.

    Raises:
        CheckpointError: there is none, or it is damaged.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    weights = Path(weights)
    card = read_card(weights.with_suffix(".json"))
    try:
        data = weights.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{weights} cannot be read: {error}.") from error
    if hashlib.sha256(data).hexdigest() != card["sha256"]:
        raise CheckpointError(
            f"{weights} is damaged, or its card is that of another policy: the "
            "SHA-256 differs."
        )
    try:
        config = config_from_dict(card["config"])
        shapes = NetworkShapes.from_dict(card["shapes"])
        state = load(data)
    except (ConfigError, SafetensorError, ValueError) as error:
        line = " ".join(str(error).split())[:200]
        raise CheckpointError(
            f"{weights} does not fit the network of its card: {line}"
        ) from error
    require_fit(weights, state, shapes, config)
    return card, state, shapes, config


def read_card(path: str | Path) -> dict[str, Any]:
    """The card of a policy.

    Returns:
        "name", "task", "task_kwargs" (options of the task as it was evaluated),
        "config" and "shapes" (what the network is made from), "sha256" of the
        weights, "training" (frames, seconds, seed), "evaluation" (episodes, success
        with interval, forces) and "versions".

    Raises:
        CheckpointError: it is missing or damaged.
    """
    path = Path(path)
    try:
        card = files.read_json(path, _MAX_CARD, "a card")
    except ValueError as error:
        raise CheckpointError(f"{error}.") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise CheckpointError(f"{path} is no card of format {FORMAT}.")
    wrong = [name for name, kind in _PARTS.items() if type(card.get(name)) is not kind]
    if wrong:
        raise CheckpointError(f"{path}: {', '.join(wrong)} missing or of another type.")
    return card


def write_pretrained(
    directory: str | Path,
    name: str,
    state: Mapping[str, torch.Tensor],
    card: Mapping[str, Any],
) -> Path:
    """Write weights and card; the card last, which makes them a policy.

    Args:
        directory: Directory to write to.
        name: Name of the policy: lower-case letters, digits and underscores.
        state: Weights and statistics of the policy by name.
        card: Card without "format", "name" and "sha256".

    Returns:
        Path of the weights.

    Raises:
        ValueError: the name is not allowed, or the state holds more than tensors.
    """
    from safetensors.torch import save

    require_name(name)
    others = sorted(k for k, v in state.items() if not isinstance(v, torch.Tensor))
    if others:
        raise ValueError(f"the policy's state holds {', '.join(others)}: no tensors")
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    data = save({key: value.cpu().contiguous() for key, value in state.items()})
    weights = files.write_bytes(directory / f"{name}{SUFFIX}", data)
    values = {
        "format": FORMAT,
        "name": name,
        **card,
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    text = json.dumps(values, indent=1, allow_nan=False) + "\n"
    files.write_text(weights.with_suffix(".json"), text)
    return weights


def require_name(name: str) -> None:
    """Raise ValueError unless a policy may have this name."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"a policy cannot be called {name!r}; use lower-case letters, digits and "
            "underscores"
        )
