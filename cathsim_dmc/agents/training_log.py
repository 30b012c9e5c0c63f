"""Figures of a training run: metrics.csv and progress."""

import csv
import io
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path

import numpy as np

from cathsim_dmc import files
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.agents.progress import progress_bar

# Number of finished episodes over which the running figures are taken.
EPISODE_WINDOW = 100

# Columns of metrics.csv that are means over the last episodes, and what they are of.
_FIGURES = {
    "episode_reward": "reward",
    "episode_length": "length",
    "success": "success",
    "mean_force": "forces.mean_force",
    "max_force": "forces.max_force",
}
_VALUES = attrgetter(*_FIGURES.values())
# The rest of metrics.csv's columns are the learner's own.
_COUNTS = ("frames", "seconds", "frames_per_second", "episodes")
COLUMNS = (*_COUNTS, *_FIGURES, "step_reward")


class TrainingLog:
    """Counts frames, episodes and seconds of a run and writes them down.

    Attributes:
        frames: Number of frames so far, over all processes of the run.
        episodes: Number of finished episodes likewise.
        window: Figures of the last `EPISODE_WINDOW` of these.
        row: Last row of metrics.csv that was written; empty before the first.
    """

    def __init__(
        self,
        run: Path,
        config: TrainingConfig,
        metrics: Sequence[str],
        *,
        frames: int,
        seconds: float,
        episodes: int,
        window: Iterable[Sequence[float | None]],
        resumed: bool,
        progress: bool,
    ):
        """Opens the files, shows the progress and starts the clock.

        Args:
            metrics: Names of the learner's own figures.
            frames: Number of frames that earlier processes of the run have seen.
            progress: Whether to show progress on standard error.
        """
        self.frames, self.episodes = frames, episodes
        self.row: dict[str, float | None] = {}
        self.window = deque(map(list, window), maxlen=EPISODE_WINDOW)
        self._interval = config.metrics_frames
        self._path, self._columns = run / "metrics.csv", [*COLUMNS, *metrics]
        # A killed run has rows beyond its checkpoint.
        rows = _texts(self._path) if resumed and self._path.exists() else []
        self._rows: list[dict] = [r for r in rows if int(r["frames"]) <= frames]
        self._write()
        self._bar = progress_bar(
            f"{config.algorithm} {config.task}",
            " frames",
            total=config.total_frames,
            initial=frames,
            disable=not progress,
        )
        self._frames_before, self._seconds_before = frames, seconds
        self._began = time.monotonic()

    def close(self) -> None:
        """Closes the progress bar."""
        self._bar.close()

    @property
    def seconds(self) -> float:
        """Wall time of the run so far, over all its processes."""
        return self._seconds_before + time.monotonic() - self._began

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
            losses: Figures of the learner's update.
            last: Whether no other batch follows, so that a row is due anyway.
        """
        before, self.frames = self.frames, self.frames + frames
        self.episodes += len(finished)
        self.window.extend(
            [v if v is None else float(v) for v in _VALUES(episode)]
            for episode in finished
        )
        means = _episode_means(self.window)
        if last or crossed(before, self.frames, self._interval):
            seconds = self.seconds
            elapsed = seconds - self._seconds_before
            self.row = {
                "frames": self.frames,
                "seconds": seconds,
                "frames_per_second": (self.frames - self._frames_before) / elapsed,
                "episodes": self.episodes,
                **means,
                "step_reward": step_reward,
                **losses,
            }
            texts = {
                name: f"{value:.9g}" if isinstance(value, float) else value
                for name, value in self.row.items()
            }
            self._rows.append(texts)
            self._write()
        shown = {"step_reward": step_reward, **means}
        self._bar.set_postfix(
            {name: value for name, value in shown.items() if value is not None},
            refresh=False,
        )
        self._bar.update(frames)

    def _write(self) -> None:
        text = io.StringIO()
        # An older version may have had other columns.
        writer = csv.DictWriter(
            text, self._columns, extrasaction="ignore", lineterminator="\n"
        )
        writer.writeheader()
        writer.writerows(self._rows)
        files.write_text(self._path, text.getvalue())


def _texts(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return [row for row in csv.DictReader(file) if None not in row.values()]


def read_metrics(path: Path) -> list[dict[str, float | None]]:
    """The rows of a metrics.csv; empty fields become None."""
    return [
        {name: float(cell) if cell else None for name, cell in row.items()}
        for row in _texts(path)
    ]


def crossed(before: int, after: int, interval: int) -> bool:
    """Whether a multiple of `interval` lies in (before, after]."""
    return before // interval != after // interval


def _episode_means(window: Iterable[Sequence[float | None]]) -> dict[str, float | None]:
    """Means over the last finished episodes; None where nothing is known."""
    means: dict[str, float | None] = dict.fromkeys(_FIGURES)
    for name, values in zip(_FIGURES, zip(*window, strict=True), strict=False):
        known = [value for value in values if value is not None]
        means[name] = float(np.mean(known)) if known else None
    return means
