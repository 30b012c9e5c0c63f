"""One cell of the grid: train or continue, evaluate, write its file."""

import contextlib
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from cathsim_dmc import files
from cathsim_dmc.agents.checkpoint import Checkpoint, checkpoints_in
from cathsim_dmc.agents.config import ConfigError
from cathsim_dmc.agents.evaluation import write_evaluation
from cathsim_dmc.agents.learners import config_from_dict
from cathsim_dmc.agents.metrics import read_metrics
from cathsim_dmc.agents.training import CONFIG_FILE, train
from cathsim_dmc.benchmarks import protocol, provenance, result
from cathsim_dmc.benchmarks.grid import Cell

try:
    import fcntl
except ImportError:  # Windows: two runners there must not share a grid.
    fcntl = None

SESSIONS = "sessions.json"
_FAILURE = "failure.txt"
# Longer than `is_busy` of another process holds the lock, s.
_PATIENCE = 1.0


class BusyError(RuntimeError):
    """Another process works on the cell."""


class TrainingInterruptedError(RuntimeError):
    """A signal ended the training, which can be continued."""


@dataclass(frozen=True)
class Folders:
    """Where the cells of a grid lie.

    Attributes:
        runs: Directory with a folder for each training.
        results: Directory with a JSON file for each finished cell.
    """

    runs: Path = Path("runs/table")
    results: Path = Path("results")

    def run(self, cell: Cell) -> Path:
        """Directory of a cell's training."""
        return self.runs / cell.name

    def result(self, cell: Cell) -> Path:
        """Path of a cell's file."""
        return self.results / f"{cell.name}.json"

    def failure(self, cell: Cell) -> str | None:
        """Why the last attempt at a cell failed; None if it did not."""
        path = self.run(cell) / _FAILURE
        return path.read_text().strip() if path.exists() else None


def work(cell: Cell, folders: Folders, anew: bool = False) -> result.Result:
    """Do what is left of a cell.

    Killed at any moment, it is simply called again: the training goes on from its
    newest checkpoint, an evaluation that was cut off starts anew, and the file of the
    cell appears whole or not at all.

    Args:
        cell: What to train.
        folders: Where to.
        anew: Whether a training or a result of other settings is put aside; otherwise
            it is an error.

    Returns:
        What its file holds.

    Raises:
        BusyError: another process works on it.
        TrainingInterruptedError: a signal ended the training.
        ConfigError: the settings are not allowed, or what is there has others.
        CheckpointError: the newest checkpoint is damaged.
    """
    config, run = cell.config(), folders.run(cell)
    with exclusive(folders, cell):
        if folders.result(cell).exists():
            with contextlib.suppress(result.ResultError):
                found = result.read_result(folders.result(cell))
                changed = changed_settings(cell, found.values)
                if not changed:
                    return found
                _refuse(cell, changed, anew)
        if anew:
            _put_aside(cell, run)
        sessions = _note_session(run)
        try:
            checkpoint = _trained(cell, run)
            judged = _judged(cell, checkpoint)
            values = {
                "cell": cell.to_dict(),
                "config": config.to_dict(),
                "training": _training(run, checkpoint, sessions),
                "evaluation": judged,
                "versions": provenance.versions(),
                "machine": provenance.machine(),
                "finished": provenance.now(),
                **provenance.commit(),
            }
            result.write_result(folders.result(cell), values)
        except Exception as error:
            if not isinstance(error, TrainingInterruptedError):
                note_failure(folders, cell, f"{type(error).__name__}: {error}")
            raise
        (run / _FAILURE).unlink(missing_ok=True)
        return result.read_result(folders.result(cell))


def note_failure(folders: Folders, cell: Cell, text: str) -> None:
    """Write down why an attempt at a cell failed, until one does not."""
    run = folders.run(cell)
    run.mkdir(parents=True, exist_ok=True)
    files.write_text(run / _FAILURE, text + "\n")


@contextlib.contextmanager
def exclusive(folders: Folders, cell: Cell) -> Iterator[None]:
    """Keep every other process from a cell until the block or this process ends.

    Raises:
        BusyError: another process has it.
    """
    folders.runs.mkdir(parents=True, exist_ok=True)
    with open(_lock_path(folders, cell), "ab") as stream:
        end = time.monotonic() + _PATIENCE
        while not _locked(stream):
            if time.monotonic() >= end:
                raise BusyError(f"another process works on {cell.name}")
            time.sleep(0.05)
        yield


def is_busy(folders: Folders, cell: Cell) -> bool:
    """Whether another process works on a cell."""
    path = _lock_path(folders, cell)
    if not path.exists():
        return False
    with open(path, "ab") as stream:
        return not _locked(stream)


