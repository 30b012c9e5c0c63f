"""Policies that ship with the package: weights in safetensors, and a card."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictSequential

from cathsim_dmc.agents.checkpoint import CheckpointError, line_of, policy_of
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.learners import config_from_dict
from cathsim_dmc.agents.networks import NetworkShapes

FORMAT = 1
PREFIX = "pretrained:"
SUFFIX = ".safetensors"
DIRECTORY = Path(__file__).parents[1] / "pretrained"
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
    """Weights of the policy that ships under a name; CheckpointError lists names."""
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
