"""What several commands share: options, exit codes, printing."""

import dataclasses
import json
from typing import Annotated, Any

from tyro import conf

# Exit codes beside 0: a check has failed; the input cannot be used; Ctrl-C.
CHECK_FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
EVALUATION_SEED = 1_000_000  # apart from the seeds of training
DEMONSTRATION_SEED = 2_000_000  # apart from both

Task = Annotated[str, conf.Positional]


@dataclasses.dataclass(frozen=True)
class OwnAnatomy:
    """An anatomy of one's own, for the task `navigate`.

    Attributes:
        anatomy: Directory of an anatomy, or name of an arch.
        goal: Name of the goal in it.
    """

    anatomy: Annotated[str | None, conf.arg(aliases=("--phantom",))] = None
    goal: str | None = None

    @property
    def task_kwargs(self) -> dict[str, Any]:
        """What was given, as options of the task."""
        given = {"anatomy": self.anatomy, "goal": self.goal}
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
