"""Validation of the physics against closed forms and the published protocol.

The functions of `cathsim validate`, and of `cathsim phantom check`; each loads its
parts when it is called.
"""

from __future__ import annotations

from typing import Any

from cathsim_dmc.validation.checks import Check, Report

__all__ = [
    "Check",
    "Report",
    "validate_anatomy",
    "validate_forces",
    "validate_pair",
    "validate_rod",
    "validate_wall",
]


def validate_rod(*args: Any, **kwargs: Any) -> Report:
    """Bending, buckling and twist: see `validation.rod.validate_rod`."""
    from cathsim_dmc.validation import rod

    return rod.validate_rod(*args, **kwargs)


def validate_pair(*args: Any, **kwargs: Any) -> Report:
    """Coaxial devices at rest and on the move: see `validation.pair.validate_pair`."""
    from cathsim_dmc.validation import pair

    return pair.validate_pair(*args, **kwargs)


def validate_anatomy(*args: Any, **kwargs: Any) -> Report:
    """Lumen fidelity of given anatomies: see `wall.validate_anatomy`."""
    from cathsim_dmc.validation import wall

    return wall.validate_anatomy(*args, **kwargs)


def validate_wall(*args: Any, **kwargs: Any) -> Report:
    """Lumen fidelity, friction and convergence: see `wall.validate_wall`."""
    from cathsim_dmc.validation import wall

    return wall.validate_wall(*args, **kwargs)


def validate_forces(*args: Any, **kwargs: Any) -> Report:
    """Sensors and published protocol: see `force_sensors.validate_forces`."""
    from cathsim_dmc.validation import force_sensors

    return force_sensors.validate_forces(*args, **kwargs)
