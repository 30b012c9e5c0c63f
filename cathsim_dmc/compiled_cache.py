"""Where compiled loops are kept on disk, and what happens when they cannot be.

A damaged file of the cache is compiled anew and replaced. Where nothing can be written,
each process compiles for itself. Both take one line of warning and stop nothing. One
line on standard error says that something is being compiled.
"""

import functools
import hashlib
import logging
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from numba.core import caching

_LOG = logging.getLogger(__name__)
_PACKAGE = Path(__file__).parent
# What a source that holds compiled loops, or helps to compile, has in it.
_MARKS = (b"\n@compiled", b"\n@callback", b"import numba", b"from numba")
_SEAL = hashlib.sha256().digest_size


@functools.cache
def _stamp() -> bytes:
    # Compiled code knows where the fields of MuJoCo's structs lie.
    digest = hashlib.sha256(metadata.version("mujoco").encode())
    for path in sorted(_PACKAGE.rglob("*.py")):
        source = path.read_bytes()
        if path.parent.name == "laws" or any(mark in source for mark in _MARKS):
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
    places = (  # the one of the environment, of the source, of the user
        caching.UserProvidedCacheLocator,
        caching.InTreeCacheLocator,
        caching.UserWideCacheLocator,
    )
    caching.CacheImpl._locator_classes[:0] = [  # noqa: SLF001
        type(f"_Together{place.__name__}", (_Together, place), {}) for place in places
    ]


class _Files(caching.IndexDataCacheFile):
    """Files of one function, read only if they are whole and of the same sources.

    numba writes the index first: after a full disk it may name a file of older code.
    """

    def _load_index(self) -> dict:
        try:
            return super()._load_index()
        except Exception as error:  # pickle fails in many ways
            _warn_of_damage(self._index_path, f"{type(error).__name__}: {error}")
            return {}

    def _save_data(self, name: str, data: Any) -> None:
        content = self._dump(data)
        with self._open_for_write(self._data_path(name)) as stream:
            stream.write(content + self._seal(content))

    def _load_data(self, name: str) -> Any:
        whole = Path(self._data_path(name)).read_bytes()
        if whole[-_SEAL:] != self._seal(whole[:-_SEAL]):
            _warn_of_damage(self._data_path(name), "its checksum is wrong")
            raise OSError  # as if it were not there
        return super()._load_data(name)

    def _seal(self, content: bytes) -> bytes:
        stamp = repr(self._source_stamp).encode()
        return hashlib.sha256(stamp + content).digest()


class _Cache(caching.FunctionCache):
    """numba's cache of one function, which stops nothing."""

    def __init__(self, function: Any):
        super().__init__(function)
        base, stamp = self._impl.filename_base, self._impl.locator.get_source_stamp()
        self._cache_file = _Files(self._cache_path, base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)
        if found is None:
            _tell_of_compiling()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            self.disable()
            _warn_of_no_place(self._cache_path, f"{type(error).__name__}: {error}")


def keep(made: Any, function: Any) -> None:
    """Has what numba makes of a function kept on disk, where there is a place.

    Args:
        made: Dispatcher or `CFunc`, before it is compiled.
        function: The Python function that it is made of.
    """
    keep_together()
    try:
        made._cache = _Cache(function)  # noqa: SLF001
    except RuntimeError:  # neither the folder of the source nor the user's is writable
        _tell_of_compiling()


def has_compiled() -> bool:
    """Whether this process has compiled a loop that was not kept on disk."""
    return "compiling" in _told


_told: set[str] = set()  # a warning for each of dozens of functions would hide the rest


def _tell_of_compiling() -> None:
    if "compiling" not in _told:
        _told.add("compiling")
        print(
            "compiling for this machine, once, what has not been needed before: the "
            "whole physics takes about 15 s, of coaxial devices 30 s",
            file=sys.stderr,
        )


def _warn_of_damage(path: str, why: str) -> None:
    if "damage" not in _told:
        _told.add("damage")
        _LOG.warning(
            "%s, a file of compiled loops, is damaged (%s); such files are thrown away "
            "and compiled anew, which takes up to a minute",
            path,
            " ".join(why.split()),
        )


def _warn_of_no_place(folder: str, why: str) -> None:
    if "place" not in _told:
        _told.add("place")
        _LOG.warning(
            "compiled loops cannot be kept in %s (%s), so every process compiles anew; "
            "make room there, or set NUMBA_CACHE_DIR to another folder",
            folder,
            why,
        )
