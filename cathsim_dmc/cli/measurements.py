"""`cathsim validate` rod, pair, wall, vessel, forces."""

import importlib
from typing import Annotated, Literal

from tyro import conf

from cathsim_dmc.cli.options import Json, show


def validate(
    part: Annotated[
        Literal["rod", "pair", "wall", "vessel", "forces"], conf.Positional
    ],
    /,
    anatomy: Annotated[tuple[str, ...], conf.arg(aliases=("--phantom",))] = (),
    convergence: bool = True,
    json: Json = False,
) -> int:
    """Compare the physics with theory.

    Args:
        part: Rod and drives; coaxial devices; contact with the wall and its shape;
            flow, wall and motion of the vessel; force sensors.
        anatomy: Of `wall`: directories of further anatomies, such as an imported scan.
        convergence: Of `wall`: whether to include the studies of time step and link
            length.
    """
    module = "force_sensors" if part == "forces" else part
    found = importlib.import_module(f"cathsim_dmc.validation.{module}")
    run = getattr(found, f"validate_{part}")
    if part == "wall":
        return show(run(anatomy, convergence), json)
    if anatomy or not convergence:
        raise ValueError("--anatomy and --no-convergence belong to `validate wall`")
    return show(run(), json)
