"""Tables of results in the terminal, and `cathsim table`."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table
from tyro import conf

from cathsim_dmc import __version__
from cathsim_dmc.agents import comparison
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.agents.evaluation import EvaluationResult
from cathsim_dmc.analysis.force_statistics import FIGURES, millinewtons
from cathsim_dmc.cli.options import Json, Modules, console, print_json
from cathsim_dmc.physics.forces import PEAK_NOTE
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP

_CAPTION = (
    "Mean ± standard deviation over episodes. Forces are means over a control step, as "
    "a load cell at 25 Hz reads them, except the peak. Mean force: sum over all "
    "contacts, mean over all steps. Mean contact force: largest single contact, mean "
    "over the steps with contact. Max force: largest single contact of any step. "
    "Largest sum: sum over all contacts of any step. Safe success: the goal reached "
    "with a largest sum at or below a limit. Peak force: largest single contact in any "
    f"physics step. {PEAK_NOTE}"
)
_NEARLY_ONE = (
    " Success without interval: episodes differ only by 1 mm of the start, or recur; "
    "`--protocol varied` plays distinct conditions."
)


def print_results(results: Sequence[EvaluationResult]) -> None:
    """Print figures of evaluations of one task side by side."""
    first, columns = results[0], [_figures(result) for result in results]
    title = f"{first.task}, seeds from {first.seeds[0]}"
    caption = _CAPTION + _NEARLY_ONE * (not first.distinct)
    heads = ("policy", *(result.policy for result in results))
    table = Table(*heads, title=title, caption=caption, caption_justify="left")
    for name in columns[0]:
        table.add_row(name, *(column[name] for column in columns))
    console().print(table)


def _figures(result: EvaluationResult) -> dict[str, str]:
    summary = result.summary()
    forces = {name: result.mean_sd(f"forces.{name}") for name in FIGURES}
    safe = summary["safe_success"].items()
    return {
        "reward": f"{summary['reward']:.1f} ± {summary['reward_sd']:.1f}",
        "steps": f"{summary['length']:.0f} ± {summary['length_sd']:.0f}",
        **{
            f"{n.replace('_', ' ')}, mN": millinewtons(mean, sd)
            for n, (mean, sd) in forces.items()
        },
        "success": comparison.success(summary),
        **{f"safe success, {limit}": f"{100 * rate:.0f} %" for limit, rate in safe},
    }


def print_episodes(result: EvaluationResult) -> None:
    """Print what was played and how each episode ended: task, model, outcome."""
    settings = result.settings
    chosen = ", ".join(f"{k}={v}" for k, v in settings["task_kwargs"].items())
    title = (
        f"task {result.task}, protocol {settings['protocol']}; model: "
        f"cathsim_dmc {__version__}, {chosen or 'options of the task'}"
    )
    drawn = result.conditions or ({},) * len(result.episodes)
    played = zip(result.seeds, drawn, result.episodes, strict=True)
    rows = [_outcome(seed, condition, one) for seed, condition, one in played]
    table = Table(*rows[0], title=title)
    for row in rows:
        table.add_row(*row.values())
    table.caption = f"Peak force: of any physics step. {PEAK_NOTE}"
    # A pipe has no width that the columns would have to fit.
    console(None if sys.stdout.isatty() else 160).print(table)


def _outcome(
    seed: int, conditions: Mapping[str, Any], episode: EpisodeOutcome
) -> dict[str, str]:
    ends = ("success", "goal reached"), ("failed", "failed"), ("given_up", "given up")
    reached = (text for name, text in ends if getattr(episode, name))
    end = next(reached, "out of time")
    forces = episode.forces
    largest = forces.largest_sum
    arch = f"arch {conditions['arch']}" if "arch" in conditions else "–"
    return {
        "seed": str(seed),
        "anatomy": conditions.get("anatomy", arch),
        "device": str(conditions.get("device") or "–"),
        "end": "physics error" if episode.physics_error else end,
        "time, s": f"{episode.length * CONTROL_TIMESTEP:.1f}",
        "path ratio": f"{episode.path_ratio:.2f}",
        "mean force, mN": millinewtons(forces.mean_force),
        "peak force, mN": millinewtons(forces.peak_force),
        "largest sum, N": "–" if largest is None else f"{largest:.2f}",
    }


def table(
    evaluations: Annotated[tuple[Path, ...], conf.Positional],
    /,
    baseline: bool = True,
    json: Json = False,
    modules: Modules = (),
) -> int:
    """Compare evaluations as a table in Markdown; mark those under different rules.

    Args:
        evaluations: Files evaluation.json of `cathsim eval --out`, or folders with such
            files at any depth.
        baseline: Whether the baselines of the files are listed too.
    """
    if not evaluations:
        raise ValueError(
            "no evaluation is given; give files of `cathsim eval --out`, or folders"
        )
    found = comparison.Comparison.of(evaluations, baseline)
    if json:
        print_json({"checks": [], **found.as_dict()})
        return 0
    print(found)
    return 0
