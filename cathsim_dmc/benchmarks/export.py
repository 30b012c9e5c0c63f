"""From a run to a policy that ships: weights, a card, a line in the list."""

import json
from pathlib import Path
from typing import Any

from cathsim_dmc import files
from cathsim_dmc.agents import pretrained
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.agents.evaluation import EvaluationResult
from cathsim_dmc.analysis.force_statistics import millinewtons
from cathsim_dmc.benchmarks import protocol, provenance
from cathsim_dmc.benchmarks.cell import SESSIONS
from cathsim_dmc.benchmarks.command import training_command
from cathsim_dmc.benchmarks.grid import EPISODES
from cathsim_dmc.benchmarks.result import ResultError, episode_figures, read_result

_FIGURES = ("success", "length", "max_force")


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
    judgement = protocol.judge(
        checkpoint,
        config.task,
        observation=config.observation,
        task_kwargs=options,
        episodes=episodes,
        name=f"{pretrained.PREFIX}{name}",
        num_threads=num_threads,
    )
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
            "sessions": _sessions(checkpoint.path),
        },
        "seeds": _seeds(checkpoint, Path(results)),
        "evaluation": _evaluation(judgement.result),
        "versions": provenance.versions(),
    }
    weights = pretrained.write_pretrained(directory, name, state, card)
    write_list(weights.parent)
    return weights


def write_list(directory: str | Path = pretrained.DIRECTORY) -> Path:
    """Write README.md of a directory of policies from their cards."""
    directory = Path(directory)
    lines = [
        "# Policies that ship",
        "",
        "Written by `cathsim export`; each has a card beside it, NAME.json. Evaluated "
        "over 30 episodes by the published rule (2,000 control steps, success within "
        "8 mm inside the branch); forces as in docs/forces.md.",
        "",
        "| policy | task | observation | frames | success (95 %) | mean force, mN "
        "| mean contact force, mN | max force, mN |",
        "|---|---|---|---|---|---|---|---|",
    ]
    commands = []
    for name in pretrained.pretrained_names(directory):
        card = pretrained.read_card(directory / f"{name}.json")
        summary = card["evaluation"]["summary"]
        low, high = summary["success_ci95"]
        observation = card["config"]["observation"]
        if not isinstance(observation, str):
            observation = ", ".join(observation)
        forces = summary["forces"]
        figures = (
            forces["sum"]["mean"],
            forces["max"]["mean_in_contact"],
            forces["max"]["maximum"],
        )
        texts = [millinewtons(one["mean"], one["sd"]) for one in figures]
        lines.append(
            f"| `{pretrained.PREFIX}{name}` | {card['task']} | {observation} "
            f"| {card['training']['frames']:,} "
            f"| {100 * summary['success']:.0f} % ({100 * low:.0f}–{100 * high:.0f}) "
            f"| {' | '.join(texts)} |"
        )
        seeds = ", ".join(
            f"seed {one['seed']}: {100 * one['success']:.0f} %"
            for one in card.get("seeds", [])
        )
        commands += ["", f"`{name}`: `{card['training']['command']}`"]
        commands += [f"({seeds})"] * bool(seeds)
    text = "\n".join([*lines, *commands]) + "\n"
    return files.write_text(directory / "README.md", text)


def _evaluation(result: EvaluationResult) -> dict[str, Any]:
    figures = episode_figures(result)
    return {
        "seed": result.seed,
        "summary": result.summary(),
        "episodes": {name: figures[name] for name in _FIGURES},
    }


def _sessions(checkpoint: Path) -> list[Any]:
    """Commits that a run was trained with, as far as the runner has noted them."""
    path = checkpoint.parents[1] / SESSIONS
    return json.loads(path.read_text()) if path.exists() else []


def _seeds(checkpoint: Checkpoint, results: Path) -> list[dict[str, Any]]:
    """Success of finished cells that differ from a run in the seed only."""
    from cathsim_dmc.agents.config import ConfigError
    from cathsim_dmc.agents.learners import config_from_dict

    found = []
    for path in sorted(results.glob("*.json")):
        try:
            other = read_result(path)
            config = config_from_dict(other.values["config"])
        except (ResultError, ConfigError):
            continue
        same = config.replace(seed=checkpoint.config.seed)
        lengths = {config.total_frames, checkpoint.config.total_frames}
        if not checkpoint.config.changed_for_resume(same) and len(lengths) == 1:
            summary = other.evaluation["summary"]
            success, interval = summary["success"], summary["success_ci95"]
            found.append(
                {"seed": config.seed, "success": success, "success_ci95": interval}
            )
    return sorted(found, key=lambda one: one["seed"])
