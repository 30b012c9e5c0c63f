"""The cells of a grid, trained and evaluated one after the other."""

import os
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from cathsim_dmc.agents.checkpoint import Checkpoint, CheckpointError, checkpoints_in
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.evaluation import write_evaluation
from cathsim_dmc.agents.metrics import read_metrics
from cathsim_dmc.agents.training import CONFIG_FILE, train
from cathsim_dmc.benchmarks import protocol, result
from cathsim_dmc.benchmarks.grid import Cell

# What there is of a cell, and what became of it in a call of `run`.
FINISHED, OTHER, IMPOSSIBLE = "finished", "other settings", "impossible"
BEGUN, WAITING, FAILED, INTERRUPTED = "begun", "waiting", "failed", "interrupted"


class TrainingInterruptedError(RuntimeError):
    """A signal ended the training, which can be continued."""


def standing(cell: Cell, runs: Path, results: Path) -> tuple[str, int, str]:
    """What there is of a cell, from its files.

    Returns:
        State, number of frames that are trained and saved, and a remark. The state is
        "finished", "begun" (there is a checkpoint), "waiting", "other settings"
        (finished with others than the grid's) or "impossible" (settings that are not
        allowed).
    """
    path, remark = results / f"{cell.name}.json", ""
    try:
        cell.config()
        if path.exists():
            found = result.read_result(path)
            frames = found.training["frames"]
            asked = cell.to_dict()
            changed = [
                k for k in asked if k != "label" and found.cell.get(k) != asked[k]
            ]
            if changed:
                return OTHER, frames, f"{', '.join(changed)} differ; move {path} away"
            return FINISHED, frames, f"success {100 * found.success:.0f} %"
    except ConfigError as error:
        return IMPOSSIBLE, 0, str(error)
    except result.ResultError as error:
        remark = str(error)
    try:
        checkpoints = checkpoints_in(runs / cell.name)
        frames = Checkpoint.open(checkpoints[-1]).frames if checkpoints else 0
    except CheckpointError as error:
        frames, remark = 0, str(error)
    return BEGUN if frames else WAITING, frames, remark


def run(
    cells: Sequence[Cell],
    runs: Path,
    results: Path,
    say: Callable[[str], None] = print,
) -> dict[str, str]:
    """Run what is left of some cells, in their order.

    A cell that fails is reported and the next one begins. SIGINT and SIGTERM end the
    running training with a checkpoint, and the loop.

    Args:
        cells: Cells to run.
        runs: Directory with a folder for each training.
        results: Directory with a file for each finished cell.
        say: Function that is told what happens.

    Returns:
        What became of each cell that was begun, by name: "finished", "failed" or
        "interrupted".
    """
    outcomes: dict[str, str] = {}
    for cell in cells:
        state, frames, remark = standing(cell, runs, results)
        if state in (FINISHED, OTHER):
            say(f"{cell.name}: {state}, {remark}")
            continue
        say(f"{cell.name}: begins at {frames:,} of {cell.total_frames:,}")
        try:
            done = work(cell, runs, results)
        except TrainingInterruptedError as error:
            outcomes[cell.name] = INTERRUPTED
            say(f"{cell.name}: interrupted after {error}")
            break
        except (ValueError, OSError, RuntimeError, ArithmeticError) as error:
            outcomes[cell.name] = FAILED
            say(f"{cell.name}: failed, {type(error).__name__}: {error}")
        else:
            outcomes[cell.name] = FINISHED
            say(f"{cell.name}: finished, success {100 * done.success:.0f} %")
    return outcomes


def work(cell: Cell, runs: Path, results: Path) -> result.Result:
    """Train or continue a cell, evaluate it and write its file.

    Killed at any moment, it is simply called again: the training continues from its
    newest checkpoint, and the file of the cell appears whole or not at all.

    Args:
        cell: What to train.
        runs: Directory with a folder for each training.
        results: Directory with a file for each finished cell.

    Raises:
        TrainingInterruptedError: a signal ended the training.
        ConfigError: the settings are not allowed, or the folder holds a training with
            others.
        CheckpointError: the newest checkpoint is damaged.
    """
    config, folder = cell.config(), runs / cell.name
    checkpoint, began = _trained(config, folder), time.monotonic()
    judgement = protocol.judge_cell(cell, checkpoint)
    evaluation = judgement.result
    write_evaluation(folder, evaluation.to_dict())
    rows = read_metrics(folder / "metrics.csv")
    values = {
        "cell": cell.to_dict(),
        "config": config.to_dict(),
        "training": {
            "frames": checkpoint.frames,
            "seconds": round(checkpoint.seconds, 1),
            "solved": result.solved(rows),
            "curve": result.learning_curve(rows),
        },
        "evaluation": {
            "task": evaluation.task,
            "seed": evaluation.seed,
            "settings": dict(evaluation.settings),
            "seconds": round(time.monotonic() - began, 1),
            "summary": evaluation.summary(),
            "episodes": result.episode_figures(evaluation),
            "groups": judgement.groups,
            "force_map": result.map_values(judgement.contacts),
        },
        "versions": result.versions(),
        "commit": result.commit(),
        "machine": {"processor": platform.processor(), "cores": os.cpu_count()},
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    path = result.write_result(results / f"{cell.name}.json", values)
    return result.read_result(path)


def _trained(config: TrainingConfig, folder: Path) -> Checkpoint:
    """The checkpoint at the end of a training, which is continued if need be."""
    existing = checkpoints_in(folder)
    if existing:
        newest = Checkpoint.open(existing[-1])
        complete = newest.frames >= config.total_frames
        if complete and not newest.config.changed_for_resume(config):
            return newest
    done = train(config, folder, resume=(folder / CONFIG_FILE).exists())
    if done.interrupted:
        raise TrainingInterruptedError(f"{done.frames} of {config.total_frames} frames")
    return Checkpoint.open(done.checkpoint)
