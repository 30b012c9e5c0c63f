"""Options, exit codes and printing that several commands share."""

import dataclasses
import json
from typing import Annotated, Any

from tyro import conf

# Exit codes beside 0: a check has failed; the input cannot be used; Ctrl-C.
CHECK_FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
EVALUATION_SEED = 1_000_000  # apart from the seeds of training
DEMONSTRATION_SEED = 2_000_000  # apart from both

_TASK = "Task of `cathsim list`."
Task = Annotated[str, conf.Positional, conf.arg(help=_TASK)]
PolicyName = Annotated[
    str,
    conf.Positional,
    conf.arg(
        help="Directory of a run or checkpoint, or name of a policy: random, push, "
        "expert, idle, curl, random_curl, pretrained:NAME."
    ),
]
Json = Annotated[bool, conf.arg(help="Whether to print one JSON object alone.")]
_THREADS = "Number of threads of the simulation; one per core by default."
Threads = Annotated[int | None, conf.arg(help=_THREADS)]
_MAX_STEPS = "Number of control steps after which an episode is cut off."
MaxSteps = Annotated[int | None, conf.arg(help=_MAX_STEPS)]
_ACCESS = "End of the aorta to enter, ascending or descending, of a named phantom."
Access = Annotated[str | None, conf.arg(help=_ACCESS)]


@dataclasses.dataclass(frozen=True)
class OwnAnatomy:
    """Where a task takes place, for `navigate` and the tasks on random arches.

    Attributes:
        anatomy: Directory of an anatomy, or name of an arch (`navigate`).
        goal: Name of the goal in it (`navigate`).
        access: Way in: "ascending", from the ascending aorta, or "descending", from
            the femoral artery (`navigate`).
        arches: Set of random arches that episodes draw from: train, test or
            test_variants (`arch_…`, `femoral_arch_…`).
        pool: Number of arches that episodes draw from (the same tasks).
        first: Number in the set of the first of them (the same tasks).
    """

    anatomy: Annotated[str | None, conf.arg(aliases=("--phantom",))] = None
    goal: str | None = None
    access: str | None = None
    arches: str | None = None
    pool: int | None = None
    first: int | None = None

    @property
    def task_kwargs(self) -> dict[str, Any]:
        """Options of the task that were given."""
        given = dataclasses.asdict(self)
        return {key: value for key, value in given.items() if value is not None}


NO_ANATOMY = OwnAnatomy()


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
