"""`cathsim validate rod`, `pair`, `wall`, `forces`; `benchmark speed`, `difficulty`."""

import sys
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro import conf
from tyro.extras import SubcommandApp

from cathsim_dmc import files
from cathsim_dmc.cli.options import EVALUATION_SEED, show

if TYPE_CHECKING:
    from cathsim_dmc.validation.checks import Report

validations = SubcommandApp()
benchmarks = SubcommandApp()


@validations.command
def rod(json: bool = False) -> int:
    """Bending, buckling and twist of the device against theory.

    Args:
        json: Whether to print one JSON object and nothing else.
    """
    from cathsim_dmc import validation

    return show(validation.validate_rod(), json)


@validations.command
def pair(json: bool = False) -> int:
    """Devices in each other: bending, shape, buckling, sliding and torque.

    Args:
        json: Whether to print one JSON object and nothing else.
    """
    from cathsim_dmc import validation

    return show(validation.validate_pair(), json)


@validations.command
def wall(
    anatomy: Annotated[list[str], conf.arg(aliases=("--phantom",))] = [],  # noqa: B006
    convergence: bool = True,
    json: bool = False,
) -> int:
    """Fidelity of the wall, friction against the capstan equation, convergence.

    Args:
        anatomy: Directories of further anatomies, such as an imported scan.
        convergence: Whether to include the studies of time step and link length.
        json: Whether to print one JSON object and nothing else.
    """
    from cathsim_dmc import validation

    report = validation.validate_wall(anatomy, with_convergence=convergence)
    return show(report, json)


@validations.command
def forces(
    episode: Path | None = None,
    mean: float = 0.4,
    sd: float = 0.02,
    margin: float = 0.1,
    json: bool = False,
) -> int:
    """Force balance, known loads, and the published protocol.

    Args:
        episode: Recorded cannulation (.npz of `cathsim record`) for the protocol;
            scripted insertions by default.
        mean: Mean of the normal reference, N; the published one is unverified.
        sd: Standard deviation of the reference, N.
        margin: Margin of the equivalence test, N.
        json: Whether to print one JSON object and nothing else.
    """
    from cathsim_dmc import validation

    report = validation.validate_forces(episode, mean, sd, margin)
    return show(report, json)


@benchmarks.command
def speed(json: bool = False) -> int:
    """Measure how fast the simulator is. Run it with nothing else running.

    Args:
        json: Whether to print one JSON object and nothing else.
    """
    from cathsim_dmc.analysis.speed import report

    return show(report.speed(lambda text: print(text, file=sys.stderr)), json)


@benchmarks.command
def difficulty(
    task: conf.UseAppendAction[list[str]] = [],  # noqa: B006
    policy: conf.UseAppendAction[list[str]] = [],  # noqa: B006
    seeds: int = 30,
    seed: int = EVALUATION_SEED,
    threads: int = 0,
    out: Path | None = None,
    json: bool = False,
) -> int:
    """Play straight push, random actions, random curls and the expert on every task.

    Push and curls are cut off when the device is stuck (2 s without 0.5 mm of
    insertion), and like random actions after 500 control steps.

    Args:
        task: Task of `cathsim list`, repeated for several; all but `navigate` by
            default.
        policy: Policy of the four, repeated for several; all by default: "push",
            "random", "random_curl", "expert".
        seeds: Number of episodes of each policy on each task.
        seed: Seed of the first episode; the others count up.
        threads: Number of threads of the simulation, 0 for one per core.
        out: Path of a file for the report as JSON, written after every task.
        json: Whether to print one JSON object and nothing else.
    """
    from cathsim_dmc.analysis import difficulty as measure

    if out is not None and not out.parent.is_dir():
        raise ValueError(f"--out is {out}: make the directory {out.parent} first")

    def keep(report: "Report") -> None:
        if out is not None:
            files.write_text(out, dumps(report.as_dict(), indent=2) + "\n")

    report = measure.difficulty(
        task or None,
        seeds,
        seed,
        players=policy or None,
        num_threads=threads,
        say=lambda text: print(text, file=sys.stderr, flush=True),
        keep=keep,
    )
    return show(report, json)
