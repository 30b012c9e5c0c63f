"""Trains and evaluates the missing agents of docs/results.md.

    python benchmarks/trainings.py
    python benchmarks/trainings.py --only lcca-sac --list

An interrupted run continues from its last checkpoint. Each cell of grid.toml (task,
algorithm, preset, observation, seed) is trained in its own folder; its evaluation by
the published rule is written to a JSON file at the end. With --ray the machines of a
Ray cluster train the cells, see docs/cluster.md.
"""

import dataclasses
import fnmatch
import json
import os
import platform
import sys
import tempfile
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import judgement
import numpy as np
import torch
import tyro

from cathsim_dmc import cluster, files, suite
from cathsim_dmc.agents import training
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.agents.learners import make_config
from cathsim_dmc.agents.training_log import EPISODE_WINDOW, read_metrics
from cathsim_dmc.cli.options import BAD_INPUT, CHECK_FAILED, INTERRUPTED

HERE = Path(__file__).parent
FORMAT = 2
POINTS = 200  # of the learning curve
SOLVED = 0.9  # success rate of a solved task
# Share of an expert's control steps above which an episode is not counted.
GUIDED = 0.05
# Columns of metrics.csv in the learning curve, if present.
_CURVE = ("frames", "seconds", "episodes", "episode_reward", "episode_length")
_CURVE += ("success", "distance", "mean_force", "max_force")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cell:
    """One training with its evaluation; grid.toml describes the fields."""

    label: str
    task: str
    algorithm: str
    preset: str
    observation: str | list[str]
    seed: int
    total_frames: int
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    variant: str = ""
    evaluation: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def name(self):
        """Name of the folder and of the JSON file of the cell."""
        observation = self.observation
        if not isinstance(observation, str):
            observation = "+".join(observation)
        parts = (self.task, self.algorithm, observation, self.preset, self.variant)
        return "-".join(part for part in (*parts, f"seed{self.seed}") if part)

    def to_dict(self):
        """The fields and the name as JSON values."""
        return {"name": self.name, **dataclasses.asdict(self)}

    def config(self):
        """Configuration of the training; ConfigError names an invalid setting."""
        settings = {
            name: value.replace("{task}", self.task)
            if isinstance(value, str)
            else value
            for name, value in self.settings.items()
        }
        own = ("task", "observation", "seed", "total_frames")
        settings |= {name: getattr(self, name) for name in own}
        added = settings.pop("task_kwargs", {})
        config = make_config(self.algorithm, self.preset, **settings)
        return config.replace(task_kwargs={**config.task_kwargs, **added})

    def evaluated(self, config):
        """Task, options, set of arches and number of episodes of the evaluation."""
        asked = dict(self.evaluation)
        task = asked.pop("task", self.task)
        options = judgement.published_options(config.task_kwargs)
        options |= asked.pop("task_kwargs", {})
        arches = asked.pop("each_arch", None)
        episodes = asked.pop("episodes", judgement.EPISODES)
        if task not in suite.TASKS or asked or not episodes > 0:
            raise ValueError(
                f"evaluation={dict(self.evaluation)!r} is not allowed: it may have "
                "task (of `cathsim list`), task_kwargs, episodes (1 or more), each_arch"
            )
        if arches is not None and not suite.TASKS[task].random_arch:
            raise ValueError(f"each_arch needs a task with random arches, not {task}")
        return task, options, arches, episodes


def read_grid(path=HERE / "grid.toml"):
    """The cells of a grid file in the order of their runs.

    Within a row the first seed of every task comes before the second seed of any.

    Raises:
        ValueError: if the file cannot be read, or a row is invalid.
    """
    cells, where = {}, ""
    try:
        rows = tomllib.loads(Path(path).read_text())["row"]
        for number, row in enumerate(rows, 1):
            where = f"row {number}: "
            tasks, seeds = row.pop("tasks"), row.pop("seeds", [0])
            frames = row.pop("total_frames")
            for seed in seeds:
                for task in tasks:
                    total = frames[task] if isinstance(frames, dict) else frames
                    cell = Cell(task=task, seed=seed, total_frames=total, **row)
                    if task not in suite.TASKS or "/" in cell.name:
                        raise ValueError(f"no task {task!r}, or a name with /")
                    cell.evaluated(cell.config())
                    if cell.name in cells:
                        raise ValueError(f"{cell.name} is there twice; give a variant")
                    cells[cell.name] = cell
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        kind = "lacks " if isinstance(error, KeyError) else ""
        raise ValueError(f"{path}, {where}{kind}{error}") from error
    return list(cells.values())


