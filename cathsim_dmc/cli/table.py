"""`cathsim benchmark table`."""

import builtins
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from tyro import conf

from cathsim_dmc.cli.options import CHECK_FAILED, INTERRUPTED, print_json

if TYPE_CHECKING:
    from cathsim_dmc.benchmarks.runner import Standing


def table(
    grid: Path | None = None,
    runs: Path = Path("runs/table"),
    results: Path = Path("results"),
    only: conf.UseAppendAction[list[str]] = [],  # noqa: B006
    limit: float | None = None,
    list: bool = False,
    anew: bool = False,
    json: bool = False,
) -> int:
    """Train and evaluate the agents of docs/results.md, as far as they are missing.

    Stopped at any moment, it goes on where it was. Each cell (task, algorithm, preset,
    observation, seed) is trained in a folder of its own; when it is finished, a JSON
    file with its evaluation over 30 episodes by the published rule appears in RESULTS.

    Args:
        grid: Path of the TOML file with the cells, by default that of docs/results.md.
        runs: Directory with a folder for each training.
        results: Directory with a JSON file for each finished cell.
        only: Part of the names of cells, or a pattern with * and ?; repeated for
            several.
        limit: Number of seconds after which to stop, with a checkpoint.
        list: Whether to list what is done and what is left, and run nothing.
        anew: Whether to train again what was trained with other settings than the
            grid's; the old training is renamed.
        json: Whether to print one JSON object and nothing else.
    """
    from cathsim_dmc import benchmarks
    from cathsim_dmc.benchmarks import runner
    from cathsim_dmc.benchmarks.grid import DEFAULT_GRID, choose

    if limit is not None and not limit > 0:
        raise ValueError(f"--limit is {limit:g}; it must be positive")
    every = benchmarks.read_grid(grid or DEFAULT_GRID)
    cells = choose(every, only)
    others = [cell for cell in every if cell not in cells]
    folders = benchmarks.Folders(runs, results)
    outcomes: dict[str, str] = {}
    if not list:
        outcomes = benchmarks.run(
            cells,
            folders,
            limit=limit,
            anew=anew,
            alike=others,
            say=lambda text: print(text, file=sys.stderr, flush=True),
        )
    standings = [runner.standing(cell, folders) for cell in cells]
    failed = [name for name, outcome in outcomes.items() if outcome == "failed"]
    if json:
        print_json(
            {
                "checks": [
                    {"name": name, "value": outcome, "passed": outcome != "failed"}
                    for name, outcome in outcomes.items()
                ],
                "cells": [one.to_dict() for one in standings],
            }
        )
    else:
        _print(standings, [runner.standing(cell, folders) for cell in others])
    if failed:
        return CHECK_FAILED
    cut = limit is None and "interrupted" in outcomes.values()
    return INTERRUPTED if cut else 0


def _print(standings: "list[Standing]", others: "list[Standing]") -> None:
    from rich.console import Console
    from rich.table import Table

    from cathsim_dmc.benchmarks import runner

    # Of all cells of the grid, whichever were asked for.
    known = [*standings, *others]
    table = Table("cell", "state", "frames", "time", "left", "success", box=None)
    for one in standings:
        left = runner.estimate(one, known)
        total = f"{one.cell.total_frames:,}"
        table.add_row(
            one.cell.name,
            one.state,
            total if one.state == "finished" else f"{one.frames:,} of {total}",
            runner.clock(one.seconds) if one.seconds else "",
            "?" if left is None else runner.clock(left) if left else "",
            f"{100 * one.result.success:.0f} %" if one.result else "",
        )
    # As wide as it needs to be where nobody looks at a terminal.
    console = Console() if sys.stdout.isatty() else Console(width=160)
    console.print(table)
    remarks: dict[str, builtins.list[str]] = {}
    for one in standings:
        if one.remark:
            line = one.remark.splitlines()[-1]
            remarks.setdefault(line, []).append(one.cell.name)
    for line, names in remarks.items():
        of = names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")
        console.print(f"{of}: {line}", soft_wrap=True, highlight=False)
    console.print(runner.left_over(standings, known), highlight=False)
