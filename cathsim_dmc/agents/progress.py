"""Progress on standard error; standard output stays free for JSON."""

import sys
from typing import Any

import numpy as np
from tqdm import tqdm

# Seconds between two lines in a log file, where no terminal redraws them.
LINE_INTERVAL = 15.0
_LINE = "{desc}: {n_fmt}{unit} [{elapsed}, {rate_fmt}{postfix}]\n"


def progress_bar(label: str, unit: str, **options: Any) -> tqdm:
    """A bar of tqdm; a log file gets a line every 15 s."""
    terminal = sys.stderr.isatty()
    interval = 0.1 if terminal else LINE_INTERVAL
    return tqdm(
        desc=label,
        unit=unit,
        mininterval=interval,
        maxinterval=max(interval, 10.0),
        dynamic_ncols=terminal,
        bar_format=None if terminal else _LINE,
        **options,
    )


class EvaluationProgress:
    """An observer of `evaluation.evaluate` that shows progress."""

    def __init__(self, label: str):
        """Starts the bar with a label."""
        self._bar = progress_bar(label, " steps", delay=LINE_INTERVAL)

    def __call__(self, env: Any, running: np.ndarray) -> None:
        """Counts a control step of the episodes (n,) bool that still run."""
        text = f"{np.count_nonzero(running)} of {len(running)} episodes run"
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update()
