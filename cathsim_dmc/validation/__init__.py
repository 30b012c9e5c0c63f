"""Validation of the physics against closed forms.

Each `validate_…` returns a `Report`. Its module is imported when it is first used.
"""

import importlib
from typing import TYPE_CHECKING

from cathsim_dmc.validation.checks import Check, Report

if TYPE_CHECKING:
    from cathsim_dmc.validation.force_sensors import validate_forces
    from cathsim_dmc.validation.pair import validate_pair
    from cathsim_dmc.validation.rod import validate_rod
    from cathsim_dmc.validation.vessel import validate_vessel
    from cathsim_dmc.validation.wall import validate_anatomy, validate_wall

__all__ = [
    "Check",
    "Report",
    "validate_anatomy",
    "validate_forces",
    "validate_pair",
    "validate_rod",
    "validate_vessel",
    "validate_wall",
]

_MODULES = {
    "validate_anatomy": "wall",
    "validate_forces": "force_sensors",
    "validate_pair": "pair",
    "validate_rod": "rod",
    "validate_vessel": "vessel",
    "validate_wall": "wall",
}


def __getattr__(name: str):
    if name in _MODULES:
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
