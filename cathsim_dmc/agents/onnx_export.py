"""A trained policy as ONNX, with a card and a self-test, for programs without torch."""

import contextlib
import io
import json
import logging
import math
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from cathsim_dmc import bounds, extras, files, suite
from cathsim_dmc.agents import onnx_selftest
from cathsim_dmc.agents.networks import NetworkShapes, network_of
from cathsim_dmc.agents.normalisation import (
    SHADOW,
    ImageNormaliser,
    ObservationNormaliser,
)
from cathsim_dmc.agents.onnx_selftest import CARD, MODEL, SAMPLES
from cathsim_dmc.agents.policies import (
    PolicyLike,
    TrainedPolicy,
    load_policy,
    task_and_options,
)
from cathsim_dmc.policies import in_environment
from cathsim_dmc.simulation.environments import PIXELS
from cathsim_dmc.simulation.episodes import play_alone
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP, EVALUATION_SEED
from cathsim_dmc.tasks.interface import action_table, observation_table

FORMAT = 1
TOLERANCE = 1e-5  # of an action in [-1, 1]: rounding of single precision
_STEPS = 64  # of an episode in the self-test, at most
_OPSET = 18
_PACKAGES = ("cathsim-dmc", "torch", "torchrl", "mujoco", "onnx", "onnxruntime")


class Deterministic(nn.Module):
    """A policy's deterministic actions, as in evaluations, from raw observations."""

    def __init__(self, policy: nn.Module):
        """Takes normalisers and actor from a policy of `networks.make_policy`."""
        super().__init__()
        self.normalisers = nn.ModuleList(_normalisers(policy))
        actor = network_of(policy)
        self.body, self.mean = actor.body, actor.mean

    def forward(self, *observation: torch.Tensor) -> torch.Tensor:
        """Actions (N, A) from the parts of the observation, vector before pixels."""
        parts = zip(self.normalisers, observation, strict=True)
        return torch.tanh(self.mean(self.body(*(one(part) for one, part in parts))))


def _normalisers(policy: nn.Module) -> list[nn.Module]:
    kinds = ObservationNormaliser, ImageNormaliser
    return [one for one in policy.modules() if isinstance(one, kinds)]


def write_onnx(
    policy: PolicyLike,
    directory: str | os.PathLike[str],
    *,
    task: str | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
    seed: int = EVALUATION_SEED,
) -> Path:
    """Write a trained policy as ONNX and compare it with the policy over an episode.

    `policy.onnx` takes raw observations, normalises them and returns the actions
    (N, A) float32 in [-1, 1]. `card.json` describes it, see `card_of`, and is also in
    the metadata of the model. `selftest.npz` holds observations and actions of an
    episode, and `selftest.py` compares with them where the package is not installed.

    Args:
        directory: Directory to write, which must not exist.
        task: Task of the episode; by default that of the policy.
        task_kwargs: Options of the task, over those of the policy.
        seed: Seed of the episode.

    Returns:
        The directory.

    Raises:
        ValueError: the policy has no network, or ONNX Runtime answers with other
            actions.
        FileExistsError: the directory exists.
        ModuleNotFoundError: the extra `onnx` is not installed.
    """
    directory = files.as_path("directory", directory)
    extras.require("onnx", "onnx", "onnxscript", "onnxruntime")
    if directory.exists():
        raise FileExistsError(f"{directory} exists; give a directory that does not")
    files.require_place(directory.parent)
    bounds.seed("seed", seed)
    player = load_policy(policy, scripted=False)
    if not isinstance(player, TrainedPolicy):
        raise ValueError(
            f"the policy {player.name!r} has no network; give a run, a checkpoint or "
            "pretrained:NAME"
        )
    name, options = task_and_options(player, task, task_kwargs)
    options["observation"] = player.observation
    if suite.TASKS[suite.known(name)].random_arch and "numbers" not in options:
        options.setdefault("pool", 1)  # compiling an arch takes a second
    env = suite.load(suite.DOMAIN, name, {**options, "random": seed})
    samples = _played(player, env)
    card = card_of(player, env.task)
    card["task"] = {"name": name, "options": json.loads(json.dumps(options))}
    card["self_test"] = {
        "file": SAMPLES, "task": name, "seed": seed, "steps": len(samples["action"]),
        "tolerance": TOLERANCE,
    }  # fmt: skip
    directory.parent.mkdir(parents=True, exist_ok=True)
    with files.atomic_directory(directory) as folder:
        _write_model(player, folder / MODEL, samples)
        np.savez_compressed(folder / SAMPLES, allow_pickle=False, **samples)
        shutil.copyfile(onnx_selftest.__file__, folder / "selftest.py")
        largest = float(onnx_selftest.differences(folder).max())
        if not largest <= TOLERANCE:
            raise ValueError(
                f"ONNX Runtime and torch differ by {largest:.1e} in an action of "
                f"{player.name}; at most {TOLERANCE:g} is allowed"
            )
        card["self_test"]["largest_difference"] = largest
        files.write_json(folder / CARD, card)
        _put_card(folder / MODEL, card)
    return directory


