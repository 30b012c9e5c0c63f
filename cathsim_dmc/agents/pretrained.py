"""Policies that ship with the package: weights in safetensors, and a card."""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from tensordict.nn import TensorDictSequential

from cathsim_dmc import files
from cathsim_dmc.agents import hub
from cathsim_dmc.agents.checkpoint import CheckpointError, policy_of, read_bytes
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.learners import config_from_dict
from cathsim_dmc.agents.networks import NetworkShapes

FORMAT = 1
PREFIX = "pretrained:"
SUFFIX = ".safetensors"
DIRECTORY = Path(__file__).parents[1] / "pretrained"
_PARTS: Mapping[str, type] = {
    "name": str, "task": str, "sha256": str, "task_kwargs": dict, "config": dict,
    "shapes": dict, "training": dict, "evaluation": dict,
}  # fmt: skip


def pretrained_names(directory: str | Path = DIRECTORY) -> list[str]:
    """Return the names of the policies that ship, as in "pretrained:NAME"."""
    return sorted(path.stem for path in Path(directory).glob(f"*{SUFFIX}"))


def pretrained_path(policy: str | Path) -> Path | None:
    """Return the path of "pretrained:NAME", "hf:…" or a `.safetensors` file, or None.

    Raises:
        CheckpointError: none ships under that name; lists those that do.
        ValueError: the hub has none under that name, see `hub.policy`.
    """
    if hub.is_reference(policy):
        return hub.policy(str(policy))
    if not str(policy).startswith(PREFIX):
        return Path(policy) if Path(policy).suffix == SUFFIX else None
    name, names = str(policy).removeprefix(PREFIX), pretrained_names()
    if name not in names:
        there = ", ".join(PREFIX + one for one in names)
        raise CheckpointError(f"no policy {PREFIX}{name}; there are {there}.")
    return DIRECTORY / f"{name}{SUFFIX}"


def read_pretrained(
    weights: str | Path,
) -> tuple[dict[str, Any], TensorDictSequential, NetworkShapes, TrainingConfig]:
    """Read a policy; return its card, network, sizes and settings.

    Args:
        weights: Path of the `.safetensors` file; the card lies beside it.

    Raises:
        CheckpointError: the policy is missing or damaged.
    """
    weights = Path(weights)
    described = weights.with_suffix(".json")
    if not described.is_file():
        raise CheckpointError(
            f"{weights} has no card: put {described.name}, which was written with it, "
            "into the same folder"
        )
    card = read_card(described)
    data = read_bytes(weights, card["sha256"])
    text = f"{weights} cannot be used"
    with files.refused(CheckpointError, text, (SafetensorError, ValueError)):
        config = config_from_dict(card["config"])
        shapes = NetworkShapes.from_dict(card["shapes"])
        return card, policy_of(weights, load(data), shapes, config), shapes, config


def read_card(path: str | Path) -> dict[str, Any]:
    """Read the card of a policy.

    Returns:
        "name", "task", "task_kwargs" (options of the task as it was evaluated),
        "config" and "shapes" (what the network is made from), "sha256" of the
        weights, "training" (frames, seconds, seed), "evaluation" (episodes, success
        with interval, forces) and "versions".

    Raises:
        CheckpointError: it is missing or damaged.
    """
    errors = OSError, AttributeError, ValueError
    with files.refused(CheckpointError, f"{path} cannot be read", errors):
        card = json.loads(Path(path).read_text())
        wrong = [n for n, kind in _PARTS.items() if type(card.get(n)) is not kind]
    if wrong or card.get("format") != FORMAT:
        raise CheckpointError(f"{path}: no card of format {FORMAT}; wrong is {wrong}.")
    return card


def write(
    directory: Path, name: str, state: Mapping[str, Any], card: Mapping[str, Any]
) -> Path:
    """Write weights and card of a policy; the card last, which completes it.

    Args:
        state: Tensors by name.
        card: What `read_card` returns, without "format", "name" and "sha256".

    Returns:
        Path of the weights.
    """
    files.require_folder(directory, make=True)
    data = save({key: value.cpu().contiguous() for key, value in state.items()})
    weights = files.write_bytes(directory / f"{name}{SUFFIX}", data)
    digest = hashlib.sha256(data).hexdigest()
    values = {"format": FORMAT, "name": name, **card, "sha256": digest}
    text = json.dumps(values, indent=1, allow_nan=False) + "\n"
    # Lists of numbers on one line.
    text = re.sub(
        r"\[[^\[\]{}\"]*\]", lambda found: re.sub(r"\s+", " ", found[0]), text
    )
    files.write_text(weights.with_suffix(".json"), text)
    return weights