def _lock_path(folders: Folders, cell: Cell) -> Path:
    # Beside the folder of the cell, which may be put aside.
    return folders.runs / f".{cell.name}.lock"


def _locked(stream: IO[bytes]) -> bool:
    """Lock an open file until it is closed; whether that could be done."""
    if fcntl is not None:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
    return True


def changed_settings(cell: Cell, values: Any) -> dict[str, tuple[Any, Any]]:
    """What a result was trained and evaluated with, as far as the cell says otherwise.

    Args:
        cell: Cell of the grid.
        values: Values of the result's file.

    Returns:
        Field: (in the file, in the grid).

    Raises:
        ConfigError: the cell's settings are not allowed.
    """
    config = cell.config()
    try:
        trained = config_from_dict(values["config"])
    except ConfigError:
        return {"config": ("of another version", "")}
    changed = dict(trained.changed_for_resume(config))
    pairs = {
        "total_frames": (trained.total_frames, config.total_frames),
        "evaluation": (values["cell"].get("evaluation"), dict(cell.evaluation)),
    }
    return changed | {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def _refuse(cell: Cell, changed: dict[str, tuple[Any, Any]], anew: bool) -> None:
    if not anew:
        raise ConfigError(
            f"{cell.name} was finished with other settings ({described(changed)}); "
            "--anew does it again"
        )


def described(changed: dict[str, tuple[Any, Any]]) -> str:
    """Changed settings as text."""
    return "; ".join(f"{name}: {a!r}, now {b!r}" for name, (a, b) in changed.items())


def _put_aside(cell: Cell, run: Path) -> None:
    """Rename the folder of a training with other settings."""
    existing = checkpoints_in(run)
    if not existing:
        return
    config, trained = cell.config(), Checkpoint.open(existing[-1]).config
    if trained.changed_for_resume(config) or trained.total_frames > config.total_frames:
        number = 1
        while (old := run.with_name(f"{run.name}.old{number}")).exists():
            number += 1
        run.rename(old)


def _note_session(run: Path) -> list[dict[str, Any]]:
    """Add this process to those that worked on a run; return all of them."""
    run.mkdir(parents=True, exist_ok=True)
    path = run / SESSIONS
    # Written atomically, so it is whole if it is there.
    sessions = json.loads(path.read_text()) if path.exists() else []
    sessions.append({"began": provenance.now(), **provenance.commit()})
    files.write_text(path, json.dumps(sessions, indent=2) + "\n")
    return sessions


def _trained(cell: Cell, run: Path) -> Checkpoint:
    """The checkpoint at the end of the training."""
    config = cell.config()
    existing = checkpoints_in(run)
    newest = Checkpoint.open(existing[-1]) if existing else None
    complete = newest is not None and newest.frames >= config.total_frames
    if newest is None or not complete or newest.config.changed_for_resume(config):
        done = train(config, run, resume=(run / CONFIG_FILE).exists() or bool(existing))
        if done.interrupted:
            raise TrainingInterruptedError(
                f"{done.frames} of {config.total_frames} frames"
            )
        newest = Checkpoint.open(done.checkpoint)
    return newest


def _judged(cell: Cell, checkpoint: Checkpoint) -> dict[str, Any]:
    config, began = checkpoint.config, time.monotonic()
    other = cell.evaluation.get("task_kwargs", {})
    task = cell.evaluation.get("task", cell.task)
    options = {**protocol.published_options(config.task_kwargs), **other}
    arches = cell.evaluation.get("each_arch")
    observation = config.observation
    if arches is not None:
        judgement = protocol.judge_each_arch(
            checkpoint,
            task,
            arches,
            observation=observation,
            task_kwargs=options,
            name=cell.name,
        )
    else:
        judgement = protocol.judge(
            checkpoint,
            task,
            observation=observation,
            task_kwargs=options,
            episodes=cell.episodes,
            name=cell.name,
            num_threads=config.num_threads,
        )
    evaluation = judgement.result
    run = checkpoint.path.parents[1]
    write_evaluation(run, evaluation.to_dict())
    return {
        "task": evaluation.task,
        "seed": evaluation.seed,
        "settings": dict(evaluation.settings),
        "seconds": round(time.monotonic() - began, 1),
        "summary": evaluation.summary(),
        "episodes": result.episode_figures(evaluation),
        "groups": judgement.groups,
        "force_map": result.map_values(judgement.contacts),
    }


def _training(
    run: Path, checkpoint: Checkpoint, sessions: list[dict[str, Any]]
) -> dict[str, Any]:
    rows = read_metrics(run / "metrics.csv")
    return {
        "frames": checkpoint.frames,
        "seconds": round(checkpoint.seconds, 1),
        "solved": result.solved(rows),
        "curve": result.learning_curve(rows),
        "sessions": sessions,
        "load": provenance.load(),
    }
