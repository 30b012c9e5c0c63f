"""Compiled loops: what a function of plain loops over arrays is decorated with.

Importing numba takes longer than loading a task, so a function is compiled when it is
first called, and numba is imported with it.
"""

import functools
import hashlib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).parent
# What a source that holds compiled loops, or helps to compile, has in it.
_MARKS = (b"\n@compiled", b"\n@callback", b"import numba", b"from numba")


@functools.cache
def _stamp() -> bytes:
    # Compiled code knows where the fields of MuJoCo's structs lie.
    digest = hashlib.sha256(metadata.version("mujoco").encode())
    for path in sorted(_PACKAGE.rglob("*.py")):
        source = path.read_bytes()
        if any(mark in source for mark in _MARKS):
            digest.update(source)
    return digest.digest()


class _Together:
    """A place for numba's cache of the package, with one stamp for all sources."""

    @classmethod
    def from_function(cls, py_func, py_file):
        if not Path(py_file).is_relative_to(_PACKAGE):
            return None
        return super().from_function(py_func, py_file)  # type: ignore[misc]

    def get_source_stamp(self) -> bytes:
        return _stamp()


@functools.cache
def keep_together() -> None:
    """Has numba compile all loops, which hold each other, anew when one changes."""
    from numba.core import caching

    # In the folder of the source, or of the user where that is read-only.
    for place in (caching.UserWideCacheLocator, caching.InTreeCacheLocator):
        kind = type(f"_Together{place.__name__}", (_Together, place), {})
        caching.CacheImpl._locator_classes.insert(1, kind)  # noqa: SLF001


class _Compiled:
    """A function that is compiled when it is called, from Python or compiled code."""

    def __init__(self, function: Callable, cache: bool):
        functools.update_wrapper(self, function)
        self._function, self._cache = function, cache

    def _made(self, **options: Any) -> Any:
        import numba

        keep_together()
        # Wrappers that nothing calls would take a fifth more time to compile.
        options |= {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
        return numba.njit(self._function, **options)

    @functools.cached_property
    def _compiled(self) -> Any:
        """What Python calls."""
        try:
            return self._made(cache=self._cache)
        except RuntimeError:  # neither this folder nor the user's can be written to
            return self._made()

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


def compiled(function: Callable, cache: bool = True) -> Callable:
    """Compiles a function, once on each machine where there is a place to keep it.

    Without `fastmath`: the same numbers bit for bit, alone and in a batch. A function
    that refers to others which change from call to call must not be kept (`cache`).
    """
    return _Compiled(function, cache)
