"""Compilation of parts: functions that only compiled code calls.

By default numba optimises each function together with its callees and generates machine
code, once more at each level of calls. A part is only lowered to LLVM; its callers
optimise it with their own code and generate the machine code once.
"""

import contextlib
import functools
import gc
from collections.abc import Iterator
from typing import Any

from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags


class _Library(JITCodeLibrary):
    """Code of a part, neither optimised nor compiled to machine code by itself."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0  # numba's value for a function without a Python wrapper

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Does nothing: only code that calls Python needs an environment."""


@functools.cache
def _remembering(context: Any) -> Any:
    """Returns a typing context that caches the signatures it resolves.

    numba otherwise tries all overloads each time, those of dates and strings included.
    """

    class Context(type(context)):
        """Typing context that caches its results in `known`."""

        def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
            """Returns numba's signature of a function for some argument types."""
            if not isinstance(func, types.Function) or kws:
                return super().resolve_function_type(func, args, kws)
            if (func, args) not in known:
                known[func, args] = super().resolve_function_type(func, args, kws)
            return known[func, args]

    known: dict[Any, Any] = {}
    made = object.__new__(Context)
    made.__dict__ = context.__dict__
    return made


class _Flags(Flags):
    """Compiler flags with a fast `values`, which numba calls for each operator.

    Its own version reads a property for each of twenty flags, a tenth of the time to
    compile.
    """

    __slots__ = ()
    _DEFAULTS = Flags().values()

    def values(self) -> dict[str, Any]:
        """Returns the values of all flags by name."""
        return self._DEFAULTS | self._values


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Pauses the collection of cyclic garbage."""
    paused = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if paused:
            gc.enable()


class PackageCompiler(Compiler):
    """Compiler of all functions of the package."""

    def __init__(
        self,
        typingctx: Any,
        targetctx: Any,
        library: Any,
        args: Any,
        return_type: Any,
        flags: Any,
        locals: Any,  # noqa: A002  # numba's name
    ):
        """Takes what `Compiler` takes."""
        known, own = _remembering(typingctx), _Flags(flags)
        super().__init__(known, targetctx, library, args, return_type, own, locals)

    def compile_extra(self, func: Any) -> Any:
        """Compiles a function."""
        with uncollected():  # collecting takes a tenth of the time to compile
            return super().compile_extra(func)


class PartCompiler(PackageCompiler):
    """Compiler of parts."""

    def compile_extra(self, func: Any) -> Any:
        """Compiles a function into a `_Library`."""
        codegen = self.state.targetctx.codegen()
        self.state.library = _Library(codegen, func.__qualname__)
        return super().compile_extra(func)
