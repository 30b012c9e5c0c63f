"""Rows of named tuples of arrays: some of N simulations."""

from typing import Any

import numpy as np


def part(measured: Any, rows: np.ndarray | slice | int) -> Any:
    """Rows of all arrays of a named tuple, and of the tuples in it; None is kept."""
    if measured is None or isinstance(measured, np.ndarray):
        return measured if measured is None else measured[rows]
    return type(measured)._make(part(value, rows) for value in measured)


def merged(old: Any, new: Any, rows: np.ndarray) -> Any:
    """A named tuple with `new` in some rows of its arrays (N, ...); `old` stays."""
    if old is None or isinstance(old, np.ndarray):
        array = old if old is None else old.copy()
        if array is not None:
            array[rows] = new
        return array
    pairs = zip(old, new, strict=True)
    return type(old)._make(merged(before, now, rows) for before, now in pairs)
