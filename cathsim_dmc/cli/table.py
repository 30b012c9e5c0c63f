"""`cathsim benchmark table`."""

import sys
from pathlib import Path

from tyro import conf

from cathsim_dmc.cli.options import CHECK_FAILED, INTERRUPTED, print_json


def table(
    grid: Path | None = None,
    runs: Path = Path("runs/table"),
    results: Path = Path("results"),
    only: conf.UseAppendAction[list[str]] = [],  # noqa: B006
    list: bool = False,
    json: bool = False,
) -> int:
    """Train and evaluate the agents of docs/results.md, as far as they are missing.

    Stopped at any moment, it continues where it was. Each cell (task, algorithm,
    preset, observation, seed) is trained in a folder of its own; when it is finished, a
    JSON file with its evaluation over 30 episodes by the published rule appears in
    RESULTS.

    Args:
        grid: Path of the TOML file with the cells, by default that of docs/results.md.
        runs: Directory with a folder for each training.
        results: Directory with a JSON file for each finished cell.
        only: Part of the names of cells, or a pattern with * and ?; repeated for
            several.
        list: Whether to list what is done and what is left, and run nothing.
        json: Whether to print one JSON object and nothing else.
    """
    from cathsim_dmc import benchmarks
    from cathsim_dmc.benchmarks import grid as grids
    from cathsim_dmc.benchmarks import table as cells_

    cells = grids.choose(benchmarks.read_grid(grid or grids.DEFAULT_GRID), only)
    outcomes: dict[str, str] = {}
    if not list:
        outcomes = benchmarks.run(
            cells, runs, results, lambda text: print(text, file=sys.stderr, flush=True)
        )
    names = ("state", "frames", "remark")
    found = {
        cell.name: dict(zip(names, cells_.standing(cell, runs, results), strict=True))
        for cell in cells
    }
    if json:
        checks = [
            {"name": name, "value": outcome, "passed": outcome != cells_.FAILED}
            for name, outcome in outcomes.items()
        ]
        print_json({"checks": checks, "cells": found})
    else:
        for cell in cells:
            one = found[cell.name]
            line = f"{cell.name}  {one['state']}, {one['frames']:,} of "
            print(f"{line}{cell.total_frames:,} frames  {one['remark']}".rstrip())
    if cells_.FAILED in outcomes.values():
        return CHECK_FAILED
    return INTERRUPTED if cells_.INTERRUPTED in outcomes.values() else 0
