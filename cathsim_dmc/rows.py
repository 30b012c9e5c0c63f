"""Rows of large arrays, processed by several threads.

The functions that process them must release the GIL, as compiled functions and numpy's
copies do.
"""

import functools
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

_LEAST = 256  # smallest number of rows of a part: for fewer, threads cost more
MANY = 2 * _LEAST  # number of rows from which there are several parts


def each(count: int, act: Callable[[slice], Any], least: int = _LEAST) -> None:
    """Calls a function on parts of the rows 0 to `count`, in parallel if many.

    Args:
        count: Number of rows.
        act: Function of a slice of rows; it must write no other rows.
        least: Smallest number of rows of a part.
    """
    cores = 1 if count < 2 * least else os.cpu_count() or 1
    parts = min(cores, count // least)
    if parts < 2:
        act(slice(0, count))
        return
    ends = [count * part // parts for part in range(parts + 1)]
    # `list` raises the exceptions of the calls.
    list(_pool(os.getpid(), cores).map(act, map(slice, ends[:-1], ends[1:])))


def alike(items: Iterable[Any]) -> list[tuple[Any, np.ndarray]]:
    """Groups rows by identical object; returns each object with its rows (n,) int64."""
    found: dict[int, tuple[Any, list[int]]] = {}
    for row, item in enumerate(items):
        found.setdefault(id(item), (item, []))[1].append(row)
    return [(item, np.array(own)) for item, own in found.values()]


def of_each(
    groups: Iterable[tuple[Any, np.ndarray]], act: Callable[[Any, np.ndarray], Any]
) -> None:
    """Calls a function with each object of `alike` and its rows, in parallel."""
    held = list(groups)
    total = sum(len(own) for _, own in held)
    if total < MANY or len(held) == 1:
        for item, own in held:
            each(len(own), functools.partial(_of, act, item, own))
        return
    cores = os.cpu_count() or 1
    # `list` raises the exceptions of the calls.
    items, own = [one for one, _ in held], [part for _, part in held]
    list(_pool(os.getpid(), cores).map(act, items, own))


def _of(act: Callable, item: Any, own: np.ndarray, part: slice) -> Any:
    return act(item, own[part])


def copy(target: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Copies `source` into `target`, casting "same_kind"; returns `target`."""

    def part(own: slice) -> None:
        np.copyto(target[own], source[own], casting="same_kind")

    each(len(target), part)
    return target


def copied(source: np.ndarray, kind: Any = None) -> np.ndarray:
    """Returns a C-contiguous copy of an array with an axis or more, of dtype `kind`."""
    if len(source) < MANY:
        return source.astype(kind or source.dtype, "C", casting="same_kind")
    return copy(np.empty(source.shape, kind or source.dtype), source)


@functools.cache
def _pool(process: int, cores: int) -> ThreadPoolExecutor:
    """Returns the thread pool of a process; a forked child needs its own."""
    del process
    return ThreadPoolExecutor(cores)
