"""A log of messages that survives a crash, and percentiles of durations."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from cathsim_dmc import files

PERCENTILES = (50, 95, 99)


class Log:
    """File of JSON lines, each flushed at once so that it survives a crash.

    Each line has "t", the time since the log was opened, s, and "event".
    """

    def __init__(self, path: str | Path | None):
        """Open a new file; None keeps no log. FileExistsError if it exists."""
        self._began = time.monotonic()
        self._file = None
        if path is not None:
            self.require(path)
            self._file = open(files.require_file(path, make=True), "x")

    @staticmethod
    def require(path: str | Path | None) -> None:
        """Raise OSError if no new log can be written; called before the work."""
        if path is not None and files.require_file(path, later=True).exists():
            raise FileExistsError(f"{path} exists; give a new file (--log)")

    def write(self, event: str, **values: Any) -> None:
        """Add a line with an event and its values."""
        if self._file is not None:
            line = {"t": round(time.monotonic() - self._began, 6), "event": event}
            with files.naming(self._file.name):  # on a full disk
                text = json.dumps({**line, **values}, default=np.generic.item)
                self._file.write(text + "\n")
                self._file.flush()

    def __enter__(self) -> "Log":
        """Return the log itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Log the exception, if any, and close the file."""
        if error is not None:
            self.write("error", reason=f"{type(error).__name__}: {error}")
        if self._file is not None:
            self._file.close()


def milliseconds(seconds: Sequence[float]) -> dict[str, float] | None:
    """Return percentiles and maximum in ms of durations in s; None without any."""
    if not len(seconds):
        return None
    times = 1e3 * np.asarray(seconds)
    found = {f"p{p}": float(np.percentile(times, p)) for p in PERCENTILES}
    return {n: round(t, 3) for n, t in {**found, "max": float(times.max())}.items()}
