"""From a run to a policy that ships: weights, a card, a line in the list."""

from pathlib import Path

from cathsim_dmc import files
from cathsim_dmc.agents import pretrained
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.analysis.force_statistics import millinewtons
from cathsim_dmc.benchmarks import protocol
from cathsim_dmc.benchmarks.grid import EPISODES
from cathsim_dmc.benchmarks.result import episode_figures, versions

_FIGURES = ("success", "length", "max_force")
_HEAD = """\
# Policies that ship

Written by `cathsim export`; the card beside each, NAME.json, has its settings. \
Evaluated over 30 episodes by the published rule (2,000 control steps, success within \
8 mm inside the branch); forces as in docs/forces.md.

| policy | task | observation | frames | success (95 %) | mean force, mN \
| mean contact force, mN | max force, mN |
|---|---|---|---|---|---|---|---|
"""


def export(
    run: str | Path,
    name: str,
    *,
    directory: str | Path = pretrained.DIRECTORY,
    episodes: int = EPISODES,
    num_threads: int | None = None,
) -> Path:
    """Write the policy of a run with its card, after judging it.

    Args:
        run: Directory of a run or of a checkpoint.
        name: Name of the policy.
        directory: Directory to write to; the default is that of the package.
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
            "frames": checkpoint.frames,
            "seconds": round(checkpoint.seconds, 1),
            "seed": config.seed,
        },
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
    directory, lines = Path(directory), _HEAD
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
    return files.write_text(directory / "README.md", lines)
