"""Progress of a run: a bar on a terminal, a line now and then in a log."""

import sys
import time
from collections.abc import Mapping
from typing import Any, TextIO

import numpy as np

# Seconds between two lines where there is no terminal to redraw.
LINE_INTERVAL = 15.0


class Progress:
    """Shows frames, speed and a few figures on standard error.

    Standard output stays free, so that commands can print JSON there.

    Args:
        label: what is running.
        total: frames at the end.
        start: frames already done when this process began.
        enabled: False shows nothing.
        stream: where to write; standard error by default.
    """

    def __init__(
        self,
        label: str,
        total: int,
        start: int = 0,
        enabled: bool = True,
        stream: TextIO | None = None,
    ):
        self.label = label
        self.total = total
        self.start = start
        self.enabled = enabled
        self.stream = sys.stderr if stream is None else stream
        self.began = self.last_line = time.monotonic()
        self.bar = None
        self.last_text = ""

    def __enter__(self) -> "Progress":
        """Draw the bar, or say in a line that the run begins."""
        if self.enabled and self.stream.isatty():
            self._open_bar()
        elif self.enabled:
            self._line(f"{self.label}: {self.start:,}/{self.total:,} frames, starting")
        return self

    def __exit__(self, *exception: object) -> None:
        """Leave the last state on the screen."""
        if self.bar is not None:
            self.bar.stop()
        elif self.enabled and self.last_text:
            self._line(self.last_text)

    def update(self, frames: int, figures: Mapping[str, float | None]) -> None:
        """Show the frame counter and named figures; None is left out."""
        if not self.enabled:
            return
        shown = {name: value for name, value in figures.items() if value is not None}
        text = "  ".join(f"{name} {value:.3g}" for name, value in shown.items())
        if self.bar is not None:
            self.bar.update(self.task, completed=frames, figures=text)
            return
        now = time.monotonic()
        speed = (frames - self.start) / max(now - self.began, 1e-9)
        left = max(self.total - frames, 0) / speed if speed > 0 else 0.0
        self.last_text = (
            f"{self.label}: {frames:,}/{self.total:,} frames "
            f"({min(100 * frames // self.total, 100)} %)  {speed:,.0f}/s  "
            f"{_clock(left)} left  {text}"
        )
        if now - self.last_line >= LINE_INTERVAL:
            self._line(self.last_text)
            self.last_line = now
            self.last_text = ""

    def _line(self, text: str) -> None:
        print(text, file=self.stream, flush=True)

    def _open_bar(self) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            TextColumn,
            TimeRemainingColumn,
        )
        from rich.progress import Progress as Bar

        self.bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[figures]}"),
            console=Console(file=self.stream),
        )
        self.task = self.bar.add_task(
            self.label, total=self.total, completed=self.start, figures=""
        )
        self.bar.start()


class SignOfLife:
    """A line now and then on standard error while episodes are played side by side.

    An observer of `evaluation.evaluate`.

    Args:
        label: Name of what plays.
        stream: Where to write; standard error by default.
    """

    def __init__(self, label: str, stream: TextIO | None = None):
        self.label = label
        self.stream = sys.stderr if stream is None else stream
        self.steps, self.last_line = 0, time.monotonic()

    def __call__(self, env: Any, running: np.ndarray) -> None:
        """Count a control step of the episodes (n,) bool that still run."""
        self.steps += 1
        if time.monotonic() - self.last_line < LINE_INTERVAL:
            return
        self.last_line = time.monotonic()
        print(
            f"{self.label}: {self.steps} control steps, {np.count_nonzero(running)} of "
            f"{len(running)} episodes still run",
            file=self.stream,
            flush=True,
        )


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}"
