"""The files of evaluations that `cathsim eval` and `evaluate` write."""

import functools
import json
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from cathsim_dmc import bounds, files
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.analysis.force_statistics import (
    QUANTITIES,
    STATISTICS,
    EpisodeForces,
    Statistics,
)

FILE = "evaluation.json"
WHICH = ("policy", "baseline")
_WANTED = (
    f"an {FILE} that `cathsim eval --out` or `agents.evaluate(out_dir=...)` has written"
)
_WRONG = LookupError, TypeError, ValueError, AttributeError, RecursionError


def write(path: Path, values: Mapping[str, Any]) -> None:
    """Writes a file, or keeps it elsewhere where that fails, see `write_result`."""
    files.write_result(
        path, functools.partial(files.write_json, values=values), "the evaluation"
    )


def read(path: str | Path) -> dict[str, dict[str, Any]]:
    """Returns the attributes of the `EvaluationResult`s in a file.

    Args:
        path: File, or folder with an `evaluation.json`.

    Returns:
        Those of the "policy" and, where the file has one, of the "baseline".

    Raises:
        ValueError: the file holds no evaluation; says what is wrong.
        OSError: there is no such file.
    """
    path = files.as_path("path", path)
    if path.is_dir():
        path = path / FILE
    files.require_source(path, _WANTED)
    with files.refused(ValueError, f"{path} is no evaluation; give {_WANTED}", _WRONG):
        values = bounds.instance("its content", json.loads(files.read_text(path)), dict)
        if "episodes" in values:  # of `evaluate`; the command adds a level
            values = {"policy": values}
        elif not {*WHICH} & {*values}:
            raise ValueError(
                f"it has the entries {bounds.shown(sorted(values))}, and neither "
                "episodes nor a policy"
            )
        return {name: _attributes(values[name]) for name in WHICH if name in values}


def _attributes(values: Mapping[str, Any]) -> dict[str, Any]:
    bounds.instance("the evaluation", values, dict)
    rows = bounds.instance("episodes", values["episodes"], list)
    if not rows:
        raise ValueError("it has no episodes")
    for row in rows:
        bounds.instance("an episode", row, dict)
    drawn = tuple(row["conditions"] for row in rows if "conditions" in row)
    if len(drawn) not in (0, len(rows)):
        raise ValueError(f"{len(drawn)} of {len(rows)} episodes have conditions")
    settings = bounds.instance("settings", values["settings"], dict)
    bounds.instance("task_kwargs", settings.get("task_kwargs", {}), dict)
    bounds.instance("lumens", settings.get("lumens", []), list)
    return {
        "task": bounds.text("task", values["task"]),
        "policy": bounds.text("policy", values["policy"]),
        "seeds": tuple(bounds.seed("seed", row["seed"]) for row in rows),
        "episodes": tuple(outcome(row, _figure) for row in rows),
        "settings": settings,
        "distinct": bounds.switch("distinct", values["distinct"]),
        "conditions": tuple(bounds.instance("conditions", x, dict) for x in drawn),
        "versions": bounds.instance("versions", values.get("versions", {}), dict),
    }


def _figure(name: str, value: Any, low: float = -math.inf) -> float:
    """Returns a number; an environment may have given one that is not finite."""
    if isinstance(value, float) and not math.isfinite(value):
        return value
    return bounds.number(name, value, low)


def outcome(
    row: Mapping[str, Any], number: Callable[..., float] = bounds.number
) -> EpisodeOutcome:
    """Returns an episode from its entry in a file.

    Args:
        row: Entry of the list `episodes`.
        number: Check of a figure: name, value and, for some, the least one.

    Raises:
        ValueError, LookupError, TypeError: an entry is missing or impossible.
    """
    forces = bounds.instance("forces", row["forces"], dict)
    known = {name: forces.get(name) for name in QUANTITIES}
    switches = "terminated", "success", "physics_error"
    began = row.get("start_insertion")  # not in files from before 0.3
    return EpisodeOutcome(
        env=bounds.whole("env", row["env"], 0),
        reward=number("reward", row["reward"]),
        length=bounds.whole("length", row["length"], 1),
        forces=EpisodeForces(
            **{
                name: _statistics(name, one, number)
                for name, one in known.items()
                if one is not None
            }
        ),
        path_ratio=number("path_ratio", row["path_ratio"], 0.0),
        # Older files count episodes that the objective ended as given up.
        failed=bounds.switch("failed", row.get("failed", False)),
        start_insertion=None if began is None else number("start_insertion", began),
        **{name: bounds.switch(name, row[name]) for name in switches},
    )


def _statistics(
    quantity: str, given: Mapping[str, Any], number: Callable[..., float]
) -> Statistics:
    found: dict[str, Any] = {}
    for name in STATISTICS:
        value = given[name]
        if not (value is None and name == "mean_in_contact"):
            value = number(f"forces.{quantity}.{name}", value, 0.0)
        found[name] = value
    return Statistics(**found)


def found_in(paths: Iterable[str | Path]) -> list[Path]:
    """Returns the files of evaluations among files and folders, without repetitions.

    Args:
        paths: Files in any order, and folders, which are searched with their folders.

    Raises:
        ValueError: there is no list of paths.
        FileNotFoundError: a folder holds no evaluation.
    """
    found: dict[Path, None] = {}
    for one in bounds.several("paths", paths, "a list of at least one file or folder"):
        path = files.as_path("a path", one)
        inside = sorted(path.rglob(FILE)) if path.is_dir() else [path]
        if not inside:
            raise FileNotFoundError(f"no {FILE} in the folder {path}; give {_WANTED}")
        found |= dict.fromkeys(inside)
    return list(found)
