"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import uuid
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

try:
    import fcntl
except ImportError:  # Windows has no advisory locks: leftovers stay there.
    fcntl = None

_PARTIAL = ".partial"
_DIRECTORY = ".d"  # of an unfinished directory, beside its lock


@contextlib.contextmanager
def atomic_path(
    path: str | os.PathLike[str], suffix: str | None = None
) -> Iterator[Path]:
    """Yield a temporary path whose content becomes `path` when the block ends well.

    The temporary file lies in the same directory, is flushed to disk and renamed. When
    the block raises, it is removed and an older `path` stays as it was. Of several
    writers of one path all succeed, and the last one's content stays. What a killed
    writer has left is removed by the next writer of the same path.

    Args:
        suffix: Ending that `path` must have, such as ".npz"; None allows any.

    Raises:
        ValueError: if `path` does not end in `suffix`.
        FileNotFoundError: if the directory does not exist.
        RuntimeError: if the block ends without having written anything.
    """
    path = Path(path)
    if suffix is not None and path.suffix != suffix:
        raise ValueError(f"the file name must end in {suffix}, got {path.name!r}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"no directory {path.parent}; create it first")
    remove_abandoned(path.parent, path.name)
    temporary, stream = _create(path)
    try:
        with stream, naming(path):
            yield temporary
            if not temporary.is_file() or not temporary.stat().st_size:
                raise RuntimeError(f"nothing was written for {path}")
            # Opened anew: the block may have put another file in its place.
            with open(temporary, "rb+") as written:
                os.fsync(written.fileno())
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_directory(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary directory that becomes `path` when the block ends well.

    When the block raises, it is removed. What a killed writer has left is removed by
    the next writer of the same path, or by `remove_abandoned`.

    Args:
        path: Path of the directory that is to appear; it must not exist.

    Raises:
        OSError: if it exists with something in it, or cannot be written.
    """
    path = Path(path)
    remove_abandoned(path.parent, path.name)
    # The lock lies beside the directory, whose own one its users may take.
    lock, stream = _create(path)
    temporary = Path(f"{lock}{_DIRECTORY}")
    try:
        temporary.mkdir()
        yield temporary
        for file in temporary.rglob("*"):
            if file.is_file():
                with open(file, "rb+") as stream:
                    os.fsync(stream.fileno())
        os.rename(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        lock.unlink(missing_ok=True)
        stream.close()


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Name the file in an OSError of the block that names none, as on a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise


def write_bytes(path: str | os.PathLike[str], data: bytes) -> Path:
    """Write a file atomically, see `atomic_path`; return its path."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return Path(path)


def write_text(path: str | os.PathLike[str], text: str) -> Path:
    """Write UTF-8 text atomically, see `atomic_path`; return its path."""
    return write_bytes(path, text.encode())


def _create(path: Path) -> tuple[Path, BinaryIO]:
    """An empty temporary file beside `path`, locked for as long as it is open."""
    while True:
        name = f".{path.name}.{uuid.uuid4().hex[:12]}{_PARTIAL}"
        temporary = path.with_name(name)
        # Not tempfile, whose files only their owner may read, whatever the umask.
        stream = open(temporary, "xb")
        if fcntl is None:
            return temporary, stream
        fcntl.flock(stream, fcntl.LOCK_EX)
        # Before the lock was ours, another writer may have taken it for a leftover.
        if temporary.exists():
            return temporary, stream
        stream.close()


def remove_abandoned(folder: Path, name: str | None = None) -> None:
    """Remove unfinished files and directories that no living process holds open.

    Args:
        name: Of what they were to become; None takes all of them.
    """
    if fcntl is None or not folder.is_dir():
        return
    pattern = re.compile(
        rf"\.{'.+' if name is None else re.escape(name)}\.[0-9a-f]{{12}}"
        + re.escape(_PARTIAL)
    )
    for leftover in folder.iterdir():
        if not pattern.fullmatch(leftover.name) or leftover.is_symlink():
            continue
        # Another writer may remove it, or have just renamed it.
        with contextlib.suppress(OSError), open(leftover, "rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(f"{leftover}{_DIRECTORY}", ignore_errors=True)
            leftover.unlink()


def read_arrays(
    source: Path | BinaryIO, largest: int, names: Iterable[str] | None = None
) -> dict[str, np.ndarray]:
    """Arrays of an .npz archive from outside: no pickle is read, no memory filled.

    Args:
        source: Path of the archive, or the archive itself.
        largest: Size of all arrays together that is still read, bytes unpacked.
        names: Names of the arrays that must be there; None reads all of them.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the archive is damaged, lacks an array or is too large. The message
            does not name the file.
    """
    try:
        with zipfile.ZipFile(source) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > largest:
            raise ValueError(f"its arrays unpack to {size:,} bytes")
        if not isinstance(source, Path):
            source.seek(0)
        with np.load(source, allow_pickle=False) as arrays:
            wanted = list(arrays if names is None else names)
            lacking = [name for name in wanted if name not in arrays]
            if lacking:
                raise ValueError(f"it lacks {', '.join(lacking)}")
            found = {name: arrays[name] for name in wanted}
        others = [name for name in wanted if not isinstance(found[name], np.ndarray)]
        if others:
            raise ValueError(f"{', '.join(others)} is no array")
        return found
    except FileNotFoundError:
        raise
    except Exception as error:  # zipfile and numpy fail in many ways
        text = " ".join(str(error).split())
        raise ValueError(text or type(error).__name__) from error
