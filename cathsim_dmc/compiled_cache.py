"""Cache of compiled functions on disk.

Of processes that need the same function, one compiles it and the others wait. A damaged
cache file is compiled again and replaced. If no cache can be written, each process
compiles for itself. Both cases log one warning. One line on standard error announces a
compilation.
"""

import contextlib
import functools
import hashlib
import logging
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import filelock
from numba.core import caching

from cathsim_dmc import compiled_ahead

_LOG = logging.getLogger(__name__)
_PACKAGE = Path(__file__).parent
# Texts that mark a source file with compiled functions or with compiler code.
_MARKS = (
    *(b"\n@compiled", b"\n@law", b"\n@inlined", b"\n@callback"),
    *(b"import numba", b"from numba"),
)
# Other files with constants that compiled functions contain.
_CONSTANTS = ("anatomy/motion.py", "imaging/carm.py", "imaging/options.py")
_SEAL = hashlib.sha256().digest_size
# For a lock, s; a process that is stopped while it compiles keeps its lock.
_LONGEST_WAIT = 60.0


def sources() -> dict[Path, bytes]:
    """Source files on which compiled code depends, in order, and their contents."""
    every = {path: path.read_bytes() for path in sorted(_PACKAGE.rglob("*.py"))}
    constants = [_PACKAGE / name for name in _CONSTANTS]
    return {
        path: source
        for path, source in every.items()
        if path.parent.name == "laws"
        or path in constants
        or any(mark in source for mark in _MARKS)
    }


@functools.cache
def _stamp() -> bytes:
    # Compiled code depends on the layout of MuJoCo's structs.
    digest = hashlib.sha256(metadata.version("mujoco").encode())
    for source in sources().values():
        digest.update(source)
    return digest.digest()


class _Together:
    """Locator of numba's cache for this package, with one stamp for all sources."""

    @classmethod
    def from_function(cls, py_func, py_file):
        if not Path(py_file).is_relative_to(_PACKAGE):
            return None
        return super().from_function(py_func, py_file)  # type: ignore[misc]

    def get_source_stamp(self) -> bytes:
        return _stamp()


@functools.cache
def keep_together() -> None:
    """Makes a change of one source invalidate all code: callers include callees."""
    places = (  # NUMBA_CACHE_DIR, beside the source, the user's cache folder
        caching.UserProvidedCacheLocator,
        caching.InTreeCacheLocator,
        caching.UserWideCacheLocator,
    )
    caching.CacheImpl._locator_classes[:0] = [  # noqa: SLF001
        type(f"_Together{place.__name__}", (_Together, place), {}) for place in places
    ]


def _acquired(path: Path) -> filelock.FileLock:
    """Returns a lock, which is not held if it cannot be acquired."""
    lock = filelock.FileLock(path, _LONGEST_WAIT)
    # A timeout is an OSError, too.
    with contextlib.suppress(OSError, NotImplementedError):
        lock.acquire()
    return lock


class _Files(caching.IndexDataCacheFile):
    """Cache files of one function; damaged or outdated files are not read.

    numba writes the index first, so after a full disk it may name a file of older code.
    """

    def save(self, key: Any, data: Any) -> None:
        """Saves the code of one signature; all signatures share the index."""
        lock = _acquired(Path(f"{self._index_path}.lock"))
        try:
            super().save(key, data)
        finally:
            lock.release(force=True)

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
            raise OSError  # numba treats the file as missing
        return super()._load_data(name)

    def _seal(self, content: bytes) -> bytes:
        stamp = repr(self._source_stamp).encode()
        return hashlib.sha256(stamp + content).digest()


class _Cache(caching.FunctionCache):
    """numba's cache of one function; only warns if it cannot be written.

    The lock is held from a failed `load_overload` until `save_overload`.
    """

    def __init__(self, function: Any):
        super().__init__(function)
        base, stamp = self._impl.filename_base, self._impl.locator.get_source_stamp()
        self._cache_file = _Files(self._cache_path, base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)
        if found is not None:
            return found
        compiled_ahead.start(self._cache_path)
        kind = hashlib.sha256(repr(sig).encode()).hexdigest()[:16]
        name = f"{self._impl.filename_base}-{kind}.lock"
        self._lock = _acquired(Path(self._cache_path, name))
        found = super().load_overload(sig, target_context)
        if found is None:
            _tell_of_compiling()
        else:
            self._lock.release()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            self.disable()
            _warn_of_no_place(self._cache_path, f"{type(error).__name__}: {error}")
        finally:
            self._lock.release(force=True)


def keep(made: Any, function: Any) -> None:
    """Caches the compiled code of a function on disk, if a folder is writable.

    Args:
        made: Dispatcher or `CFunc`, before its first compilation.
        function: Its Python function.
    """
    keep_together()
    try:
        made._cache = _Cache(function)  # noqa: SLF001
    except RuntimeError:
        _told.add("compiling")
        why = "neither it nor the user's cache folder can be written to"
        _warn_of_no_place(str(_PACKAGE), why)


def has_compiled() -> bool:
    """Whether this process has compiled a function that the cache lacked."""
    return "compiling" in _told


_told: set[str] = set()  # kinds of warnings given: dozens of functions share one


def _tell_of_compiling() -> None:
    if "compiling" not in _told:
        _told.add("compiling")
        print(
            "compiling for this machine, once; the result is cached: the whole physics "
            "takes about 10 s, that of coaxial devices 15 s",
            file=sys.stderr,
        )


def _warn_of_damage(path: str, why: str) -> None:
    if "damage" not in _told:
        _told.add("damage")
        _LOG.warning(
            "%s, a file of compiled loops, is damaged (%s); such files are deleted "
            "and compiled again, which takes up to a minute",
            path,
            " ".join(why.split()),
        )


def _warn_of_no_place(folder: str, why: str) -> None:
    if "place" not in _told:
        _told.add("place")
        _LOG.warning(
            "compiled loops cannot be kept in %s (%s), so every process compiles them; "
            "make room there, or set NUMBA_CACHE_DIR to another folder",
            folder,
            why,
        )
