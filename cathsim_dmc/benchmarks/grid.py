"""A grid of trainings, read from a TOML file: one cell for each task and seed."""

import dataclasses
import fnmatch
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.learners import make_config

DEFAULT_GRID = Path(__file__).with_name("grid.toml")
EPISODES = 30  # published
_MAX_SIZE = 2**20  # bytes
# Names of cells are names of folders and files.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+.-]{0,199}")

# What a row may say, with the type of each.
_Kinds = Mapping[str, tuple[type, ...]]
_ROW: _Kinds = {
    "label": (str,),
    "algorithm": (str,),
    "preset": (str,),
    "observation": (str, list),
    "tasks": (list,),
    "seeds": (list,),
    "total_frames": (int, dict),
    "settings": (dict,),
    "variant": (str,),
    "evaluation": (dict,),
}
_REQUIRED = ("label", "algorithm", "preset", "observation", "tasks", "total_frames")
_EVALUATION: _Kinds = {
    "task": (str,),
    "episodes": (int,),
    "task_kwargs": (dict,),
    "each_arch": (str,),
}
_WORDS = {str: "a string", int: "an integer", list: "a list", dict: "a table"}


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
        """Refuse a name that could lie outside of its folder.

        Raises:
            GridError: the name has a character that is not allowed, or is too long.
        """
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

    def config(self) -> TrainingConfig:
        """Settings of the training.

        Raises:
            ConfigError: unknown algorithm, preset or field, or a value not allowed.
        """
        settings: dict[str, Any] = {
            name: value.replace("{task}", self.task)
            if isinstance(value, str)
            else value
            for name, value in self.settings.items()
        }
        added = settings.pop("task_kwargs", {})
        config = make_config(
            self.algorithm,
            self.preset,
            **{
                **settings,
                "task": self.task,
                "observation": self.observation,
                "seed": self.seed,
                "total_frames": self.total_frames,
            },
        )
        return config.replace(task_kwargs={**config.task_kwargs, **added})

    @property
    def episodes(self) -> int:
        """Number of episodes of the evaluation."""
        return self.evaluation.get("episodes", EPISODES)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values, with the name."""
        values = {"name": self.name, **dataclasses.asdict(self)}
        if not isinstance(self.observation, str):
            values["observation"] = list(self.observation)
        return values


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
    path = Path(path)
    try:
        if path.stat().st_size > _MAX_SIZE:
            raise GridError(f"{path} is too long for a grid")
        values = tomllib.loads(path.read_text())
    except (OSError, ValueError) as error:
        if isinstance(error, GridError):
            raise
        raise GridError(f"{path} cannot be read as a grid: {error}") from error
    rows = values.pop("row", None)
    if values or not isinstance(rows, list) or not rows:
        raise GridError(
            f"{path} has {', '.join(values) or 'no row'}; a grid is a list of tables "
            "[[row]] and nothing else"
        )
    cells: list[Cell] = []
    for number, row in enumerate(rows, 1):
        try:
            cells += _cells(row)
        except GridError as error:
            raise GridError(f"{path}, row {number}: {error}") from error
    seen: set[str] = set()
    for cell in cells:
        if cell.name in seen:
            raise GridError(
                f"{path} has two cells {cell.name}; give one of the rows a variant"
            )
        seen.add(cell.name)
    return cells


def choose(cells: Sequence[Cell], patterns: Iterable[str]) -> list[Cell]:
    """Those cells whose name one of the patterns fits; all without a pattern.

    Args:
        cells: Cells to choose from.
        patterns: Parts of names, or whole names with `*` and `?`.

    Raises:
        GridError: a pattern fits none; lists the names.
    """
    patterns = list(patterns)
    if not patterns:
        return list(cells)
    chosen: set[str] = set()
    for pattern in patterns:
        whole = pattern if set(pattern) & set("*?[") else f"*{pattern}*"
        fits = {c.name for c in cells if fnmatch.fnmatchcase(c.name, whole)}
        if not fits:
            names = ", ".join(cell.name for cell in cells)
            raise GridError(f"no cell fits {pattern!r}; there are {names}")
        chosen |= fits
    return [cell for cell in cells if cell.name in chosen]


def _cells(row: Any) -> list[Cell]:
    _check_fields("the row", row, _ROW)
    missing = [name for name in _REQUIRED if name not in row]
    if missing:
        raise GridError(f"there is no {', '.join(missing)}")
    evaluation = row.get("evaluation", {})
    _check_fields("evaluation", evaluation, _EVALUATION)
    if evaluation.get("episodes", 1) < 1:
        raise GridError("evaluation.episodes must be at least 1")
    if {"episodes", "each_arch"} <= set(evaluation):
        raise GridError("evaluation has episodes and each_arch; give one")
    tasks, seeds = row["tasks"], row.get("seeds", [0])
    for name, given, kind in (("tasks", tasks, str), ("seeds", seeds, int)):
        if not given or any(type(one) is not kind for one in given):
            raise GridError(f"{name} is {given!r}; it must list {_WORDS[kind]}s")
    observation = row["observation"]
    if isinstance(observation, list) and any(type(o) is not str for o in observation):
        raise GridError(f"observation is {observation!r}; it must list strings")
    return [
        Cell(
            label=row["label"],
            task=task,
            algorithm=row["algorithm"],
            preset=row["preset"],
            observation=observation
            if isinstance(observation, str)
            else tuple(observation),
            seed=seed,
            total_frames=_frames(row["total_frames"], task),
            settings=row.get("settings", {}),
            variant=row.get("variant", ""),
            evaluation=evaluation,
        )
        for seed in seeds
        for task in tasks
    ]


def _frames(given: Any, task: str) -> int:
    frames = given.get(task) if isinstance(given, dict) else given
    if type(frames) is not int or frames < 1:
        raise GridError(
            f"total_frames is {given!r}; it must be a positive integer, or a "
            f"table with one for each task ({task} too)"
        )
    return frames


def _check_fields(what: str, given: Any, known: _Kinds) -> None:
    if not isinstance(given, dict):
        raise GridError(f"{what} is {given!r}; it must be a table")
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise GridError(
            f"{what} has {', '.join(unknown)}; there are {', '.join(known)}"
        )
    for name, value in given.items():
        if type(value) not in known[name]:
            words = " or ".join(_WORDS[kind] for kind in known[name])
            raise GridError(f"{name} is {value!r}; it must be {words}")
