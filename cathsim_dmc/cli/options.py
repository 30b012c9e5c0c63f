"""Options, exit codes and printing that several commands share."""

import contextlib
import json
import sys
from typing import Annotated, Any

from tyro import conf

# Exit codes beside 0: a check has failed; the input cannot be used; Ctrl-C.
CHECK_FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
EVALUATION_SEED = 1_000_000  # apart from the seeds of training

_TASK = "Task of `cathsim list`."
Task = Annotated[str, conf.Positional, conf.arg(help=_TASK)]
Json = Annotated[bool, conf.arg(help="Whether to print one JSON object alone.")]
_THREADS = "Number of threads of the simulation; one per core by default."
_MODULES = (
    "Module to import first, repeated for several: of a task, device, observation, "
    "algorithm or policy of your own. It is looked for where Python looks, and in the "
    "present folder."
)
Modules = Annotated[
    tuple[str, ...],
    conf.UseAppendAction,
    conf.arg(name="import", metavar="MODULE", help=_MODULES),
]
Threads = Annotated[int | None, conf.arg(help=_THREADS)]
_RAY = "Whether the machines of a Ray cluster do the work (docs/cluster.md)."
Ray = Annotated[bool, conf.arg(help=_RAY)]


def say(text: str) -> None:
    """Print a line of progress on standard error."""
    print(text, file=sys.stderr, flush=True)


def told_of_losses() -> contextlib.redirect_stdout:
    """A context in which Ray tells of lost processes on standard error."""
    return contextlib.redirect_stdout(sys.stderr)


def print_json(values: Any) -> None:
    """Print one JSON object."""
    print(json.dumps(values, indent=2))


def show(report: Any, as_json: bool) -> int:
    """Print a report of checks; return the exit code."""
    if as_json:
        print_json(report.as_dict())
    else:
        from rich.console import Console

        Console().print(report.table())
    return 0 if report.passed else CHECK_FAILED