class Result(NamedTuple):
    """Content of the file of a finished cell."""

    path: Path
    values: dict[str, Any]
    cell: dict[str, Any]
    training: dict[str, Any]
    evaluation: dict[str, Any]
    success: float
    frames_per_second: float


def read_result(path):
    """The result in the file of a cell; ValueError if the file is damaged."""
    try:
        values = json.loads(Path(path).read_text())
        if values["format"] != FORMAT or values["cell"]["name"] != Path(path).stem:
            raise ValueError(f"it is no result of format {FORMAT} with this name")
        cell, training, evaluation = map(values.get, ("cell", "training", "evaluation"))
        success = float(evaluation["summary"]["success"])
        speed = training["frames"] / training["seconds"]
    except (KeyError, TypeError, ValueError) as error:
        line = f"{type(error).__name__}: {error}"
        raise ValueError(f"{path} is damaged: {line}") from error
    return Result(path, values, cell, training, evaluation, success, speed)


def differences(result, cell):
    """Names of the settings in which a result differs from a cell as it is now.

    Settings of the preset count, those that one of the two does not have do not.
    """
    asked, there = cell.to_dict(), result.cell
    changed = [k for k in asked if k != "label" and there.get(k) != asked[k]]
    now, then = cell.config().to_dict(), result.values["config"]
    found = [k for k in now if then.get(k, now[k]) != now[k] and k not in asked]
    return changed + found


def standing(cell, runs, results):
    """State of a cell, and a remark.

    The state is "finished", "other settings" (finished with settings that differ from
    the grid's), "begun" (a training exists) or "waiting".
    """
    path, remark = results / f"{cell.name}.json", ""
    if path.exists():
        try:
            found = read_result(path)
        except ValueError as error:
            remark = str(error)
        else:
            changed = differences(found, cell)
            if changed:
                differ = f"{', '.join(changed)} differ; move {path} away"
                return "other settings", differ
            return "finished", f"success {100 * found.success:.0f} %"
    begun = (runs / cell.name / training.CONFIG_FILE).exists()
    return "begun" if begun else "waiting", remark


