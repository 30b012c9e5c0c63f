"""Policies that ship with the package: weights in safetensors, and a card."""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictSequential

from cathsim_dmc import files
from cathsim_dmc.agents.checkpoint import CheckpointError, line_of, policy_of
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.learners import config_from_dict
from cathsim_dmc.agents.networks import NetworkShapes

FORMAT = 1
PREFIX = "pretrained:"
SUFFIX = ".safetensors"
DIRECTORY = Path(__file__).parents[1] / "pretrained"
_NAME = re.compile(r"[a-z0-9][a-z0-9_]*")
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
) -> tuple[dict[str, Any], TensorDictSequential, NetworkShapes, TrainingConfig]:
    """Card, network, sizes and settings of a policy.

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
        if hashlib.sha256(data).hexdigest() != card["sha256"]:
            raise ValueError("the SHA-256 differs from that in its card")
        config = config_from_dict(card["config"])
        shapes = NetworkShapes.from_dict(card["shapes"])
        return card, policy_of(weights, load(data), shapes, config), shapes, config
    except (OSError, SafetensorError, ValueError) as error:
        raise CheckpointError(
            f"{weights} cannot be used; it or its card is missing or damaged: "
            f"{line_of(error)}"
        ) from error


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
    try:
        card = json.loads(Path(path).read_text())
        wrong = [n for n, kind in _PARTS.items() if type(card.get(n)) is not kind]
    except (OSError, AttributeError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}.") from error
    if wrong or card.get("format") != FORMAT:
        raise CheckpointError(f"{path}: no card of format {FORMAT}; wrong is {wrong}.")
    return card


def write_pretrained(
    directory: str | Path,
    name: str,
    state: Mapping[str, torch.Tensor],
    card: Mapping[str, Any],
) -> Path:
    """Write weights and card; the card last, which makes them a policy.

    Args:
        name: Name of the policy: lower-case letters, digits and underscores.
        card: Card without "format", "name" and "sha256".

    Returns:
        Path of the weights.

    Raises:
        ValueError: the name is not allowed.
    """
    from safetensors.torch import save

    require_name(name)
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
