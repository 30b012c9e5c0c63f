"""Compiled loops: what a function of plain loops over arrays is decorated with.

Importing numba takes longer than loading a task, so a function is compiled when it is
first called, and numba is imported with it.
"""

import functools
import types
from collections.abc import Callable
from typing import Any


class _Compiled:
    """A function that is compiled when it is called, from Python or compiled code."""

    def __init__(self, function: Callable, cache: bool = True, **options: Any):
        functools.update_wrapper(self, function)
        self._function, self._cache, self._options = function, cache, options

    def _made(self, part: bool = False) -> Any:
        import numba

        from cathsim_dmc import compiled_parts

        # Wrappers that nothing calls would take a fifth more time to compile.
        options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
        own: Any = compiled_parts.PackageCompiler
        if part:
            own, options["no_cpython_wrapper"] = compiled_parts.PartCompiler, True
        options |= self._options
        return numba.njit(self._function, pipeline_class=own, **options)

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
        return self._made(part=True)

    def __call__(self, *arguments: Any) -> Any:
        return self._compiled(*arguments)

    @property
    def _numba_type_(self) -> Any:
        return self._inner._numba_type_  # noqa: SLF001

    @functools.cached_property
    def on_cuda(self) -> Any:
        """What kernels of numba-cuda call; see `for_cuda`."""
        from numba import cuda

        function, own = self._function, dict(self._function.__globals__)
        for name in _names(function.__code__):
            if isinstance(own.get(name), _Compiled):
                own[name] = own[name].on_cuda
        held = (
            types.CellType(cell.cell_contents.on_cuda)
            if isinstance(cell.cell_contents, _Compiled)
            else cell
            for cell in function.__closure__ or ()
        )
        made = types.FunctionType(
            function.__code__,
            own,
            function.__name__,
            function.__defaults__,
            tuple(held) or None,
        )
        made.__module__, made.__qualname__ = function.__module__, function.__qualname__
        return cuda.jit(device=True)(made)

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


def for_cuda(function: Any) -> Any:
    """A compiled function, and all compiled functions that it calls, for a GPU.

    Both have the same source: the names of compiled functions in it stand for their own
    device functions. A function that is called by another module's name
    (`module.function`) is not found.

    Args:
        function: What `compiled`, `law` or `inlined` has made.

    Returns:
        A device function of numba-cuda, for its kernels.

    Raises:
        ImportError: if numba-cuda is missing.
    """
    try:
        return function.on_cuda
    except ImportError as error:
        raise ImportError(
            "functions for a GPU need numba-cuda; install the extra gpu: "
            "pip install '.[gpu]'"
        ) from error


def _names(code: types.CodeType) -> set[str]:
    """Global names in the code of a function and of those within it."""
    inner = (each for each in code.co_consts if isinstance(each, types.CodeType))
    return set(code.co_names) | {name for each in inner for name in _names(each)}
