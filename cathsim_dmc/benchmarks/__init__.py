"""Trainings behind docs/results.md: a grid of cells, run one after the other."""

# isort: off
# torchrl goes before dm_control.
import cathsim_dmc.agents  # noqa: F401

# isort: on

from cathsim_dmc.benchmarks.grid import Cell, GridError, read_grid
from cathsim_dmc.benchmarks.table import run

__all__ = ["Cell", "GridError", "read_grid", "run"]
