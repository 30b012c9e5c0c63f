"""A grid of trainings, read from a TOML file: one cell for each task and seed."""

import dataclasses
import fnmatch
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cathsim_dmc import files
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.fields import check_fields, positive, require, require_type
from cathsim_dmc.agents.learners import make_config

DEFAULT_GRID = Path(__file__).with_name("grid.toml")
EPISODES = 30  # published
_MAX_SIZE = 2**20  # bytes
# Names of cells are names of folders and files.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+.-]{0,199}")
_OWN = {"task", "observation", "seed", "total_frames"}  # fields that a cell sets


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
        for name in _OWN:
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
            for cell in _Row(**row).cells():
                if cell.name in cells:
                    raise GridError(f"{cell.name} is there already; give a variant")
                cells[cell.name] = cell
        except (TypeError, ValueError) as error:
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Evaluation:
    """The evaluation of a row, see `Cell.evaluation`."""

    task: str | None = None
    episodes: int | None = positive(None)
    task_kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    each_arch: str | None = None

    def __post_init__(self):
        check_fields(self)
        if self.episodes and self.each_arch:
            raise GridError("evaluation has episodes and each_arch; give one")


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Row:
    """A table of the file, one cell for each task and seed."""

    label: str
    algorithm: str
    preset: str
    observation: str | tuple[str, ...]
    tasks: tuple[str, ...]
    total_frames: int | Mapping[str, int]
    seeds: tuple[int, ...] = (0,)
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    variant: str = ""
    evaluation: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        check_fields(self)
        _Evaluation(**self.evaluation)
        for name in ("tasks", "seeds", "observation"):
            value = getattr(self, name)
            require(bool(value), name, value, "a list with one entry or more")
        if own := sorted(_OWN & set(self.settings)):
            raise GridError(
                f"settings has {', '.join(own)}, which the row itself gives"
            )

    def cells(self) -> Iterator[Cell]:
        """The cells, the first seed of every task first."""
        shared = {n: v for n, v in vars(self).items() if n not in ("tasks", "seeds")}
        for seed in self.seeds:
            for task in self.tasks:
                total = self.total_frames
                if isinstance(total, Mapping):
                    total = total.get(task)
                if total is None or total < 1:
                    raise GridError(
                        f"total_frames of {task} is {total!r}; it must be a positive "
                        "integer, or a table with one for each task"
                    )
                own = {"task": task, "seed": seed, "total_frames": total}
                yield Cell(**{**shared, **own})
