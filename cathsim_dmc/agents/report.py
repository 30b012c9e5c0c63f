"""What `cathsim eval` and `record` do: evaluations, heatmaps, recordings."""

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torchrl.envs import EnvBase

from cathsim_dmc import suite
from cathsim_dmc.agents import evaluation, policies
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.analysis import heatmap
from cathsim_dmc.recording import recorder, rerun_log
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.scene import body_geoms

NAMED_POLICIES = ("random", "expert", "push")


@dataclasses.dataclass(frozen=True)
class Report:
    """An evaluation, with a baseline on the same seeds.

    Attributes:
      policy: what was asked for.
      baseline: the random policy, or None.
      comparison: of the two, or None.
      seconds: wall time.
    """

    policy: evaluation.EvaluationResult
    baseline: evaluation.EvaluationResult | None
    comparison: evaluation.Comparison | None
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values."""
        values = {"policy": self.policy.to_dict(), "seconds": round(self.seconds, 1)}
        if self.baseline is not None:
            values["baseline"] = self.baseline.to_dict()
            values["comparison"] = self.comparison.to_dict()
        return values

    def print(self) -> None:
        """Prints a table."""
        from rich.console import Console
        from rich.table import Table

        table = Table(title=f"{self.policy.task}, seeds from {self.policy.seed}")
        for column in ("policy", "reward", "steps", "force, N", "peak, N", "success"):
            table.add_column(column)
        for result in (self.policy, self.baseline):
            if result is not None:
                table.add_row(result.policy, *_cells(result.summary()))
        console = Console()
        console.print(table)
        if self.comparison is not None:
            low, high = self.comparison.reward_ci95
            console.print(
                f"reward over {self.comparison.baseline}: "
                f"{self.comparison.reward_difference:+.1f} "
                f"(95 % interval {low:+.1f} to {high:+.1f})"
            )


def _cells(summary: Mapping[str, Any]) -> list[str]:
    def spread(name: str, digits: int) -> str:
        mean, deviation = summary[name], summary[f"{name}_sd"]
        return "–" if mean is None else f"{mean:.{digits}f} ± {deviation:.{digits}f}"

    rate, interval = summary["success"], summary["success_ci95"]
    success = "–"
    if rate is not None:
        low, high = (round(100 * bound) for bound in interval)
        success = f"{100 * rate:.0f} % ({low}–{high})"
    return [
        spread("reward", 1),
        spread("length", 0),
        spread("mean_force", 3),
        spread("peak_force", 3),
        success,
    ]


class ContactLog:
    """Contacts with the wall over the episodes of a batched evaluation."""

    def __init__(self):
        self._positions: list[np.ndarray] = []
        self._magnitudes: list[np.ndarray] = []

    def __call__(self, env: EnvBase, running: np.ndarray) -> None:
        """Adds the contacts at the end of a control step; an evaluation observer."""
        simulation = env.base_env.simulation
        rows = simulation.sensor_rows[running, -1]
        contacts = simulation.task.rollout.index.contacts(rows)
        self._positions.append(contacts.position[contacts.present])
        self._magnitudes.append(contacts.magnitude[contacts.present])

    @property
    def positions(self) -> np.ndarray:
        """(K, 3), m, world frame."""
        return np.concatenate(self._positions or [np.zeros((0, 3))])

    @property
    def magnitudes(self) -> np.ndarray:
        """(K,), N."""
        return np.concatenate(self._magnitudes or [np.zeros(0)])


def evaluate(
    policy: str | Path,
    *,
    task: str | None = None,
    episodes: int = 30,
    seed: int = 1_000_000,
    task_kwargs: Mapping[str, Any] | None = None,
    num_threads: int | None = None,
    baseline: bool = True,
    out_dir: str | Path | None = None,
) -> Report:
    """Evaluates a policy; writes evaluation.json and heatmap.png into a directory.

    Args:
      policy: directory of a run or checkpoint, "random", or "expert".
      task: by default the checkpoint's.
      episodes: how many.
      seed: of the first.
      task_kwargs: by default the checkpoint's.
      num_threads: of the simulation.
      baseline: play the same seeds with the random policy too.
      out_dir: for the files, if any.
    """
    start = time.monotonic()
    contacts = ContactLog()
    options = {"num_threads": num_threads, "observer": contacts}
    if str(policy) == "expert":
        from cathsim_dmc.agents import expert

        _require_task(task, policy)
        result = expert.expert_episodes(
            task, episodes, seed, task_kwargs=task_kwargs, **options
        )
    else:
        result = evaluation.evaluate(
            policy, task, episodes, seed, task_kwargs=task_kwargs, **options
        )
    other = comparison = None
    if baseline and str(policy) != "random":
        other = evaluation.evaluate(
            "random",
            result.task,
            episodes,
            seed,
            task_kwargs=result.settings["task_kwargs"],
            num_threads=num_threads,
        )
        comparison = evaluation.compare(result, other)
    report = Report(result, other, comparison, time.monotonic() - start)
    if out_dir is not None:
        evaluation.write_evaluation(out_dir, report.to_dict())
        environment = suite.load(
            suite.DOMAIN, result.task, task_kwargs=dict(result.settings["task_kwargs"])
        )
        heatmap.contact_heatmap(
            contacts.positions,
            contacts.magnitudes,
            environment.task.scene.anatomy.surface,
            Path(out_dir) / "heatmap.png",
            title=f"{result.task}, {result.policy}: {episodes} episodes",
        )
    return report


def _require_task(task: str | None, policy: str | Path) -> None:
    if task is None:
        raise ValueError(
            f"policy {str(policy)!r} is no checkpoint, so the task must be given: "
            f"--task with one of {', '.join(suite.SUITE)}"
        )


def record(
    policy: str | Path,
    out: str | Path,
    *,
    task: str | None = None,
    seed: int = 1_000_000,
    max_steps: int | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
    fluoroscopy: bool = True,
) -> Episode:
    """Records one episode as .rrd, and as .npz beside it.

    Args:
      policy: directory of a run or checkpoint, or one of `NAMED_POLICIES`.
      out: the .rrd file.
      task: by default the checkpoint's.
      seed: of the episode.
      max_steps: stop after so many control steps.
      task_kwargs: by default the checkpoint's.
      fluoroscopy: include X-ray images.
    """
    out = Path(out)
    if out.suffix != ".rrd":
        raise ValueError(f"the recording is to be written to {out}; give an .rrd file")
    checkpoint = None
    if str(policy) in NAMED_POLICIES:
        _require_task(task, policy)
    else:
        checkpoint = Checkpoint.open(policy)
        task = task or checkpoint.config.task
        if task_kwargs is None:
            task_kwargs = checkpoint.config.task_kwargs
    kwargs = dict(task_kwargs or {})
    if checkpoint is not None:
        kwargs["observation"] = checkpoint.config.observation
    environment = suite.load(suite.DOMAIN, task, task_kwargs={**kwargs, "random": seed})
    act = _timestep_policy(str(policy), checkpoint, environment, seed)
    episode = recorder.EpisodeRecorder(environment, task, kwargs).record_episode(
        act, seed=seed, max_steps=max_steps
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    episode.save(out.with_suffix(".npz"))
    rerun_log.write_rrd(
        episode,
        environment.task.scene.anatomy.surface,
        out,
        robot_geoms=body_geoms(environment.physics),
        fluoroscopy=_images(environment, episode) if fluoroscopy else None,
    )
    return episode


def _timestep_policy(name, checkpoint, environment, seed) -> policies.TimestepPolicy:
    if checkpoint is not None:
        return policies.trained(checkpoint)
    if name == "expert":
        from cathsim_dmc.agents import expert

        return expert.policy(environment)
    if name == "push":
        return policies.push(environment)
    return policies.random(environment, seed)


def _images(environment, episode: Episode) -> np.ndarray:
    """X-ray images (T + 1, H, W, 1) of an episode."""
    from cathsim_dmc.imaging import Angiograph

    task = environment.task
    surface = task.scene.anatomy.surface
    fluoroscope = task.rollout.fluoroscope
    if fluoroscope is None:
        machine = Angiograph(surface.vertices, surface.faces, task.config.fluoroscopy)
        fluoroscope = machine.planes()[0]
    return fluoroscope.render(episode.catheter, task.scene.catheter.device.outer_radius)
