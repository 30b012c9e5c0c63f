"""Options that an episode may draw: numbers, or ranges (low, high)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cathsim_dmc import bounds

Range = float | Sequence[float]


def drawable(options: Any, limits: Mapping[str, tuple[float, float, str]]) -> None:
    """Checks numbers and ranges against limits; ValueError names a field."""
    for name, (low, high, unit) in limits.items():
        value = getattr(options, name)
        if isinstance(value, str | float) or bounds.is_number(value):
            bounds.number(name, value, low, high, unit)
        elif value is not None or getattr(type(options), name) is not None:
            ends = bounds.interval(name, value, low, high, unit)
            object.__setattr__(options, name, ends)


def drawn(value: Range, random_state: np.random.RandomState) -> float:
    """A number as it is, or one drawn from a range (low, high)."""
    if isinstance(value, Sequence):
        low, high = value
        return float(random_state.uniform(low, high))
    return float(value)
