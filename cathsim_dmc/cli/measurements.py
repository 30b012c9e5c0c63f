"""`cathsim validate` rod, pair, wall, vessel, forces, bench; `benchmark speed`."""

import sys
from pathlib import Path
from typing import Annotated

from tyro import conf
from tyro.extras import SubcommandApp

from cathsim_dmc.cli.options import Json, show

validations = SubcommandApp()
benchmarks = SubcommandApp()


@validations.command
def rod(json: Json = False) -> int:
    """Bending, buckling and twist of the device against theory."""
    from cathsim_dmc import validation

    return show(validation.validate_rod(), json)


@validations.command
def pair(json: Json = False) -> int:
    """Devices in each other: bending, shape, buckling, sliding and torque."""
    from cathsim_dmc import validation

    return show(validation.validate_pair(), json)


@validations.command
def wall(
    anatomy: Annotated[list[str], conf.arg(aliases=("--phantom",))] = [],  # noqa: B006
    convergence: bool = True,
    json: Json = False,
) -> int:
    """Fidelity of the wall, friction against the capstan equation, convergence.

    Args:
        anatomy: Directories of further anatomies, such as an imported scan.
        convergence: Whether to include the studies of time step and link length.
    """
    from cathsim_dmc import validation

    report = validation.validate_wall(anatomy, with_convergence=convergence)
    return show(report, json)


@validations.command
def vessel(json: bool = False) -> int:
    """Blood that flows, against closed forms.

    Args:
        json: Whether to print one JSON object and nothing else.
    """
    from cathsim_dmc import validation

    return show(validation.validate_vessel(), json)


@validations.command
def forces(json: Json = False) -> int:
    """Force balance and known loads."""
    from cathsim_dmc import validation

    return show(validation.validate_forces(), json)


@validations.command
def bench(
    data: Path, turns: int = 12, sensitivity: bool = True, json: Json = False
) -> int:
    """Guidewires against those that were measured in a phantom.

    Args:
        data: Folder with phantom.stl and wires.json, see docs/bench.md.
        turns: Number of turns of an angled wire that are tried.
        sensitivity: Whether to repeat it with other stiffness, friction and scale.
    """
    from rich.console import Console
    from rich.table import Table

    from cathsim_dmc.validation import bench as benches

    report = benches.validate_bench(
        data, turns=turns, sensitivity=sensitivity, say=_progress
    )
    for title, (header, *rows) in benches.tables(report).items() if not json else ():
        table = Table(*header, title=title, box=None)
        for row in rows:
            table.add_row(*row)
        Console(width=max(130, Console().width)).print(table)
    return show(report, json)


@benchmarks.command
def speed(json: Json = False) -> int:
    """Measure calibrated speed and overhead; run it with nothing else running."""
    from cathsim_dmc.analysis import speed as measured

    return show(measured.speed(_progress), json)


def _progress(text: str) -> None:
    print(text, file=sys.stderr)
