"""Evaluations with a baseline and heatmaps, and recordings of one episode."""

import dataclasses
import functools
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torchrl.envs import EnvBase

from cathsim_dmc import __version__, bounds, files, suite
from cathsim_dmc.agents import evaluation, policies, protocols
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.agents.progress import EvaluationProgress
from cathsim_dmc.analysis import heatmap
from cathsim_dmc.analysis.force_statistics import FIGURES, millinewtons
from cathsim_dmc.pictures import recorded
from cathsim_dmc.pictures.animation import SUFFIXES, check_film
from cathsim_dmc.policies import in_environment
from cathsim_dmc.recording import recorder
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP


@dataclasses.dataclass(frozen=True)
class EvaluationReport:
    """An evaluation, with a baseline on the same seeds.

    Attributes:
        policy: Evaluation of the policy that was asked for.
        baseline: Evaluation of the random policy, or None.
        seconds: Wall time of both.
    """

    policy: evaluation.EvaluationResult
    baseline: evaluation.EvaluationResult | None
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values."""
        values = {"policy": self.policy.to_dict(), "seconds": round(self.seconds, 1)}
        if self.baseline is not None:
            values["baseline"] = self.baseline.to_dict()
        return values

    def print(self) -> None:
        """Prints a table."""
        from rich.console import Console
        from rich.table import Table

        title = f"{self.policy.task}, seeds from {self.policy.seeds[0]}"
        caption = _CAPTION if self.policy.distinct else f"{_CAPTION} {_NEARLY_ONE}"
        table = Table(title=title, caption=caption, caption_justify="left")
        results = [one for one in (self.policy, self.baseline) if one is not None]
        for column in ("policy", *(result.policy for result in results)):
            table.add_column(column)
        for row in zip(_ROWS, *map(_cells, results), strict=True):
            table.add_row(*row)
        Console().print(table)

    def print_episodes(self) -> None:
        """Prints what was played and how each episode ended: task, model, outcome."""
        from rich.console import Console
        from rich.table import Table

        settings = self.policy.settings
        chosen = ", ".join(f"{k}={v}" for k, v in settings["task_kwargs"].items())
        title = (
            f"task {self.policy.task}, protocol {settings['protocol']}; model: "
            f"cathsim_dmc {__version__}, {chosen or 'options of the task'}"
        )
        table = Table(*_OUTCOME, title=title)
        drawn = self.policy.conditions or ({},) * len(self.policy.episodes)
        played = zip(self.policy.seeds, drawn, self.policy.episodes, strict=True)
        for seed, conditions, episode in played:
            table.add_row(str(seed), *_outcome(conditions, episode))
        # A pipe has no width that the columns would have to fit.
        Console(width=None if sys.stdout.isatty() else 160).print(table)


_OUTCOME = (
    "seed", "arch", "device", "end", "time, s", "path ratio", "mean force, mN",
    "peak force, mN", "largest sum, N",
)  # fmt: skip


def _outcome(conditions: Mapping[str, Any], episode: EpisodeOutcome) -> list[str]:
    def shown(value: float | None, digits: int) -> str:
        return "–" if value is None else f"{value:.{digits}f}"

    end = "goal reached" if episode.success else "out of time"
    return [
        *(str(conditions.get(name, "–")) for name in ("arch", "device")),
        "physics error" if episode.physics_error else end,
        shown(episode.length * CONTROL_TIMESTEP, 1),
        shown(episode.path_ratio, 2),
        millinewtons(episode.forces.mean_force),
        millinewtons(episode.forces.peak_force),
        shown(episode.forces.peak_sum and episode.forces.peak_sum.maximum, 2),
    ]


_ROWS = (
    "reward", "steps", "mean force, mN", "mean contact force, mN",
    "max force, mN", "peak force, mN", "success",
    *(f"safe success, {limit:g} N" for limit in evaluation.SAFE_FORCES),
)  # fmt: skip
_CAPTION = (
    "Mean ± standard deviation over episodes. Mean force: sum over all contacts at the "
    "end of a control step, mean over all steps. Mean contact force: largest single "
    "contact at the end of a control step, mean over the steps with contact. Max "
    "force: largest single contact at the end of any control step. Peak force: the "
    "same in any physics step. Safe success: the goal reached while the sum over all "
    "contacts stays at or below a limit in every physics step."
)
_NEARLY_ONE = (
    "Success without interval: the episodes differ only by 1 mm of the start; "
    "`--protocol varied` plays distinct conditions."
)


def _cells(result: evaluation.EvaluationResult) -> list[str]:
    def spread(name: str, digits: int) -> str:
        mean, deviation = result.mean_sd(name)
        return "–" if mean is None else f"{mean:.{digits}f} ± {deviation:.{digits}f}"

    summary = result.summary()
    rate, interval = summary["success"], summary["success_ci95"]
    success = _percent(rate)
    if interval is not None:
        low, high = (round(100 * bound) for bound in interval)
        success += f" ({low}–{high})"
    return [
        spread("reward", 1),
        spread("length", 0),
        *(millinewtons(*result.mean_sd(f"forces.{name}")) for name in FIGURES),
        success,
        *map(_percent, summary["safe_success"].values()),
    ]


def _percent(rate: float | None) -> str:
    return "–" if rate is None else f"{100 * rate:.0f} %"


class ContactLog:
    """Contacts with the wall over the episodes of a batched evaluation."""

    def __init__(self):
        self._positions = [np.zeros((0, 3))]
        self._magnitudes = [np.zeros(0)]

    def __call__(self, env: EnvBase, running: np.ndarray) -> None:
        """Adds the contacts at the end of a control step; an evaluation observer."""
        contacts = env.base_env.simulation.contacts()
        present = contacts.present & running[:, None]
        self._positions.append(contacts.position[present])
        self._magnitudes.append(contacts.magnitude[present])

    @property
    def positions(self) -> np.ndarray:
        """(K, 3), m, world frame."""
        return np.concatenate(self._positions)

    @property
    def magnitudes(self) -> np.ndarray:
        """(K,), N."""
        return np.concatenate(self._magnitudes)

    def draw(self, result: evaluation.EvaluationResult, path: Path) -> None:
        """Writes the heatmap of an evaluation as PNG."""
        task = suite.make_task(result.task, **result.settings["task_kwargs"])
        heatmap.heatmap(
            self.positions,
            self.magnitudes,
            task.scene.anatomy.surface,
            path,
            title=f"{result.task}, {result.policy}: {len(result.episodes)} episodes",
        )


def evaluate(
    policy: policies.PolicyLike,
    *,
    task: str | None = None,
    episodes: int | None = None,
    seed: int = evaluation.EVALUATION_SEED,
    protocol: str = "published",
    task_kwargs: Mapping[str, Any] | None = None,
    num_threads: int | None = None,
    baseline: bool = True,
    out_dir: str | Path | None = None,
) -> EvaluationReport:
    """Evaluates a policy; writes its files into a directory.

    What takes long says so on standard error now and then. Arguments without a line
    here are those of `evaluation.evaluate`.

    Args:
        task: Name of the task, see `policies.task_and_options`.
        task_kwargs: Options of the task, over those that the policy was trained with.
        baseline: Whether to play the same seeds with the random policy too.
        out_dir: Directory for evaluation.json and heatmap.png; None writes none.
    """
    began = time.monotonic()
    if episodes is None:
        episodes = protocols.get(protocol).episodes
    evaluation.check_numbers(episodes, seed, num_threads)
    player = policies.load_policy(policy, seed)
    task, options = policies.task_and_options(player, task, task_kwargs)
    require_registered(task)
    if out_dir is not None:
        # Now: an evaluation that cannot be written would be lost.
        Path(out_dir).mkdir(parents=True, exist_ok=True)
    contacts, alive = ContactLog(), EvaluationProgress(player.name)

    def observe(env: EnvBase, running: np.ndarray) -> None:
        alive(env, running)
        contacts(env, running)

    play = functools.partial(
        evaluation.evaluate,
        episodes=episodes,
        seed=seed,
        protocol=protocol,
        num_threads=num_threads,
    )
    result = play(player, task, task_kwargs=options, observer=observe)
    other = None
    if baseline and str(policy) != "random":
        other = play(
            "random",
            result.task,
            task_kwargs=result.settings["task_kwargs"],
            observer=EvaluationProgress("random"),
        )
    report = EvaluationReport(result, other, time.monotonic() - began)
    if out_dir is not None:
        evaluation.write_evaluation(out_dir, report.to_dict())
        contacts.draw(result, Path(out_dir) / "heatmap.png")
    return report


def require_registered(task: str) -> None:
    """Raise ValueError unless a task is one of the suite."""
    if task not in suite.SUITE:
        raise ValueError(f"no task {task!r}; there are {', '.join(suite.SUITE)}")


def record(
    policy: policies.PolicyLike,
    out: str | Path | None,
    *,
    task: str | None = None,
    seed: int = evaluation.EVALUATION_SEED,
    max_steps: int | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
    fluoroscopy: bool = True,
    gif: str | Path | None = None,
) -> Episode:
    """Records one episode: as .rrd, and as .npz beside it; or as a film.

    Args:
        policy: Policy, or what names one, see `policies.load_policy`.
        out: Path of the .rrd file; None writes none.
        task: Name of the task, see `policies.task_and_options`.
        max_steps: Number of control steps after which the episode is cut off; None
            leaves it to the task.
        task_kwargs: Options of the task, over those that the policy was trained with.
        fluoroscopy: Whether to include X-ray images.
        gif: Path of the film, .gif or .webp; None makes none.

    Returns:
        The episode.

    Raises:
        ValueError: `out` is no .rrd file, `gif` no film, there is neither, or no task
            is known.
        CheckpointError: there is no such checkpoint, or it is damaged.
    """
    targets = _targets(out, gif)
    bounds.seed("seed", seed)
    if max_steps is not None:
        bounds.whole("max_steps", max_steps, 1)
    player = policies.load_policy(policy, seed)
    task, kwargs = policies.task_and_options(player, task, task_kwargs)
    require_registered(task)
    # Now: an episode that cannot be written would be lost.
    for target in targets.values():
        target.parent.mkdir(parents=True, exist_ok=True)
    if player.observation is not None:
        kwargs["observation"] = player.observation
    environment = suite.load(suite.DOMAIN, task, task_kwargs={**kwargs, "random": seed})
    episode = recorder.EpisodeRecorder(environment, task, kwargs).record_episode(
        in_environment(player, environment), seed=seed, max_steps=max_steps
    )
    if "out" in targets:
        # Put in place last, once both are written.
        with files.atomic_path(targets["out"].with_suffix(".npz")) as arrays:
            episode.write(arrays)
            recorded.write(episode, environment, targets["out"], fluoroscopy)
    if "gif" in targets:
        recorded.write(episode, environment, targets["gif"])
    return episode


def _targets(out: str | Path | None, gif: str | Path | None) -> dict[str, Path]:
    """The files to write by kind."""
    given = {"out": (out, (".rrd",)), "gif": (gif, SUFFIXES)}
    targets = {kind: Path(path) for kind, (path, _) in given.items() if path}
    for kind, path in targets.items():
        if path.suffix not in given[kind][1]:
            raise ValueError(
                f"the recording is to be written to {path}; give an "
                f"{' or '.join(given[kind][1])} file"
            )
    if "gif" in targets:
        check_film(targets["gif"])
    if not targets:
        raise ValueError(
            "nothing is to be written; give out (--out), an .rrd file, or gif (--gif), "
            f"a {' or '.join(SUFFIXES)} file"
        )
    return targets
