"""Exports the policy of a run for the package: evaluation, weights and a card.

python benchmarks/export.py RUN NAME [--out DIRECTORY]
"""

import re
import sys
from pathlib import Path
from typing import Annotated, Any

import judgement
import torch
import tyro

from cathsim_dmc import files, suite
from cathsim_dmc.agents import pretrained
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.analysis.force_statistics import millinewtons

_FIGURES = ("success", "length", "max_force")
_HEAD = """\
# Shipped policies

Written by `python benchmarks/export.py`; the card beside each, NAME.json, has its \
settings. Evaluated over 30 episodes by the published rule (2,000 control steps, \
success within 8 mm inside the branch); forces as in docs/forces.md.

| policy | task | observation | frames | success | mean force, mN \
| mean contact force, mN | max force, mN |
|---|---|---|---|---|---|---|---|
"""


def export(
    run: Annotated[str | Path, tyro.conf.Positional],
    name: Annotated[str, tyro.conf.Positional],
    out: Path = pretrained.DIRECTORY,
    episodes: int = judgement.EPISODES,
    half: bool = False,
) -> Path:
    """Write the policy of a run with its card, after judging it.

    Args:
        run: Directory of a run or of a checkpoint, or a policy that ships, which is
            judged anew ("pretrained:type1_bca").
        name: Name of the policy, "type1_bca" for `pretrained:type1_bca`.
        out: Directory to write to; by default that of the package.
        episodes: Number of episodes of the evaluation.
        half: Whether matrices of weights are kept, and judged, in half precision.

    Returns:
        Path of the weights.
    """
    if not re.fullmatch(r"[a-z0-9][a-z0-9_]*", name):
        raise ValueError(
            f"a policy cannot be called {name!r}; use lower-case letters, digits and "
            "underscores"
        )
    files.require_folder(out, make=True)
    path = pretrained.pretrained_path(run)
    if path is not None:
        policy: Any = str(run)
        old, network, shapes, config = pretrained.read_pretrained(path)
        state, training = network.state_dict(), old["training"]
    else:
        policy = Checkpoint.open(run)
        state, shapes, config = policy.policy_state(), policy.shapes, policy.config
        training = {
            "frames": policy.frames,
            "seconds": round(policy.seconds, 1),
            "seed": config.seed,
        }
    options = judgement.published_options(config.task_kwargs)
    definition = suite.TASKS[config.task]
    if definition.random_arch:
        trained = {**definition.options, **config.task_kwargs}.get("arches")
        options["arches"] = "test_neck" if trained == "neck" else "test"
        if not isinstance(options.get("goal", ""), str):  # a goal for each arch
            options["goal"] = "any"
    label = f"{pretrained.PREFIX}{name}"
    card = {
        "task": config.task,
        "task_kwargs": options,
        "config": config.to_dict(),
        "shapes": shapes.to_dict(),
        "training": training,
        "evaluation": {},
        "versions": judgement.versions(),
    }
    if half:
        state = {
            k: v.half() if v.dtype == torch.float32 and v.ndim > 1 else v
            for k, v in state.items()
        }
        policy = pretrained.write(Path(out), name, state, card)
    found, _ = judgement.judge(policy, config.task, options, episodes, label)
    figures = judgement.episode_figures(found)
    card["evaluation"] = {
        "seed": found.seeds[0],
        "summary": found.summary(),
        "episodes": {name: figures[name] for name in _FIGURES},
    }
    weights = pretrained.write(Path(out), name, state, card)
    write_list(weights.parent)
    return weights


def write_list(directory):
    """Write README.md of a directory of policies from their cards."""
    lines = _HEAD
    for name in pretrained.pretrained_names(directory):
        card = pretrained.read_card(directory / f"{name}.json")
        summary, training = card["evaluation"]["summary"], card["training"]
        forces, observation = summary["forces"], card["config"]["observation"]
        if not isinstance(observation, str):
            observation = ", ".join(observation)
        # Cards from before 0.3 have the forces at the end of a control step.
        total = forces.get("mean_sum", forces["sum"])
        largest = forces.get("mean_max", forces["max"])
        shown = total["mean"], largest["mean_in_contact"], largest["maximum"]
        cells = [
            f"`{pretrained.PREFIX}{name}`",
            card["task"],
            observation,
            f"{training['frames']:,}",
            f"{summary['success'] * summary['episodes']:.0f} of {summary['episodes']}",
            *(millinewtons(one["mean"], one["sd"]) for one in shown),
        ]
        lines += f"| {' | '.join(cells)} |\n"
    files.write_text(directory / "README.md", lines)


if __name__ == "__main__":
    try:
        print(tyro.cli(export))
    except (ValueError, RuntimeError, OSError) as error:
        sys.exit(f"export: {error}")
