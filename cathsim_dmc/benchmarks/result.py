"""The JSON file of a finished cell."""

import json
import math
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import __version__, files
from cathsim_dmc.agents.training_log import EPISODE_WINDOW
from cathsim_dmc.analysis.force_statistics import FIGURES
from cathsim_dmc.analysis.heatmap import ForceMap

FORMAT = 2
POINTS = 200  # of the learning curve
SOLVED = 0.9  # success rate that "solved" stands for
_DIGITS = 6  # significant ones of a number in a list
_MAX_SIZE = 2**24  # bytes
_PACKAGES = ("mujoco", "dm-control", "torch", "torchrl", "tensordict", "numpy", "scipy")
# Columns of metrics.csv that make the learning curve, as far as they are there.
_CURVE = ("frames", "seconds", "episodes", "episode_reward", "episode_length")
_CURVE += ("success", "distance", "mean_force", "max_force")
# Figures of every episode: attributes of `EpisodeOutcome`, and of its `forces`.
_EPISODE = ("reward", "length", "success", "physics_error", "path_ratio")
_PARTS = ("cell", "config", "training", "evaluation", "versions", "machine")


class ResultError(ValueError):
    """The file of a result is missing, damaged or of another kind."""


@dataclass(frozen=True)
class Result:
    """A finished cell, as its file tells it.

    Attributes:
        path: Path of the file.
        values: All that is in it, by part.
        cell: What was trained, see `grid.Cell`.
        training: Frames, seconds, learning curve.
        evaluation: Task, summary, figures of every episode.
        success: Success rate of the evaluation.
        frames_per_second: Speed of the training.
    """

    path: Path
    values: Mapping[str, Any]
    cell: Mapping[str, Any]
    training: Mapping[str, Any]
    evaluation: Mapping[str, Any]
    success: float
    frames_per_second: float


def read_result(path: str | Path) -> Result:
    """Read the file of a cell.

    Raises:
        ResultError: it is missing or damaged; the message names it.
    """
    path = Path(path)
    try:
        values = files.read_json(path, _MAX_SIZE, "a result")
    except ValueError as error:
        raise ResultError(str(error)) from error
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise ResultError(f"{path} is no result of format {FORMAT}")
    missing = [name for name in _PARTS if not isinstance(values.get(name), dict)]
    if missing:
        raise ResultError(f"{path} lacks {', '.join(missing)}")
    cell, training, evaluation = (values[part] for part in ("cell", *_PARTS[2:4]))
    try:
        success = float(evaluation["summary"]["success"])
        speed = training["frames"] / training["seconds"]
        if not math.isfinite(success + speed) or cell["name"] != path.stem:
            raise ValueError(f"rates {success}, {speed} of the cell {cell['name']}")
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise ResultError(f"{path} is damaged: {type(error).__name__}: {error}") from (
            error
        )
    return Result(path, values, cell, training, evaluation, success, speed)


def write_result(path: Path, values: Mapping[str, Any]) -> Path:
    """Write a cell's file atomically, one line for each of its parts."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [
        f"{json.dumps(name)}: {json.dumps(value, allow_nan=False)}"
        for name, value in {"format": FORMAT, **values}.items()
    ]
    return files.write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


def versions() -> dict[str, str]:
    """Versions of Python, this package and those that results depend on."""
    own = {"python": platform.python_version(), "cathsim-dmc": __version__}
    return own | {name: version(name) for name in _PACKAGES}


def commit() -> str | None:
    """Commit of the source tree, with "+" if files differ; None outside of git."""
    git = ["git", "-C", str(Path(__file__).parent)]
    head = [*git, "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
    try:
        # An installed package may lie in a repository that does not know it.
        for command in ([*git, "ls-files", "--error-unmatch", "grid.py"], head):
            done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def learning_curve(rows: Sequence[Mapping[str, float | None]]) -> dict[str, list]:
    """At most `POINTS` rows of metrics.csv, evenly spread, the last among them.

    Returns:
        Columns by name, None where a value is not known.
    """
    if not rows:
        return {}
    count = min(len(rows), POINTS)
    chosen = np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int))
    columns = [name for name in _CURVE if name in rows[0]]
    return {name: _numbers(rows[i][name] for i in chosen) for name in columns}


def solved(rows: Sequence[Mapping[str, float | None]]) -> dict[str, float] | None:
    """Frames and seconds at which the success of training episodes reached `SOLVED`.

    It is the mean over the last 100 finished episodes, so the first 100 are passed
    over: those that end early are the successful ones. None if it never did.
    """
    for row in rows:
        enough = (row.get("episodes") or 0) >= EPISODE_WINDOW
        if enough and (row.get("success") or 0.0) >= SOLVED:
            return {"frames": row["frames"] or 0.0, "seconds": row["seconds"] or 0.0}
    return None


def episode_figures(evaluation: Any) -> dict[str, list]:
    """Figures of every episode of an `EvaluationResult`, in the order of the seeds."""
    names = {name: name for name in _EPISODE} | {f: f"forces.{f}" for f in FIGURES}
    return {
        name: _numbers(
            None if np.isnan(v) else float(v) for v in evaluation.values(attribute)
        )
        for name, attribute in names.items()
    }


def map_values(contacts: ForceMap | None) -> dict[str, Any] | None:
    """A force map as JSON: only cells with contacts, row after row from below."""
    if contacts is None:
        return None
    index = np.flatnonzero(contacts.count)
    return {
        "x": [float(contacts.x_edges[0]), float(contacts.x_edges[-1])],
        "z": [float(contacts.z_edges[0]), float(contacts.z_edges[-1])],
        "shape": list(contacts.count.shape),
        "index": index.tolist(),
        "mean": _numbers(map(float, contacts.mean.ravel()[index])),
        "count": contacts.count.ravel()[index].tolist(),
        "outside": contacts.outside,
    }


def map_from_values(values: Mapping[str, Any]) -> ForceMap:
    """The inverse of `map_values`.

    Raises:
        ValueError: lengths differ, or an index lies outside.
    """
    rows, columns = values["shape"]
    (left, right), (low, high) = values["x"], values["z"]
    mean, count = np.full((rows, columns), np.nan), np.zeros((rows, columns), np.int64)
    index = np.unravel_index(np.asarray(values["index"], np.int64), mean.shape)
    mean[index], count[index] = values["mean"], values["count"]
    return ForceMap(
        x_edges=np.linspace(left, right, columns + 1),
        z_edges=np.linspace(low, high, rows + 1),
        mean=mean,
        count=count,
        outside=values["outside"],
    )


def _numbers(values: Any) -> list[float | int | None]:
    """Numbers short enough for a file; whole ones as integers."""
    return [
        v if v is None else int(v) if v == int(v) else float(f"{v:.{_DIGITS}g}")
        for v in values
    ]
