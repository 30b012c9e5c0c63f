"""Decorators that compile functions of plain loops over arrays with numba.

Importing numba takes longer than loading a task. A function is therefore compiled, and
numba imported, at the first call.
"""

import dis
import functools
import types
from collections.abc import Callable
from typing import Any


class _Compiled:
    """A function that is compiled at its first call, by Python or compiled code."""

    def __init__(self, function: Callable, cache: bool = True, **options: Any):
        functools.update_wrapper(self, function)
        self._function, self._cache, self._options = function, cache, options

    def _made(self, part: bool = False) -> Any:
        import numba

        from cathsim_dmc import compiled_parts

        # Wrappers that nothing calls would add a fifth to the compile time.
        options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
        own: Any = compiled_parts.PackageCompiler
        if part:
            own, options["no_cpython_wrapper"] = compiled_parts.PartCompiler, True
        options |= self._options
        return numba.njit(self._function, pipeline_class=own, **options)

    @functools.cached_property
    def _compiled(self) -> Any:
        """The dispatcher that Python calls, cached on disk if `cache` is set."""
        made = self._made()
        if self._cache:
            from cathsim_dmc import compiled_cache

            compiled_cache.keep(made, self._function)
        return made

    @functools.cached_property
    def _inner(self) -> Any:
        """The dispatcher that compiled callers use; their cached code includes it."""
        return self._made(part=True)

    def __call__(self, *arguments: Any) -> Any:
        return self._compiled(*arguments)

    @property
    def _numba_type_(self) -> Any:
        return self._inner._numba_type_  # noqa: SLF001

    @functools.cached_property
    def on_cuda(self) -> Any:
        """The device function for kernels of numba-cuda; see `for_cuda`."""
        from numba import cuda

        return cuda.jit(device=True)(self._calling("on_cuda"))

    @functools.cached_property
    def interpreted(self) -> Any:
        """The function that Python interprets; see `interpreted`."""
        return self._calling("interpreted")

    def _calling(self, form: str) -> types.FunctionType:
        """The function, which calls the forms of compiled functions with that name."""
        function, own = self._function, dict(self._function.__globals__)
        for name in _global_names(function.__code__):
            if isinstance(own.get(name), _Compiled):
                own[name] = getattr(own[name], form)
        held = (
            types.CellType(getattr(cell.cell_contents, form))
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
        return made

    @property
    def cache_path(self) -> str | None:
        """Folder of the cached code; None if it is not cached."""
        return self._compiled.stats.cache_path


def compiled(function: Callable, cache: bool = True, checked: bool = False) -> Callable:
    """Compiles a function at its first call; with `cache`, once on each machine.

    `fastmath` is off, so results alone and in a batch are equal bit for bit. A function
    that refers to functions which change between calls needs `cache=False`. With
    `checked`, an index out of range raises IndexError.
    """
    return _Compiled(function, cache, boundscheck=checked)


def law(function: Callable) -> Callable:
    """Compiles a function that allocates nothing; numba refuses one that does.

    Without allocations numba omits the reference counts of arrays, which cost more than
    a small function.
    """
    return _Compiled(function, _nrt=False)


def inlined(function: Callable) -> Callable:
    """Compiles a small `law` that is inlined into its callers.

    An array argument takes seven words. In a function that is called for every sample,
    passing them costs more than the work.
    """
    return _Compiled(function, _nrt=False, forceinline=True)


def for_cuda(function: Any) -> Any:
    """Returns a compiled function, with those that it calls, as a device function.

    The source is the same; the names of compiled functions in it refer to their device
    functions. Calls through a module (`module.function`) are not replaced.

    Args:
        function: Result of `compiled`, `law` or `inlined`.

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


def interpreted(function: Any) -> Any:
    """Returns a compiled function, with those that it calls, as functions of Python.

    A few calls for small arrays, as when a scene is made, take less time than the
    compilation. Results are equal bit for bit. Calls through a module
    (`module.function`) are not replaced.
    """
    return function.interpreted


def compile_first(function: Any) -> None:
    """Makes this process interpret all functions until it calls a function.

    That function, and those called after it, are compiled.
    """
    compiled_call = _Compiled.__call__

    def call(self: _Compiled, *arguments: Any) -> Any:
        if self is function:
            _Compiled.__call__ = compiled_call
        chosen = self._compiled if self is function else self.interpreted
        return chosen(*arguments)

    _Compiled.__call__ = call


def _global_names(code: types.CodeType) -> set[str]:
    """Returns the global names that a code object and its nested functions load."""
    inner = (each for each in code.co_consts if isinstance(each, types.CodeType))
    used = dis.get_instructions(code)
    own = {each.argval for each in used if each.opname == "LOAD_GLOBAL"}
    return own | {name for each in inner for name in _global_names(each)}
