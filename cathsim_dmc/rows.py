"""Rows of large arrays, shared out among the cores.

What acts on them must give the Python interpreter free, as compiled functions and
copies of numpy's do.
"""

import functools
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

_LEAST = 256  # rows of a part: for fewer, handing them out takes longer
MANY = 2 * _LEAST  # rows of which there are several parts


def each(count: int, act: Callable[[slice], Any], least: int = _LEAST) -> None:
    """Calls a function with parts of the rows 0 to `count`, at once where many.

    Args:
        count: Number of rows.
        act: Gets the rows of a part, and writes no others.
        least: Number of rows of a part.
    """
    cores = 1 if count < 2 * least else os.cpu_count() or 1
    parts = min(cores, count // least)
    if parts < 2:
        act(slice(0, count))
        return
    ends = [count * part // parts for part in range(parts + 1)]
    # The results raise what the calls have raised.
    list(_pool(os.getpid(), cores).map(act, map(slice, ends[:-1], ends[1:])))


def alike(items: Iterable[Any]) -> list[tuple[Any, np.ndarray]]:
    """Different objects, each with the rows (n,) int64 at which it is."""
    found: dict[int, tuple[Any, list[int]]] = {}
    for row, item in enumerate(items):
        found.setdefault(id(item), (item, []))[1].append(row)
    return [(item, np.array(own)) for item, own in found.values()]


def of_each(
    groups: Iterable[tuple[Any, np.ndarray]], act: Callable[[Any, np.ndarray], Any]
) -> None:
    """Calls a function with each object of `alike` and its rows, shared out."""
    held = list(groups)
    total = sum(len(own) for _, own in held)
    if total < MANY or len(held) == 1:
        for item, own in held:
            each(len(own), functools.partial(_of, act, item, own))
        return
    cores = os.cpu_count() or 1
    # The results raise what the calls have raised.
    items, own = [one for one, _ in held], [part for _, part in held]
    list(_pool(os.getpid(), cores).map(act, items, own))


def _of(act: Callable, item: Any, own: np.ndarray, part: slice) -> Any:
    return act(item, own[part])


def copy(target: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Copies all rows, as numbers of the target's kind; returns the target."""

    def part(own: slice) -> None:
        np.copyto(target[own], source[own], casting="same_kind")

    each(len(target), part)
    return target


def copied(source: np.ndarray, kind: Any = None) -> np.ndarray:
    """A copy of an array with one axis or more, of a kind of numbers."""
    if len(source) < MANY:
        return source.astype(kind or source.dtype, "C", casting="same_kind")
    return copy(np.empty(source.shape, kind or source.dtype), source)


@functools.cache
def _pool(process: int, cores: int) -> ThreadPoolExecutor:
    """Threads of one process: a fork has none."""
    del process
    return ThreadPoolExecutor(cores)
