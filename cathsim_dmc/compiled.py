"""Compiled loops: what a function of plain loops over arrays is decorated with.

Importing numba takes longer than loading a task, so a module with such functions is
imported only where it is needed, within a function.
"""

from collections.abc import Callable

import numba


def compiled(function: Callable, cache: bool = True) -> Callable:
    """Compiles a function, once on each machine where there is a place to keep it.

    Without `fastmath`: the same numbers bit for bit, alone and in a batch. A function
    that refers to others which change from call to call must not be kept (`cache`).
    """
    options = {"nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(function, cache=cache, **options)
    except RuntimeError:  # neither this folder nor the user's can be written to
        return numba.njit(function, **options)
