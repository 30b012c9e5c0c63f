"""The JSON file of a finished cell."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import files
from cathsim_dmc.agents.training_log import EPISODE_WINDOW
from cathsim_dmc.analysis.force_statistics import FIGURES
from cathsim_dmc.analysis.heatmap import ForceMap

FORMAT = 2
POINTS = 200  # of the learning curve
SOLVED = 0.9  # success rate that "solved" stands for
_DIGITS = 6  # significant ones of a number in a list
_MAX_SIZE = 2**24  # bytes
# Columns of metrics.csv that make the learning curve, as far as they are there.
_CURVE = (
    "frames",
    "seconds",
    "episodes",
    "episode_reward",
    "episode_length",
    "success",
    "distance",
    "mean_force",
    "max_force",
)
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
        values: What is in it.
    """

    path: Path
    values: Mapping[str, Any]

    @property
    def cell(self) -> Mapping[str, Any]:
        """What was trained, see `grid.Cell`."""
        return self.values["cell"]

    @property
    def training(self) -> Mapping[str, Any]:
        """Frames, seconds, learning curve."""
        return self.values["training"]

    @property
    def evaluation(self) -> Mapping[str, Any]:
        """Task, summary, figures of every episode."""
        return self.values["evaluation"]

    @property
    def success(self) -> float:
        """Success rate of the evaluation."""
        return self.evaluation["summary"]["success"]

    @property
    def frames_per_second(self) -> float:
        """Speed of the training."""
        return self.training["frames"] / self.training["seconds"]


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
    result = Result(path, values)
    try:
        for rate in (result.success, result.frames_per_second):
            if not math.isfinite(rate):
                raise ValueError(f"{rate} is no rate")
        name = result.cell["name"]
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise ResultError(f"{path} is damaged: {type(error).__name__}: {error}") from (
            error
        )
    if name != path.stem:
        raise ResultError(f"{path} is named for another cell than the {name} it holds")
    return result


def write_result(path: Path, values: Mapping[str, Any]) -> Path:
    """Write a cell's file atomically, one line for each of its parts."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [
        f"{json.dumps(name)}: {json.dumps(value, allow_nan=False)}"
        for name, value in {"format": FORMAT, **values}.items()
    ]
    return files.write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


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
        episodes, success = row.get("episodes"), row.get("success")
        if episodes is None or success is None or row["frames"] is None:
            continue
        if episodes >= EPISODE_WINDOW and success >= SOLVED:
            return {"frames": row["frames"], "seconds": row["seconds"] or 0.0}
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
    mean, count = np.full(rows * columns, np.nan), np.zeros(rows * columns, np.int64)
    index = np.asarray(values["index"], dtype=np.int64)
    if not len(index) == len(values["mean"]) == len(values["count"]):
        raise ValueError("the lists of a force map differ in length")
    if len(index) and not 0 <= index.min() <= index.max() < rows * columns:
        raise ValueError("a force map has a cell outside of it")
    mean[index], count[index] = values["mean"], values["count"]
    return ForceMap(
        x_edges=np.linspace(values["x"][0], values["x"][1], columns + 1),
        z_edges=np.linspace(values["z"][0], values["z"][1], rows + 1),
        mean=mean.reshape(rows, columns),
        count=count.reshape(rows, columns),
        outside=values["outside"],
    )


def _numbers(values: Any) -> list[float | int | None]:
    """Numbers short enough for a file; whole ones as integers."""
    short = []
    for value in values:
        if value is not None and value == int(value):
            value = int(value)
        elif value is not None:
            value = float(f"{value:.{_DIGITS}g}")
        short.append(value)
    return short
