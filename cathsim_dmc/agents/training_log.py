"""Figures of a training run: metrics.csv, a logger and progress."""

import csv
import io
import sys
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cathsim_dmc import files
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.agents.learner import Learner
from cathsim_dmc.agents.loggers import FigureLogger

# Seconds between two lines of progress in a log file, where no terminal redraws them.
LINE_INTERVAL = 15.0
_LINE = "{desc}: {n_fmt}{unit} [{elapsed}, {rate_fmt}{postfix}]\n"
# Number of finished episodes over which the running figures are taken.
EPISODE_WINDOW = 100

# Columns of metrics.csv that are means over these episodes, with the attributes of
# `EpisodeOutcome`.
_FIGURES = {
    "episode_reward": "reward",
    "episode_length": "length",
    "success": "success",
    "mean_force": "forces.mean_force",
    "max_force": "forces.max_force",
}
_VALUES = attrgetter(*_FIGURES.values())
# The rest of metrics.csv's columns are the learner's own.
COLUMNS = (
    "frames", "seconds", "frames_per_second", "episodes", *_FIGURES, "step_reward",
)  # fmt: skip


class TrainingLog:
    """Counts frames, episodes and seconds of a run and writes metrics.csv.

    Attributes:
        frames: Number of frames so far, over all processes of the run.
        episodes: Number of finished episodes likewise.
        window: Figures of the last `EPISODE_WINDOW` episodes.
        row: Last row of metrics.csv; empty before the first.
        bar: Progress bar.
    """

    def __init__(
        self, run: Path, learner: Learner, state: Mapping[str, Any], progress: bool
    ):
        """Opens the files, shows the progress and starts the clock.

        Args:
            state: Counts of earlier processes of the run: "frames", "seconds",
                "episodes", and the figures ("window") of the last episodes.
            progress: Whether to show progress on standard error.
        """
        config: TrainingConfig = learner.config
        self.frames, self.episodes = state["frames"], state["episodes"]
        self.window = deque(map(list, state["window"]), maxlen=EPISODE_WINDOW)
        self._interval = config.metrics_frames
        self._path, self._columns = run / "metrics.csv", [*COLUMNS, *learner.metrics]
        # A killed run has rows beyond its checkpoint.
        rows = read_metrics(self._path)
        self._rows = [r for r in rows if (r["frames"] or 0) <= self.frames]
        self.row = dict(self._rows[-1]) if self._rows else {}
        self._write()
        self._logger = FigureLogger(config.logger, run, self._rows)
        self.bar = progress_bar(
            f"{config.algorithm} {config.task}", " frames", total=config.total_frames,
            initial=self.frames, disable=not progress,
        )  # fmt: skip
        self._before, self._began = state, time.monotonic()

    def close(self) -> None:
        """Close the logger and the progress bar."""
        self.bar.close()
        self._logger.close()

    @property
    def seconds(self) -> float:
        """Wall time of the run so far, over all its processes."""
        return self._before["seconds"] + time.monotonic() - self._began

    def add(
        self,
        frames: int,
        finished: Sequence[EpisodeOutcome],
        step_reward: float,
        losses: Mapping[str, float],
        last: bool,
    ) -> None:
        """Logs a batch.

        Args:
            frames: Number of frames of the batch.
            finished: Episodes that ended in it.
            step_reward: Mean reward of its control steps.
            losses: Figures of the learner's update.
            last: Whether this is the last batch, which always gets a row.
        """
        before, self.frames = self.frames, self.frames + frames
        self.episodes += len(finished)
        for episode in finished:
            self.window.append([v if v is None else float(v) for v in _VALUES(episode)])
        means = {**_episode_means(self.window), "step_reward": step_reward}
        if last or crossed(before, self.frames, self._interval):
            new, seconds = self.frames - self._before["frames"], self.seconds
            self.row = {
                "frames": self.frames,
                "seconds": seconds,
                "frames_per_second": new / (seconds - self._before["seconds"]),
                "episodes": self.episodes,
                **means,
                **losses,
            }
            self._rows.append(self.row)
            self._write()
            self._logger.show(self.row)
        known = {name: value for name, value in means.items() if value is not None}
        self.bar.set_postfix(known, refresh=False)
        self.bar.update(frames)

    def _write(self) -> None:
        text = io.StringIO()
        # An older version may have had other columns.
        writer = csv.DictWriter(
            text, self._columns, extrasaction="ignore", lineterminator="\n"
        )
        writer.writeheader()
        for cells in map(dict.items, self._rows):
            writer.writerow({n: v if v is None else f"{v:.9g}" for n, v in cells})
        files.write_text(self._path, text.getvalue())


def progress_bar(label: str, unit: str, **options: Any) -> tqdm:
    """Return tqdm's bar on standard error; a log file gets a line every 15 s."""
    terminal = sys.stderr.isatty()
    interval = 0.1 if terminal else LINE_INTERVAL
    return tqdm(
        desc=label, unit=unit, mininterval=interval, maxinterval=max(interval, 10.0),
        dynamic_ncols=terminal, bar_format=None if terminal else _LINE, **options,
    )  # fmt: skip


def read_metrics(path: Path) -> list[dict[str, float | None]]:
    """Return the complete rows of a metrics.csv, none if missing; or ConfigError."""
    if not path.exists():
        return []
    text, wrong = f"{path} holds no metrics; mend or remove it", (ValueError, csv.Error)
    with files.refused(ConfigError, text, wrong), open(path, newline="") as file:
        rows = csv.DictReader(file)
        if "frames" not in (rows.fieldnames or ()):
            raise ValueError("it has no column frames")
        return [
            {name: float(cell) if cell else None for name, cell in row.items()}
            for row in rows
            if None not in row.values() and None not in row
        ]


def crossed(before: int, after: int, interval: int) -> bool:
    """Whether a multiple of `interval` lies in (before, after]."""
    return before // interval != after // interval


def _episode_means(window: Iterable[Sequence[float | None]]) -> dict[str, float | None]:
    """Return the means over the last finished episodes; None where unknown."""
    means: dict[str, float | None] = dict.fromkeys(_FIGURES)
    # An empty window has no columns.
    for name, column in zip(_FIGURES, zip(*window, strict=True), strict=False):
        known = [value for value in column if value is not None]
        means[name] = float(np.mean(known)) if known else None
    return means
