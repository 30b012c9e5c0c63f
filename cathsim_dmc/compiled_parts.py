"""How functions that only compiled code calls are compiled: as parts of their callers.

numba optimises every function, with all that it calls, and makes machine code of it,
again for each level of calls. A part is lowered alone; its callers optimise it with
themselves, once, and make machine code of the whole.
"""

import functools
from typing import Any

from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags


class _Library(JITCodeLibrary):
    """The code of a part, which nothing runs before a caller has taken it in."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0  # as of every function without a wrapper for Python

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Sets nothing: an environment is for code that calls Python."""


@functools.cache
def _remembering(context: Any) -> Any:
    """A context of types that looks an operator on some types up once.

    numba tries all that it knows of, dates and strings included, each time.
    """

    class Context(type(context)):
        """The context, with what was found in `known`."""

        def resolve_function_type(self, func: Any, args: Any, kws: Any) -> Any:
            """Signature of a function on some types, as numba finds it."""
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
    """Flags of a compilation, which numba compares for each operator that it looks up.

    Its own `values` asks a property for each of twenty, a tenth of the time to compile.
    """

    __slots__ = ()
    _DEFAULTS = Flags().values()

    def values(self) -> dict[str, Any]:
        """Values of all options."""
        return self._DEFAULTS | self._values


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


class PartCompiler(PackageCompiler):
    """Compiler of a part."""

    def compile_extra(self, func: Any) -> Any:
        """Compiles a function into a library of its own kind."""
        codegen = self.state.targetctx.codegen()
        self.state.library = _Library(codegen, func.__qualname__)
        return super().compile_extra(func)
