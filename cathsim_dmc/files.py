"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
import uuid
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

_PARTIAL = ".partial"
_ABANDONED = 86_400.0  # s, after which what is unfinished is that of a killed writer


@contextlib.contextmanager
def atomic_path(
    path: str | os.PathLike[str], suffix: str | None = None
) -> Iterator[Path]:
    """Yield a temporary path whose content becomes `path` when the block ends well.

    The temporary file lies in the same directory, is flushed to disk and renamed. When
    the block raises, it is removed and an older `path` stays as it was. Of several
    writers of one path all succeed, and the last one's content stays. What a killed
    writer has left is removed a day later by a writer of the same path.

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
    temporary = _temporary(path)
    # Before the work. Not tempfile, whose files only their owner may read.
    open(temporary, "xb").close()
    try:
        with naming(path):
            yield temporary
            if not temporary.is_file() or not temporary.stat().st_size:
                raise RuntimeError(f"nothing was written for {path}")
            _flush(temporary)
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_directory(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary directory that becomes `path` when the block ends well.

    When the block raises, it is removed; see `atomic_path` for a killed writer.

    Raises:
        OSError: if `path` exists with something in it, or cannot be written.
    """
    path = Path(path)
    remove_abandoned(path.parent, path.name)
    temporary = _temporary(path)
    temporary.mkdir()
    try:
        yield temporary
        for file in temporary.rglob("*"):
            if file.is_file():
                _flush(file)
        os.rename(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


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


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}{_PARTIAL}")


def _flush(path: Path) -> None:
    """Flush a file to disk; opened anew, as a block may have replaced it."""
    with open(path, "rb+") as written:
        os.fsync(written.fileno())


def remove_abandoned(folder: Path, name: str | None = None) -> None:
    """Remove what killed writers have left unfinished, a day later.

    Args:
        name: Of what it was to become; None takes all of it.
    """
    wanted = ".+" if name is None else re.escape(name)
    pattern = re.compile(rf"\.{wanted}\.[0-9a-f]{{12}}{re.escape(_PARTIAL)}")
    for leftover in folder.iterdir() if folder.is_dir() else ():
        if not pattern.fullmatch(leftover.name) or leftover.is_symlink():
            continue
        with contextlib.suppress(OSError):  # another writer may remove it too
            if time.time() - leftover.stat().st_mtime < _ABANDONED:
                continue
            if leftover.is_dir():
                shutil.rmtree(leftover)
            else:
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
