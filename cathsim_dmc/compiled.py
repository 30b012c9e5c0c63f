"""Compiled loops: what a function of plain loops over arrays is decorated with.

Importing numba takes longer than loading a task, so a function is compiled when it is
first called, and numba is imported with it.
"""

import functools
from collections.abc import Callable
from typing import Any


class _Compiled:
    """A function that is compiled when it is called, from Python or compiled code."""

    def __init__(self, function: Callable, cache: bool = True, **options: Any):
        functools.update_wrapper(self, function)
        self._function, self._cache, self._options = function, cache, options

    def _made(self, **options: Any) -> Any:
        import numba

        # Wrappers that nothing calls would take a fifth more time to compile.
        options |= {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
        return numba.njit(self._function, **options, **self._options)

    @functools.cached_property
    def _compiled(self) -> Any:
        """What Python calls."""
        made = self._made()
        if self._cache:
            from cathsim_dmc import compiled_cache

            compiled_cache.keep(made, self._function)
        return made

    @functools.cached_property
    def _inner(self) -> Any:
        """What compiled code calls, which is kept with the caller."""
        return self._made(no_cpython_wrapper=True)

    def __call__(self, *arguments: Any) -> Any:
        return self._compiled(*arguments)

    @property
    def _numba_type_(self) -> Any:
        return self._inner._numba_type_  # noqa: SLF001

    @property
    def cache_path(self) -> str | None:
        """Folder in which what is compiled is kept; None where nothing is."""
        return self._compiled.stats.cache_path


def compiled(function: Callable, cache: bool = True, checked: bool = False) -> Callable:
    """Compiles a function, once on each machine where there is a place to keep it.

    Without `fastmath`: the same numbers bit for bit, alone and in a batch. A function
    that refers to others which change from call to call must not be kept (`cache`).
    `checked` has an index beyond an array raise IndexError.
    """
    return _Compiled(function, cache, boundscheck=checked)


def law(function: Callable) -> Callable:
    """Compiles a function that allocates nothing; numba refuses one that does.

    Numba then counts no references to arrays, which takes longer than a small function.
    """
    return _Compiled(function, _nrt=False)


def inlined(function: Callable) -> Callable:
    """Compiles a small `law` as a part of those that call it.

    An array in an argument is seven words: where a function is called for every sample,
    passing them takes longer than its work.
    """
    return _Compiled(function, _nrt=False, forceinline=True)
