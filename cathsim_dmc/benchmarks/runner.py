"""Runs the cells of a grid one after the other, each in a process of its own."""

import multiprocessing
import os
import signal
import statistics
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from cathsim_dmc.agents.checkpoint import Checkpoint, CheckpointError, checkpoints_in
from cathsim_dmc.agents.config import ConfigError
from cathsim_dmc.agents.interruption import Interruption
from cathsim_dmc.benchmarks import cell as cells_
from cathsim_dmc.benchmarks.cell import Folders
from cathsim_dmc.benchmarks.grid import Cell
from cathsim_dmc.benchmarks.result import Result, ResultError, read_result

State = Literal[
    "finished", "other settings", "running", "failed", "impossible", "begun", "waiting"
]
# States of cells that are not run, and what is said of them.
_SETTLED: dict[str, str] = {
    "other settings": "with other settings, left as they are",
    "impossible": "impossible",
}
# Exit codes of a cell's process.
_DONE, _FAILED, _INTERRUPTED, _BUSY = 0, 1, 3, 4
_POLL = 0.5  # s
# Evaluation of which nothing is known: seconds of 30 episodes.
_EVALUATION_SECONDS = 120.0


@dataclass(frozen=True)
class Standing:
    """How far a cell has come.

    Attributes:
        cell: Cell of the grid.
        state: What there is of it.
        frames: Number of frames that are trained and saved.
        seconds: Wall time that they took.
        remark: What else is to be said.
        result: Its result, if it is finished.
    """

    cell: Cell
    state: State
    frames: int = 0
    seconds: float = 0.0
    remark: str = ""
    result: Result | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values, without the result."""
        return {
            "name": self.cell.name,
            "state": self.state,
            "frames": self.frames,
            "total_frames": self.cell.total_frames,
            "seconds": round(self.seconds, 1),
            "success": self.result.success if self.result else None,
            "remark": self.remark,
        }


def standing(cell: Cell, folders: Folders) -> Standing:
    """How far a cell has come, from its files."""
    remark = ""
    try:
        cell.config()
        if folders.result(cell).exists():
            found = read_result(folders.result(cell))
            changed = cells_.changed_settings(cell, found.values)
            state = "other settings" if changed else "finished"
            training = found.training
            return Standing(
                cell,
                state,
                training["frames"],
                training["seconds"],
                cells_.described(changed),
                found,
            )
    except ConfigError as error:
        return Standing(cell, "impossible", remark=str(error))
    except ResultError as error:
        remark = str(error)
    frames, seconds = 0, 0.0
    try:
        existing = checkpoints_in(folders.run(cell))
        if existing:
            newest = Checkpoint.open(existing[-1])
            frames, seconds = newest.frames, newest.seconds
    except CheckpointError as error:
        remark = str(error)
    state: State = "begun" if frames else "waiting"
    failure = folders.failure(cell)
    if failure:
        state, remark = "failed", failure
    if cells_.is_busy(folders, cell):
        state = "running"
    return Standing(cell, state, frames, seconds, remark)


def estimate(one: Standing, others: Sequence[Standing]) -> float | None:
    """Seconds that a cell still needs, by the speed of those most like it.

    Args:
        one: Cell in question.
        others: Every cell of the grid.

    Returns:
        None if no cell of its algorithm and observation has been trained at all.
    """
    if one.state == "finished" or one.state in _SETTLED:
        return 0.0
    cell = one.cell
    speed = one.frames / one.seconds if one.seconds else None
    evaluations = [_EVALUATION_SECONDS]
    keys: tuple[tuple[str, ...], ...] = (
        ("algorithm", "observation", "preset", "variant", "task"),
        ("algorithm", "observation", "preset", "variant"),
        ("algorithm", "observation"),
    )
    for key in keys:
        alike = [
            other
            for other in others
            if all(getattr(other.cell, k) == getattr(cell, k) for k in key)
        ]
        speeds = [other.frames / other.seconds for other in alike if other.seconds]
        known = [o.result.evaluation["seconds"] for o in alike if o.result]
        if known and evaluations == [_EVALUATION_SECONDS]:
            evaluations = known
        if speeds and not speed:
            speed = statistics.median(speeds)
    if not speed:
        return None
    left = max(cell.total_frames - one.frames, 0)
    return left / speed + statistics.median(evaluations)


def run(
    cells: Sequence[Cell],
    folders: Folders,
    *,
    limit: float | None = None,
    anew: bool = False,
    alike: Sequence[Cell] = (),
    say: Callable[[str], None] = print,
) -> dict[str, str]:
    """Run what is left of some cells, in their order.

    A cell that fails is reported and the next one begins; SIGINT, SIGTERM and the
    limit end the running training with a checkpoint.

    Args:
        cells: Cells to run.
        folders: Where they lie.
        limit: Number of seconds after which to stop; None for no limit.
        anew: Whether cells that were trained with other settings are trained again.
        alike: Further cells, whose speeds tell how long these will take.
        say: Function that is told what happens.

    Returns:
        What became of each cell that was begun: "finished", "failed", "busy" or
        "interrupted", by name.
    """
    end = None if limit is None else time.monotonic() + limit
    outcomes: dict[str, str] = {}
    with Interruption() as interruption:

        def over() -> bool:
            return interruption.requested or (
                end is not None and time.monotonic() >= end
            )

        for cell in cells:
            if over():
                break
            now = standing(cell, folders)
            if now.state == "finished" or now.state == "other settings" and not anew:
                if now.state != "finished":
                    say(f"{cell.name}: other settings, left as it is ({now.remark})")
                continue
            say(f"{cell.name}: begins at {now.frames:,} of {cell.total_frames:,}")
            outcomes[cell.name] = _run_one(cell, folders, anew, over)
            say(_report(cell, folders, outcomes[cell.name], cells, alike))
    return outcomes


def _run_one(cell: Cell, folders: Folders, anew: bool, over: Callable[[], bool]) -> str:
    """Run a cell in a process of its own; return what became of it."""
    process = multiprocessing.get_context("spawn").Process(
        target=_child, args=(cell, folders, anew), name=cell.name
    )
    process.start()
    asked = False
    while process.is_alive():
        process.join(_POLL)
        # Once only: a second signal would end it without a checkpoint.
        if over() and not asked:
            process.terminate()
            asked = True
    code = process.exitcode
    if code == _DONE:
        return "finished"
    if code == _BUSY:
        return "busy"
    if code == _INTERRUPTED or asked and code == -signal.SIGTERM:
        return "interrupted"
    if code is not None and code < 0:
        # Such as for want of memory; its own errors it notes itself.
        cells_.note_failure(folders, cell, f"its process died of signal {-code}")
    return "failed"


def _child(cell: Cell, folders: Folders, anew: bool) -> None:
    """What the process of a cell does."""
    _end_with_parent()
    if hasattr(os, "setsid"):
        # Ctrl-C is for the runner, which passes it on.
        os.setsid()
    try:
        cells_.work(cell, folders, anew)
    except cells_.BusyError:
        sys.exit(_BUSY)
    except cells_.TrainingInterruptedError:
        sys.exit(_INTERRUPTED)
    except Exception:
        traceback.print_exc()
        sys.exit(_FAILED)


def _end_with_parent() -> None:
    """Ask this process to end when the runner is gone, even if that was killed."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


