"""`cathsim validate` rod, pair, wall, vessel, forces, bench."""

import importlib
import sys
from pathlib import Path
from typing import Annotated, Literal

from tyro import conf

from cathsim_dmc.cli.options import Json, show


def validate(
    part: Annotated[
        Literal["rod", "pair", "wall", "vessel", "forces", "bench"], conf.Positional
    ],
    /,
    data: Path | None = None,
    json: Json = False,
) -> int:
    """Compare the physics with theory, or with measured guidewires.

    Args:
        part: Rod and drives; coaxial devices; contact with the wall and its shape;
            flow, wall and motion of the vessel; force sensors; guidewires on a bench.
        data: Of `bench`: folder with phantom.stl and wires.json (docs/bench.md).
    """
    module = "force_sensors" if part == "forces" else part
    found = importlib.import_module(f"cathsim_dmc.validation.{module}")
    run = getattr(found, f"validate_{part}")
    if (data is not None) != (part == "bench"):
        raise ValueError(
            "`validate bench` and it alone takes --data DIR, a folder with phantom.stl "
            "and wires.json (docs/bench.md)"
        )
    if part == "bench":
        return show(run(data, lambda text: print(text, file=sys.stderr)), json)
    return show(run(), json)
