"""Options, exit codes and printing that several commands share."""

import contextlib
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

from tyro import conf

from cathsim_dmc import files

# Exit codes beside 0: a check has failed; the input cannot be used; Ctrl-C.
CHECK_FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130

_TASK = "Task of `cathsim list`."
Task = Annotated[str, conf.Positional, conf.arg(help=_TASK)]
Json = Annotated[bool, conf.arg(help="Whether to print one JSON object only.")]
_THREADS = "Number of threads of the simulation; one per core by default."
_MODULES = (
    "Module to import first, repeated for several: it registers a task, device, "
    "observation, algorithm or policy of your own. It is searched in Python's path "
    "and in the current folder."
)
Modules = Annotated[
    tuple[str, ...],
    conf.UseAppendAction,
    conf.arg(name="import", metavar="MODULE", help=_MODULES),
]
Threads = Annotated[int | None, conf.arg(help=_THREADS)]
_RAY = "Whether to distribute the work over a Ray cluster (docs/cluster.md)."
Ray = Annotated[bool, conf.arg(help=_RAY)]


def say(text: str) -> None:
    """Print a line of progress on standard error."""
    print(text, file=sys.stderr, flush=True)


def told_of_losses() -> contextlib.redirect_stdout:
    """Return a context in which Ray reports lost processes on standard error."""
    return contextlib.redirect_stdout(sys.stderr)


@contextlib.contextmanager
def told_of_replaced(paths: Iterable[Path]) -> Iterator[None]:
    """Report on standard error which of some files the block replaces or removes."""
    before = {path: path.stat().st_mtime_ns for path in paths if path.is_file()}
    yield
    for path, written in before.items():
        if not path.is_file():
            say(f"{path}, which was there before, is removed")
        elif path.stat().st_mtime_ns != written:
            say(f"{path}, which was there before, is replaced")


def require_png(path: Path, later: bool = False) -> None:
    """Require that a picture can be written; see `files.require_file`."""
    if path.suffix != ".png":
        raise ValueError(f"{path} does not end in .png")
    files.require_file(path, later=later)


def console(width: int | None = None) -> Any:
    """Return a console on standard output that raises BrokenPipeError like `print`."""
    from rich.console import Console

    class OwnConsole(Console):
        """A console that raises BrokenPipeError."""

        def on_broken_pipe(self) -> None:
            # Rich's own ends with exit code 1, which is that of a failed check.
            raise BrokenPipeError

    # Texts of other programs are no markup.
    return OwnConsole(width=width, markup=False)


def print_json(values: Any) -> None:
    """Print one JSON object."""
    print(json.dumps(values, indent=2))


def show(report: Any, as_json: bool) -> int:
    """Print a report of checks; return the exit code."""
    if as_json:
        print_json(report.as_dict())
    else:
        console().print(report.table())
    return 0 if report.passed else CHECK_FAILED
