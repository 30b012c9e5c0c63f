"""Policies that ship with the package: weights in safetensors, and a card."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load
from tensordict.nn import TensorDictSequential

from cathsim_dmc.agents.checkpoint import (
    CheckpointError,
    line_of,
    policy_of,
    read_bytes,
)
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.learners import config_from_dict
from cathsim_dmc.agents.networks import NetworkShapes

FORMAT = 1
PREFIX = "pretrained:"
SUFFIX = ".safetensors"
DIRECTORY = Path(__file__).parents[1] / "pretrained"
_PARTS: Mapping[str, type] = {
    **dict.fromkeys(("name", "task", "sha256"), str),
    **dict.fromkeys(
        ("task_kwargs", "config", "shapes", "training", "evaluation"), dict
    ),
}


def pretrained_names(directory: str | Path = DIRECTORY) -> list[str]:
    """Names of the policies that ship, as in "pretrained:NAME"."""
    return sorted(path.stem for path in Path(directory).glob(f"*{SUFFIX}"))


def pretrained_path(name: str) -> Path:
    """Weights of the policy that ships under a name; CheckpointError lists names."""
    name, names = name.removeprefix(PREFIX), pretrained_names()
    if name not in names:
        there = ", ".join(PREFIX + one for one in names)
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
    weights = Path(weights)
    card = read_card(weights.with_suffix(".json"))
    data = read_bytes(weights, card["sha256"])
    try:
        config = config_from_dict(card["config"])
        shapes = NetworkShapes.from_dict(card["shapes"])
        return card, policy_of(weights, load(data), shapes, config), shapes, config
    except (SafetensorError, ValueError) as error:
        raise CheckpointError(f"{weights} cannot be used: {line_of(error)}") from error


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
