"""From a run to a policy that ships: weights, a card, a line in the list."""

import dataclasses
import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cathsim_dmc import files
from cathsim_dmc.agents import pretrained
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.learners import LEARNERS, config_from_dict, make_config
from cathsim_dmc.analysis.force_statistics import millinewtons
from cathsim_dmc.benchmarks import protocol
from cathsim_dmc.benchmarks.grid import EPISODES
from cathsim_dmc.benchmarks.result import (
    ResultError,
    episode_figures,
    read_result,
    versions,
)

_FIGURES = ("success", "length", "max_force")
_HEAD = """\
# Policies that ship

Written by `cathsim export`; each has a card beside it, NAME.json. Evaluated over 30 \
episodes by the published rule (2,000 control steps, success within 8 mm inside the \
branch); forces as in docs/forces.md.

| policy | task | observation | frames | success (95 %) | mean force, mN \
| mean contact force, mN | max force, mN |
|---|---|---|---|---|---|---|---|
"""


def export(
    run: str | Path,
    name: str,
    *,
    directory: str | Path = pretrained.DIRECTORY,
    results: str | Path = "results",
    episodes: int = EPISODES,
    num_threads: int | None = None,
) -> Path:
    """Write the policy of a run with its card, after judging it.

    Args:
        run: Directory of a run or of a checkpoint.
        name: Name of the policy.
        directory: Directory to write to; the default is that of the package.
        results: Directory with the JSON files of finished cells, in which the other
            seeds of this training are looked for.
        episodes: Number of episodes of the published evaluation.
        num_threads: Number of threads of the simulation; None takes one per core.

    Returns:
        Path of the weights.

    Raises:
        ValueError: the name is not allowed.
        CheckpointError: there is no checkpoint, or it is damaged.
    """
    pretrained.require_name(name)
    checkpoint = Checkpoint.open(run)
    config, state = checkpoint.config, checkpoint.policy_state()
    options = protocol.published_options(config.task_kwargs)
    evaluation = protocol.judge(
        checkpoint,
        config.task,
        options,
        episodes,
        f"{pretrained.PREFIX}{name}",
        num_threads,
    ).result
    figures = episode_figures(evaluation)
    card = {
        "task": config.task,
        "task_kwargs": options,
        "config": config.to_dict(),
        "shapes": checkpoint.shapes.to_dict(),
        "training": {
            "command": training_command(config),
            "frames": checkpoint.frames,
            "seconds": round(checkpoint.seconds, 1),
            "seed": config.seed,
        },
        "seeds": _seeds(config, Path(results)),
        "evaluation": {
            "seed": evaluation.seed,
            "summary": evaluation.summary(),
            "episodes": {name: figures[name] for name in _FIGURES},
        },
        "versions": versions(),
    }
    weights = pretrained.write_pretrained(directory, name, state, card)
    write_list(weights.parent)
    return weights


def write_list(directory: str | Path = pretrained.DIRECTORY) -> Path:
    """Write README.md of a directory of policies from their cards."""
    directory, commands, lines = Path(directory), "", _HEAD
    for name in pretrained.pretrained_names(directory):
        card = pretrained.read_card(directory / f"{name}.json")
        summary, training = card["evaluation"]["summary"], card["training"]
        low, high = summary["success_ci95"]
        observation = card["config"]["observation"]
        if not isinstance(observation, str):
            observation = ", ".join(observation)
        forces = summary["forces"]
        cells = [
            f"`{pretrained.PREFIX}{name}`",
            card["task"],
            observation,
            f"{training['frames']:,}",
            f"{100 * summary['success']:.0f} % ({100 * low:.0f}–{100 * high:.0f})",
            *(
                millinewtons(one["mean"], one["sd"])
                for one in (
                    forces["sum"]["mean"],
                    forces["max"]["mean_in_contact"],
                    forces["max"]["maximum"],
                )
            ),
        ]
        lines += f"| {' | '.join(cells)} |\n"
        commands += f"\n`{name}`: `{training['command']}`\n"
        seeds = (f"seed {s['seed']}: {100 * s['success']:.0f} %" for s in card["seeds"])
        commands += f"({', '.join(seeds)})\n" if card["seeds"] else ""
    return files.write_text(directory / "README.md", lines + commands)


def _seeds(config: TrainingConfig, results: Path) -> list[dict[str, Any]]:
    """Success of finished cells that differ from a training in the seed only."""
    found = []
    for path in sorted(results.glob("*.json")):
        try:
            other = read_result(path)
            theirs = config_from_dict(other.values["config"])
        except (ResultError, ConfigError):
            continue
        same = theirs.replace(seed=config.seed)
        if same.total_frames == config.total_frames and not (
            config.changed_for_resume(same)
        ):
            interval = other.evaluation["summary"]["success_ci95"]
            found.append((theirs.seed, other.success, interval))
    names = ("seed", "success", "success_ci95")
    return [dict(zip(names, one, strict=True)) for one in sorted(found)]


def training_command(config: TrainingConfig, out: str = "RUN") -> str:
    """The call of `cathsim train` that trains with some settings, as a line of shell.

    Args:
        config: Settings of the training.
        out: Directory of the run in it.
    """
    presets = LEARNERS[config.algorithm].config.presets
    changes = {preset: _changes(config, preset) for preset in presets}
    preset = min(changes, key=lambda name: len(changes[name]))
    words = ["cathsim", "train", config.task, "--algo", config.algorithm]
    words += ["--preset", preset, "--out", out]
    words += _option("observation", config.observation)
    words += ["--frames", str(config.total_frames), "--seed", str(config.seed)]
    for name, value in changes[preset].items():
        words += _option(name, value, name in config.task_kwargs)
    return shlex.join(words)


def _changes(config: TrainingConfig, preset: str) -> dict[str, Any]:
    """Settings that a preset does not have already, options of the task among them."""
    base = make_config(config.algorithm, preset)
    skipped = {"task", "task_kwargs", "total_frames", "seed", "observation"}
    names = {item.name for item in dataclasses.fields(config)} - skipped
    given = {name: getattr(config, name) for name in sorted(names - config.resumable)}
    changed = {k: v for k, v in given.items() if v != getattr(base, k)}
    options = config.task_kwargs.items()
    return changed | {k: v for k, v in options if base.task_kwargs.get(k) != v}


def _option(name: str, value: Any, of_task: bool = False) -> list[str]:
    flag = f"--{name.replace('_', '-')}"
    if of_task and isinstance(value, Mapping | list | tuple):
        return [flag, json.dumps(value)]
    if isinstance(value, bool):
        return (
            [flag, str(value)] if of_task else [flag if value else f"--no-{flag[2:]}"]
        )
    if isinstance(value, Mapping):
        return [flag, *(str(word) for pair in value.items() for word in pair)]
    return [flag, *map(str, value if isinstance(value, list | tuple) else [value])]
