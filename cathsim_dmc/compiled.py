"""Compiled loops: what a function of plain loops over arrays is decorated with.

Importing numba takes longer than loading a task, so a module with such functions is
imported only where it is needed, within a function.
"""

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path

import numba
from numba.core import caching

_PACKAGE = Path(__file__).parent
# What a source that holds compiled loops, or helps to compile, has in it.
_MARKS = (b"\n@compiled", b"\n@callback", b"import numba", b"from numba")


@functools.cache
def _stamp() -> bytes:
    """Digest of all sources that hold compiled loops."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        source = path.read_bytes()
        if any(mark in source for mark in _MARKS):
            digest.update(source)
    return digest.digest()


class _Together:
    """A place of compiled loops that are made anew when any of them changes.

    Compiled code holds what it calls in other modules, of which numba's own stamp
    knows nothing.
    """

    @classmethod
    def from_function(cls, py_func, py_file):
        """The place for a function of this package, None for any other."""
        if not Path(py_file).is_relative_to(_PACKAGE):
            return None
        return super().from_function(py_func, py_file)  # type: ignore[misc]

    def get_source_stamp(self) -> bytes:
        """Changes with any source of compiled loops."""
        return _stamp()


class _BesideSource(_Together, caching.InTreeCacheLocator):
    pass


class _OfUser(_Together, caching.UserWideCacheLocator):
    pass


caching.CacheImpl._locator_classes[1:1] = [_BesideSource, _OfUser]  # noqa: SLF001


def compiled(function: Callable, cache: bool = True) -> Callable:
    """Compiles a function, once on each machine where there is a place to keep it.

    Without `fastmath`: the same numbers bit for bit, alone and in a batch. A function
    that refers to others which change from call to call must not be kept (`cache`).
    """
    # Nothing calls them from C, which would take a tenth more time to compile.
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    try:
        return numba.njit(function, cache=cache, **options)
    except RuntimeError:  # neither this folder nor the user's can be written to
        return numba.njit(function, **options)
