"""Independent jobs on the machines of a Ray cluster."""

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from cathsim_dmc import bounds, extras

RETRIES = 3  # of a job whose process or machine is lost


def connect() -> None:
    """Connect to the cluster of RAY_ADDRESS or of this machine, or start one here.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ConnectionError: there is no cluster at RAY_ADDRESS.
    """
    extras.require("ray", "ray")
    import ray

    if not ray.is_initialized():
        # Without the dashboard Ray sends no usage statistics. Ray's log files hold the
        # output of the jobs.
        ray.init(
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.WARNING,
        )


def processors() -> list[int]:
    """Return the number of processors of each live machine, in descending order."""
    import ray

    alive = (node["Resources"] for node in ray.nodes() if node["Alive"])
    return sorted((int(node.get("CPU", 0)) for node in alive), reverse=True)


def room(each: int) -> int:
    """Return how many jobs of `each` processors can run at the same time."""
    return sum(count // each for count in processors())


def require_room(count: int, each: int) -> None:
    """Raise ValueError unless `count` jobs can run at the same time.

    Args:
        count: Number of jobs.
        each: Number of processors of a job, which runs on one machine.
    """
    if room(each) < count:
        raise ValueError(
            f"{count} x {each} processors do not fit: the machines of the cluster have "
            f"{processors()}, room for {room(each)} x {each}; ask for fewer, or add "
            "machines with `ray start`"
        )


def over(
    work: Callable[[Any], Any],
    jobs: Sequence[Any],
    each: int | None = None,
    *,
    say: Callable[[str], None] = lambda text: None,
    keep_going: bool = False,
) -> Iterator[tuple[int, Any]]:
    """Yield the index and the result of each independent job as it finishes.

    A job whose process or machine is lost starts again elsewhere. Jobs run in the
    current folder, so relative paths keep their meaning on machines that have it.

    Args:
        work: Function of one job, which the other machines can import; jobs and
            results are copied.
        jobs: Arguments of `work`, one for each job.
        each: Number of processors of a job; None for one.
        say: Receives a line for each finished job.
        keep_going: Whether to yield the exception of a failed job as its result
            instead of raising it.

    Raises:
        ValueError: no machine has `each` processors.
        RuntimeError: a job was lost `RETRIES` + 1 times.
        Exception: that of a job, as it was raised.
    """
    count = 1 if each is None else each
    each = bounds.whole("processors of a job", count, 1, bounds.MOST_THREADS)
    connect()
    require_room(1, each)
    import ray
    from ray.exceptions import RayError, RayTaskError

    task, here = ray.remote(num_cpus=each, max_retries=RETRIES)(_work), os.getcwd()
    left = {task.remote(work, here, job): n for n, job in enumerate(jobs)}
    try:
        while left:
            (done,), _ = ray.wait(list(left))
            number = left.pop(done)
            try:
                result = ray.get(done)
            except RayTaskError as error:
                result = cause_of(error)
            except RayError as error:
                line = " ".join(str(error).split())[:300]
                result = RuntimeError(
                    f"job {number + 1} was lost {RETRIES + 1} times, the last: {line}"
                )
            if isinstance(result, Exception) and not keep_going:
                raise result
            say(f"{len(jobs) - len(left)} of {len(jobs)} jobs are done")
            yield number, result
    finally:
        for one in left:
            ray.cancel(one, force=True)


def cause_of(error: Any) -> Exception:
    """Return the exception that a job raised, with Ray's error as its `__cause__`."""
    found = error.cause if isinstance(error.cause, Exception) else RuntimeError(error)
    found.__cause__ = error
    return found


def _work(work: Callable[[Any], Any], folder: str, job: Any) -> Any:
    if os.path.isdir(folder):
        os.chdir(folder)
    return work(job)
