"""The command line that trains with given settings."""

import dataclasses
import json
import shlex
from collections.abc import Mapping
from typing import Any

from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.learners import LEARNERS, make_config

# Of no consequence for what is learnt; how long it takes has an option of its own.
_OMITTED = frozenset({"task", "task_kwargs", "total_frames", "seed", "observation"})


def training_command(config: TrainingConfig, out: str = "RUN") -> str:
    """The call of `cathsim train` that trains with some settings.

    Args:
        config: Settings of the training.
        out: Directory of the run in it.

    Returns:
        A line for a shell. It starts from the preset that is nearest.
    """
    presets = LEARNERS[config.algorithm].config.presets
    preset, changed = min(
        ((name, _changes(config, name)) for name in presets),
        key=lambda found: len(found[1]),
    )
    words = ["cathsim", "train", config.task, "--algo", config.algorithm]
    words += ["--preset", preset, "--out", out]
    words += _option("observation", config.observation)
    words += ["--frames", str(config.total_frames), "--seed", str(config.seed)]
    for name, value in changed.items():
        words += _option(name, value, name in config.task_kwargs)
    return shlex.join(words)


def _changes(config: TrainingConfig, preset: str) -> dict[str, Any]:
    """Settings that a preset does not have already, options of the task among them."""
    base = make_config(config.algorithm, preset)
    skipped = _OMITTED | config.resumable
    names = {item.name for item in dataclasses.fields(config)} - skipped
    changed = {
        name: getattr(config, name)
        for name in sorted(names)
        if getattr(config, name) != getattr(base, name)
    }
    options = {
        name: value
        for name, value in config.task_kwargs.items()
        if base.task_kwargs.get(name) != value
    }
    return changed | options


def _option(name: str, value: Any, of_task: bool = False) -> list[str]:
    flag = f"--{name.replace('_', '-')}"
    if isinstance(value, bool):
        return [flag if value else f"--no-{flag[2:]}"]
    if of_task and isinstance(value, Mapping | list | tuple):
        return [flag, json.dumps(value)]
    if isinstance(value, Mapping):
        return [flag, *(str(word) for pair in value.items() for word in pair)]
    if isinstance(value, list | tuple):
        return [flag, *map(str, value)]
    return [flag, str(value)]
