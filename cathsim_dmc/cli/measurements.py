"""`cathsim validate` rod, pair, wall, vessel, forces."""

from typing import Annotated

from tyro import conf
from tyro.extras import SubcommandApp

from cathsim_dmc.cli.options import Json, show

validations = SubcommandApp()


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