def _report(
    cell: Cell,
    folders: Folders,
    outcome: str,
    cells: Sequence[Cell],
    alike: Sequence[Cell],
) -> str:
    standings = [standing(one, folders) for one in cells]
    known = [*standings, *(standing(one, folders) for one in alike)]
    here = next(one for one in standings if one.cell is cell)
    text = f"{cell.name}: {outcome}"
    if here.result is not None:
        low, high = here.result.evaluation["summary"]["success_ci95"]
        text += (
            f", success {100 * here.result.success:.0f} % "
            f"({100 * low:.0f}–{100 * high:.0f}) after {here.frames:,} frames in "
            f"{clock(here.seconds)}"
        )
    elif outcome == "failed":
        text += f" ({here.remark.splitlines()[-1] if here.remark else 'see above'})"
    return f"{text}\n{left_over(standings, known)}"


def left_over(standings: Sequence[Standing], known: Sequence[Standing]) -> str:
    """What is done and what is left, in a line.

    Args:
        standings: The cells in question.
        known: Every cell whose speed may tell how long these will take.
    """
    done = sum(one.state == "finished" for one in standings)
    left = [one for one in standings if one.state not in (*_SETTLED, "finished")]
    times = [estimate(one, known) for one in left]
    sure = [seconds for seconds in times if seconds is not None]
    text = f"{done} of {len(standings)} cells finished"
    if left:
        text += f", {len(left)} left: about {clock(sum(sure))}"
    if len(sure) < len(times):
        text += f" and {len(times) - len(sure)} of unknown length"
    for state in _SETTLED:
        count = sum(one.state == state for one in standings)
        if count:
            text += f"; {count} {_SETTLED[state]}"
    return text


def clock(seconds: float) -> str:
    """Hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}"