def work(cell, runs, results, num_threads=None):
    """Train or continue a cell, evaluate it and write its file.

    Args:
        cell: Cell to train.
        runs: Directory with a folder for each training.
        results: Directory with a JSON file for each finished cell.
        num_threads: Number of threads of the simulation; None for that of the cell.

    Returns:
        Whether the cell is finished; a signal ends the training with a checkpoint.
    """
    config, folder = cell.config(), runs / cell.name
    files.require_folder(results, make=True)  # checked first, as a result would be lost
    task, options, arches, episodes = cell.evaluated(config)
    suite.make_task(task, **options)  # refuses invalid options before the training
    resume = (folder / training.CONFIG_FILE).exists()
    threads = config.num_threads if num_threads is None else num_threads
    own = config.replace(num_threads=threads)
    done = training.train(own, folder, resume=resume)
    if done.interrupted:
        return False
    checkpoint = Checkpoint.open(done.checkpoint)
    evaluation = judgement.evaluation(
        checkpoint, task, options, arches, episodes, cell.name, num_threads
    )
    rows = read_metrics(folder / "metrics.csv")
    values = {
        "format": FORMAT,
        "cell": cell.to_dict(),
        "config": config.to_dict(),
        "training": {
            "frames": checkpoint.frames,
            "seconds": round(checkpoint.seconds, 1),
            "solved": solved(rows),
            "curve": learning_curve(rows),
        },
        "evaluation": evaluation,
        "versions": judgement.versions(),
        "commit": judgement.commit(),
        "machine": {"processor": platform.processor(), "cores": os.cpu_count()},
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    write_result(results / f"{cell.name}.json", values)
    return True


def _work_apart(job):
    """`work` in a process of a cluster; FileNotFoundError if `runs` is not shared."""
    cell, runs, results, mark, processors, of_torch = job
    if not mark.exists():
        raise FileNotFoundError(
            f"{runs} of the first machine is not seen on {platform.node()}; --runs and "
            "--results must be folders that all machines share"
        )
    torch.set_num_threads(of_torch)  # rounding depends on it
    return work(cell, runs, results, processors)


def work_on_cluster(cells, runs, results, processors):
    """`work` on the machines of a cluster, with `processors` for each cell.

    A cell begins after the cell whose policy it starts from.

    Yields:
        Index of a cell that ended, and the result of `work` or the exception.
    """
    runs, results = runs.resolve(), results.resolve()
    runs.mkdir(parents=True, exist_ok=True)
    left = dict(enumerate(cells))
    with tempfile.NamedTemporaryFile(dir=runs, prefix=".shared-") as mark:
        own = runs, results, Path(mark.name), processors, torch.get_num_threads()
        while left:
            names = [cell.name for cell in left.values()]
            starts = {n: Path(c.config().initial_policy or "") for n, c in left.items()}
            ready = [n for n, start in starts.items() if start.name not in names]
            ready = ready or [*left]
            jobs = [(left.pop(number), *own) for number in ready]
            ended = cluster.over(_work_apart, jobs, processors, keep_going=True)
            yield from ((ready[number], outcome) for number, outcome in ended)


def write_result(path, values):
    """Write the file of a cell, with a line for each part; return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [
        f"{json.dumps(name)}: {json.dumps(value, allow_nan=False)}"
        for name, value in values.items()
    ]
    return files.write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


def learning_curve(rows):
    """At most `POINTS` rows of metrics.csv as columns, including the last row."""
    if not rows:
        return {}
    count = min(len(rows), POINTS)
    chosen = np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int))
    columns = [name for name in _CURVE if name in rows[0]]
    return {n: judgement.numbers(rows[i][n] for i in chosen) for n in columns}


def solved(rows):
    """Frames and seconds at which the success of training episodes reached `SOLVED`.

    Success is the mean over the last 100 finished episodes. The first 100 episodes do
    not count, because those that end early are the successful ones; nor do episodes in
    which an expert acts in more than `GUIDED` of the control steps (DAgger). None if
    success never reached `SOLVED`.
    """
    guided = 0.0
    for row in rows:
        episodes = row.get("episodes") or 0.0
        if (row.get("expert_share") or 0.0) > GUIDED:
            guided = episodes
        enough = episodes - guided >= EPISODE_WINDOW
        if enough and (row.get("success") or 0.0) >= SOLVED:
            return {"frames": row["frames"], "seconds": row["seconds"]}
    return None


def main(
    grid: Path = HERE / "grid.toml",
    runs: Path = Path("runs/table"),
    results: Path = Path("results"),
    only: tyro.conf.UseAppendAction[list[str]] = [],  # noqa: B006
    list: bool = False,
    ray: bool = False,
    processors: int = 1,
) -> int:
    """Train and evaluate the cells of a grid, as far as they are missing.

    Args:
        grid: Path of the TOML file with the cells.
        runs: Directory with a folder for each training.
        results: Directory with a JSON file for each finished cell.
        only: Part of the names of cells, or a pattern with *; repeated for several.
        list: Whether to list what is done and what is left, and run nothing.
        ray: Whether the machines of a Ray cluster train the cells; they must all see
            the folders `runs` and `results`.
        processors: Number of processors of a cell on the cluster.
    """
    try:
        cells = read_grid(grid)
        for part in only:
            if not fnmatch.filter([cell.name for cell in cells], f"*{part}*"):
                raise ValueError(f"no cell is named like {part!r}; --list names all")
    except ValueError as error:
        print(f"trainings: {error}", file=sys.stderr)
        return BAD_INPUT
    code, missing = 0, []
    for cell in cells:
        if only and not any(fnmatch.fnmatch(cell.name, f"*{one}*") for one in only):
            continue
        state, remark = standing(cell, runs, results)
        print(f"{cell.name}: {state} {remark}".rstrip(), flush=True)
        if not list and state not in ("finished", "other settings"):
            missing.append(cell)
    try:
        ended = enumerate(attempt(cell, runs, results) for cell in missing)
        if ray:
            ended = work_on_cluster(missing, runs, results, processors)
        for number, outcome in ended:
            if outcome is False:
                return INTERRUPTED
            name, text = missing[number].name, "finished"
            if isinstance(outcome, Exception):
                code = CHECK_FAILED
                text = f"failed, {type(outcome).__name__}: {outcome}"
            print(f"{name}: {text}", flush=True)
    except (ValueError, OSError, ImportError) as error:
        print(f"trainings: {error}", file=sys.stderr)
        return BAD_INPUT
    return code


def attempt(cell, runs, results):
    """Result of `work`, or the exception that ended it."""
    print(f"{cell.name}: begins", flush=True)
    try:
        return work(cell, runs, results)
    except (ValueError, OSError, RuntimeError, ArithmeticError) as error:
        return error


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
