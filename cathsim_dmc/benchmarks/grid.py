"""A grid of trainings, read from a TOML file: one cell for each task and seed."""

import dataclasses
import fnmatch
import json
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cathsim_dmc import files
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.fields import require_type
from cathsim_dmc.agents.learners import make_config

DEFAULT_GRID = Path(__file__).with_name("grid.toml")
EPISODES = 30  # published
_MAX_SIZE = 2**20  # bytes
# Names of cells are names of folders and files.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+.-]{0,199}")
# What a row must and may say, and its evaluation, with the type of each.
_REQUIRED = {"label": str, "algorithm": str, "preset": str, "observation": str | list}
_REQUIRED |= {"tasks": list, "total_frames": int | dict}
_ROW = {
    "seeds": list,
    "settings": dict,
    "variant": str,
    "evaluation": dict,
    **_REQUIRED,
}
_OWN = {"task", "observation", "seed", "total_frames"}  # fields that a cell sets
_EVALUATION = {"task": str, "episodes": int, "task_kwargs": dict, "each_arch": str}


class GridError(ValueError):
    """A grid file says something that cannot be."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """One training with its evaluation.

    Attributes:
        label: Name of the row of the table, such as "PPO, internal".
        task: Name of the task.
        algorithm: Name of the algorithm.
        preset: Name of its preset.
        observation: Name or names of the observations.
        seed: Seed of networks, exploration and environments.
        total_frames: Number of control steps to train for.
        settings: Further fields of the algorithm's settings; `task_kwargs` in them
            are added to those of the preset, and `{task}` in a string stands for the
            name of the task.
        variant: Further part of the name, for two rows that differ in settings only.
        evaluation: What differs from the published evaluation: `task`, `episodes`,
            `task_kwargs`; or `each_arch`, a set of random arches to play one episode
            each in.
    """

    label: str
    task: str
    algorithm: str
    preset: str
    observation: str | tuple[str, ...]
    seed: int
    total_frames: int
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    variant: str = ""
    evaluation: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        """Refuse a name that could lie outside of its folder, as GridError."""
        if not _NAME.fullmatch(self.name):
            raise GridError(
                f"a cell is named {self.name[:250]!r}; task, algorithm, observation, "
                "preset and variant may have letters, digits and _ + - . and together "
                "200 characters"
            )

    @property
    def name(self) -> str:
        """Name of its folder and its JSON file."""
        observation = self.observation
        if not isinstance(observation, str):
            observation = "+".join(observation)
        parts = (self.task, self.algorithm, observation, self.preset, self.variant)
        return "-".join(part for part in (*parts, f"seed{self.seed}") if part)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values, with the name."""
        return json.loads(json.dumps({"name": self.name, **dataclasses.asdict(self)}))

    def config(self) -> TrainingConfig:
        """Settings of the training.

        Raises:
            ConfigError: unknown algorithm, preset or field, or a value not allowed.
        """
        settings = dict(self.settings)
        for name, value in settings.items():
            if isinstance(value, str):
                settings[name] = value.replace("{task}", self.task)
        added = settings.pop("task_kwargs", {})
        require_type("task_kwargs", added, Mapping[str, Any])
        for name in ("task", "observation", "seed", "total_frames"):
            settings[name] = getattr(self, name)
        config = make_config(self.algorithm, self.preset, **settings)
        return config.replace(task_kwargs={**config.task_kwargs, **added})


def read_grid(path: str | Path = DEFAULT_GRID) -> list[Cell]:
    """The cells of a grid file, in the order in which they are to be run.

    Rows follow each other as in the file; within a row the first seed of every task
    comes before the second seed of any.

    Args:
        path: Path of a TOML file with tables `[[row]]`; the default is the grid of
            docs/results.md.

    Raises:
        GridError: it cannot be read, or a row says something that cannot be.
    """
    path, cells = Path(path), {}
    try:
        values = tomllib.loads(files.read_text(path, _MAX_SIZE, "a grid"))
    except (OSError, ValueError, RecursionError) as error:
        raise GridError(f"{path} cannot be read as a grid: {error}") from error
    rows = values.pop("row", None)
    if values or not isinstance(rows, list) or not rows:
        raise GridError(
            f"{path} has {', '.join(values) or 'no row'}; a grid is a list of tables "
            "[[row]] and nothing else"
        )
    for number, row in enumerate(rows, 1):
        try:
            for cell in _cells(row):
                if cell.name in cells:
                    raise GridError(f"{cell.name} is there already; give a variant")
                cells[cell.name] = cell
        except GridError as error:
            raise GridError(f"{path}, row {number}: {error}") from error
    return list(cells.values())


def choose(cells: Sequence[Cell], patterns: Iterable[str]) -> list[Cell]:
    """Those cells whose name one of the patterns fits; all without a pattern.

    Args:
        cells: Cells to choose from.
        patterns: Parts of names, or whole names with `*` and `?`.

    Raises:
        GridError: a pattern fits none; lists the names.
    """
    chosen = (
        {cell.name for cell in cells} if not (patterns := list(patterns)) else set()
    )
    for pattern in patterns:
        whole = pattern if set(pattern) & set("*?[") else f"*{pattern}*"
        fits = {c.name for c in cells if fnmatch.fnmatchcase(c.name, whole)}
        if not fits:
            names = ", ".join(cell.name for cell in cells)
            raise GridError(f"no cell fits {pattern!r}; there are {names}")
        chosen |= fits
    return [cell for cell in cells if cell.name in chosen]


def _cells(row: Any) -> list[Cell]:
    _check(row, _ROW)
    if missing := sorted(set(_REQUIRED) - set(row)):
        raise GridError(f"there is no {', '.join(missing)}")
    row = {"seeds": [0], "evaluation": {}, **row}
    if own := sorted(_OWN & set(row.get("settings", {}))):
        raise GridError(f"settings has {', '.join(own)}, which the row itself gives")
    _check(row["evaluation"], _EVALUATION)
    if row["evaluation"].get("episodes", 1) < 1:
        raise GridError("evaluation.episodes must be at least 1")
    if {"episodes", "each_arch"} <= set(row["evaluation"]):
        raise GridError("evaluation has episodes and each_arch; give one")
    names = row["observation"]
    observation = names if isinstance(names, str) else tuple(names)
    tasks, seeds, frames = (row.pop(key) for key in ("tasks", "seeds", "total_frames"))
    for name, given, kind in (
        ("tasks", tasks, str),
        ("seeds", seeds, int),
        ("observation", [names] if isinstance(names, str) else names, str),
    ):
        if not given or any(type(one) is not kind for one in given):
            raise GridError(f"{name} is {given!r}; it must list {kind.__name__}s")
    cells = []
    for seed in seeds:
        for task in tasks:
            total = frames.get(task) if isinstance(frames, dict) else frames
            if type(total) is not int or total < 1:
                raise GridError(
                    f"total_frames of {task} is {total!r}; it must be a positive "
                    "integer, or a table with one for each task"
                )
            own = {"task": task, "seed": seed, "total_frames": total}
            cells.append(Cell(**{**row, **own, "observation": observation}))
    return cells


def _check(table: Any, known: Mapping[str, Any]) -> None:
    """Refuse a table with other keys or types."""
    if not isinstance(table, dict):
        raise GridError(f"{table!r} must be a table")
    for name, value in table.items():
        if name not in known:
            raise GridError(f"{name} is unknown; there are {', '.join(known)}")
        if isinstance(value, bool) or not isinstance(value, known[name]):
            kind = getattr(known[name], "__name__", known[name])
            raise GridError(f"{name} is {value!r}; it must be {kind}")
