"""Loggers of TorchRL that show the figures of a training beside metrics.csv."""

import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from cathsim_dmc import extras, files
from cathsim_dmc.agents.config import ConfigError

# Loggers of `TrainingConfig.logger` that need a package, with the extra of its name.
EXTRAS = ("tensorboard", "trackio", "wandb")
PROJECT = "cathsim"  # in trackio and Weights & Biases

Row = Mapping[str, float | None]


def require(logger: str | None) -> None:
    """Raise ConfigError if the package of a logger is missing."""
    if logger in EXTRAS:
        with files.refused(ConfigError, f"logger={logger!r}", ImportError):
            extras.require(logger, logger)


class FigureLogger:
    """Shows the rows of metrics.csv in one logger of TorchRL, or in none."""

    def __init__(self, logger: str | None, run: Path, rows: Iterable[Row]):
        """Opens the logger and shows the rows that the run already has.

        A resumed run is shown as one series: the directory of the logger is deleted and
        written again.

        Args:
            logger: "csv", "tensorboard", "trackio", "wandb", or None for none.
            run: Directory of the run; contains that of the logger, except for trackio.
            rows: Rows of metrics.csv.
        """
        self._logger: Any = None
        if logger is None:
            return
        # Imported late: it imports every logger that is installed.
        from torchrl.record.loggers import get_logger

        rows = list(rows)
        if logger != "trackio":
            shutil.rmtree(run / logger, ignore_errors=True)
        # Weights & Biases keeps runs apart only if their names differ.
        name = f"{run.name}-from-{rows[-1]['frames']:.0f}" if rows else run.name
        place = name if logger in ("trackio", "wandb") else logger
        # Files only, unless the user's environment asks for the server.
        offline = os.environ.get("WANDB_MODE") != "online"
        own = {"project": PROJECT, "offline": offline, "log_env_packages": False}
        self._logger = get_logger(
            logger, str(run), place,
            wandb_kwargs=own, trackio_kwargs={"project": PROJECT},
        )  # fmt: skip
        for row in rows:
            self.show(row)

    def show(self, row: Row) -> None:
        """Show a row: figures by name, at its "frames"."""
        if self._logger is None:
            return
        known = {name: value for name, value in row.items() if value is not None}
        self._logger.log_metrics(known, step=int(known.pop("frames")))
        self._logger.flush()

    def close(self) -> None:
        """Write pending rows and close the files."""
        if self._logger is not None:
            self._logger.shutdown()