def card_of(player: TrainedPolicy, task: Any) -> dict[str, Any]:
    """Return the description that a program needs to use a policy; JSON-able, SI units.

    Args:
        task: The task that the policy plays.

    Returns:
        "inputs": each with "name", "dtype", "shape" (N is the number of observations),
        "entries" (key, place, unit and meaning, in their order) and "normaliser",
        which is part of the model; "output", with the meaning of each action;
        "control_timestep" in s; "training"; "evaluation", with its "task", "options"
        and "protocol", or None; "versions".
    """
    shapes, table = player.shapes, observation_table(task)
    inputs = zip(shapes.raw_keys, _normalisers(player.network), strict=True)
    card, kept = player.card or {}, player.checkpoint
    if kept is not None:
        card = {"sha256": dict(kept.sha256), "training": {"frames": kept.frames}}
        card["versions"] = dict(kept.versions)
    training = {"seed": player.config.seed, **card["training"]}
    return {
        "format": FORMAT,
        "policy": player.name,
        "algorithm": player.config.algorithm,
        "observation": player.observation,
        "inputs": [_input(name, shapes, one, table) for name, one in inputs],
        "output": {
            "name": "action", "dtype": "float32", "shape": ["N", shapes.actions],
            "deterministic": "tanh of the mean of the policy's distribution",
            "entries": action_table(task.scene.catheter),
        },
        "control_timestep": CONTROL_TIMESTEP,
        "sha256": card["sha256"],
        "training": {**training, "task": player.config.task},
        "evaluation": _evaluation(card),
        "versions": {
            "trained": card.get("versions"),
            "exported": {one: metadata.version(one) for one in _PACKAGES},
        },
    }  # fmt: skip


def _evaluation(card: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the figures of a card with the task that they are of; None without."""
    found = card.get("evaluation", {})
    if "summary" not in found:
        return None
    # A card of a policy that ships has its task alone, which it was evaluated on.
    settings = found.get("settings", {})
    about = {
        "task": found.get("task", card["task"]),
        "options": settings.get("task_kwargs", card["task_kwargs"]),
        "protocol": settings.get("protocol", "published"),
    }
    return {**about, **found["summary"]}


def _input(
    name: str, shapes: NetworkShapes, own: Any, table: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return the layout of an input of the model, and of its normaliser `own`."""
    images, place, entries = name == PIXELS, 0, []
    for row in table:
        if (row["dtype"] == "uint8") is images:
            size = row["shape"][-1] if images else math.prod(row["shape"])
            kept = {key: row[key] for key in ("key", "shape", "unit", "meaning")}
            entries.append({**kept, "start": place, "stop": place + size})
            place += size
    if images:
        formula = f"(x - mean image) / {SHADOW:g}" if own.subtract else "x / 255"
        layout = {"dtype": "uint8", "shape": ["N", *(shapes.pixels or ())]}
        layout["axes"] = "N, channels, rows, columns"
        normaliser = {"formula": formula}
    else:
        layout = {"dtype": "float32", "shape": ["N", shapes.vector]}
        normaliser = {"formula": "clip((x - shift) * scale, -clip, clip)"}
        normaliser |= {"clip": own.clip, "shift": own.shift.tolist()}
        normaliser["scale"] = own.scale.tolist()
    normaliser["where"] = "in the model: give raw observations"
    return {"name": name, **layout, "entries": entries, "normaliser": normaliser}


def _played(player: TrainedPolicy, env: Any) -> dict[str, np.ndarray]:
    """Return inputs of the network and its actions at up to 64 steps of an episode."""
    seen: list[dict[str, np.ndarray]] = []
    keys = (*player.shapes.raw_keys, "action")
    handle = player.network.register_forward_hook(
        lambda _, __, out: seen.append({k: out[k].numpy().copy() for k in keys})
    )
    try:
        for _ in play_alone(env, in_environment(player, env)):
            pass
    finally:
        handle.remove()
    places = np.unique(np.linspace(0, len(seen) - 1, _STEPS).astype(int))
    return {key: np.concatenate([seen[i][key] for i in places]) for key in keys}


def _write_model(player: TrainedPolicy, path: Path, samples: Any) -> None:
    names = player.shapes.raw_keys
    batch = torch.export.Dim("N")
    with _quiet():
        torch.onnx.export(
            Deterministic(player.network).eval(),
            tuple(torch.as_tensor(samples[name][:2]) for name in names),
            str(path),
            input_names=names,
            output_names=["action"],
            opset_version=_OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
            dynamic_shapes=(tuple({0: batch} for _ in names),),
        )


def _put_card(path: Path, card: Mapping[str, Any]) -> None:
    """Add a card to the metadata of a model."""
    import onnx

    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {"card": json.dumps(card)})
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the exporter's messages about packages that are not needed here."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
