"""Atomic writing of files, checks of paths, and safe reading of archives."""

import contextlib
import errno
import glob
import json
import math
import os
import shutil
import tempfile
import uuid
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import bounds

_PARTIAL = ".partial"
# Largest unpacked size of a file: bytes, or multiple of its size, whichever is larger.
# Positions and forces compress to a third or less, zeros to a thousandth.
_UNPACKED, _RATIO = 2**28, 100
_BLOCK = 2**20  # bytes
_HEADER_1 = np.lib.format.read_array_header_1_0
_HEADER_2 = np.lib.format.read_array_header_2_0


def as_path(name: str, value: Any) -> Path:
    """Return the path of a file or folder; ValueError for other values than paths."""
    if not isinstance(value, str | os.PathLike):
        bounds.refuse(name, value, "a path, a str or a pathlib.Path")
    return Path(value)


@contextlib.contextmanager
def atomic_path(
    path: str | os.PathLike[str], suffix: str | None = None
) -> Iterator[Path]:
    """Yield a temporary path, which is renamed to `path` when the block succeeds.

    The temporary file lies in the same directory. When the block raises, it is removed
    and an older `path` stays as it was. If several processes write one path, all
    succeed, and the last content stays.

    Args:
        suffix: Ending that `path` must have, such as ".npz"; None allows any.

    Raises:
        ValueError: if `path` does not end in `suffix`.
        OSError: see `require_file`.
        RuntimeError: if the block ends without having written anything.
    """
    path = as_path("path", path)
    if suffix is not None and path.suffix != suffix:
        raise ValueError(f"the file name must end in {suffix}, got {path.name!r}")
    _check_folder(path.parent)
    _check_target(path)
    temporary = _temporary(path)
    _create(temporary)  # raises before the work, not after it
    try:
        with naming(path):
            yield temporary
            if not temporary.is_file() or not temporary.stat().st_size:
                raise RuntimeError(f"nothing was written for {path}")
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_directory(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary directory, which is renamed to `path` on success.

    When the block raises, the temporary directory is removed.

    Raises:
        OSError: if `path` exists with something in it, or cannot be written.
    """
    path = as_path("path", path)
    require_folder(path.parent)
    temporary = _temporary(path)
    temporary.mkdir()
    try:
        with naming(path):
            yield temporary
        try:
            os.rename(temporary, path)
        except OSError as error:
            if not path.exists():
                raise
            raise FileExistsError(
                f"{path} has been made by another process meanwhile; remove it, or "
                "choose another directory"
            ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def require_folder(folder: str | os.PathLike[str], make: bool = False) -> Path:
    """Check that a folder takes new files, before work is done for it; return its path.

    Args:
        make: Whether to create the folder and its parents if they are missing.

    Raises:
        FileNotFoundError: the folder is missing and `make` is False.
        NotADirectoryError: the folder or one of its parents is a file.
        PermissionError: it is read-only, or takes no new file for another reason.
    """
    folder = as_path("folder", folder)
    if make:
        require_place(folder)
        with contextlib.suppress(FileExistsError):  # a file, see below
            folder.mkdir(parents=True, exist_ok=True)
    _check_folder(folder)
    probe = _temporary(folder / "probe")
    _create(probe)  # permission bits do not tell on network folders and /proc
    probe.unlink()
    return folder


def _check_folder(folder: Path) -> None:
    """Raise the errors of `require_folder` that show without creating a file."""
    if not folder.is_dir():
        if folder.exists():
            raise NotADirectoryError(f"{folder} is a file; give a directory (--out)")
        _refuse_home(folder)
        raise FileNotFoundError(f"no directory {folder}; create it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(
            f"{folder} cannot be written to: it is read-only for this user; choose "
            f"another directory, or allow it (chmod u+wx {folder})"
        )


def _refuse_home(folder: Path) -> None:
    """Raise FileNotFoundError for `~/data` where a folder `~` would be made."""
    meant = os.path.expanduser(folder)
    if meant != str(folder) and not Path(folder.parts[0]).exists():
        raise FileNotFoundError(
            f"no directory {folder}: only a shell takes {folder.parts[0]} for the home "
            f"directory; give {meant}"
        )


def _create(path: Path) -> None:
    """Create an empty file; PermissionError if its folder takes none."""
    try:  # not tempfile, whose files only their owner may read
        open(path, "xb").close()
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:  # no fault of the folder
            raise
        text = f"{path.parent} cannot be written to: {error.strerror}"
        raise PermissionError(f"{text}; choose another one") from error


def require_place(folder: str | os.PathLike[str]) -> Path:
    """Check that a folder takes new files or could be created; return its path.

    Raises:
        OSError: as `require_folder`, for the folder or its nearest existing parent.
    """
    place = as_path("folder", folder)
    _refuse_home(place)
    while not (place.exists() or place.is_symlink()) and place != place.parent:
        place = place.parent
    require_folder(place)
    return Path(folder)


def require_file(
    path: str | os.PathLike[str], make: bool = False, later: bool = False
) -> Path:
    """Check that a file can be written or replaced; return its path.

    Args:
        make: Whether to create its folder if it is missing.
        later: Whether its folder may be missing, to be created with the file.

    Raises:
        OSError: as `require_folder`; IsADirectoryError if `path` is a directory.
        ValueError: `path` is a device or a pipe, which a new file would replace.
    """
    path = as_path("path", path)
    require_place(path.parent) if later else require_folder(path.parent, make)
    _check_target(path)
    return path


def _check_target(path: Path) -> None:
    """Raise the errors of `require_file` that concern the file itself."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a directory; give a file name in it")
    _refuse_special(path)


def _refuse_special(path: str | os.PathLike[str]) -> None:
    """Raise ValueError for a device, whose data may never end, or a pipe."""
    path = as_path("path", path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError(f"{path} is a device or a pipe; give the name of a file")


def require_source(path: str | os.PathLike[str], what: str) -> Path:
    """Check that a file to read is there; return its path.

    Args:
        what: What to give instead, for the message: "a file of ...".

    Raises:
        FileNotFoundError, IsADirectoryError: there is no such file, or it is a
            directory.
        ValueError: it is a device or a pipe.
    """
    path = as_path("path", path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a directory; give {what}")
    if not path.exists():
        raise FileNotFoundError(f"no file {path}; give {what}")
    _refuse_special(path)
    return path


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the UTF-8 text of a file, with or without a byte order mark of Windows.

    ValueError for a device or a pipe.
    """
    _refuse_special(path)
    return Path(path).read_text(encoding="utf-8-sig")


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Add the path to an OSError of the block that names none, as on a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise


@contextlib.contextmanager
def refused(
    kind: type[Exception],
    text: str,
    errors: type[Exception] | tuple[type[Exception], ...],
) -> Iterator[None]:
    """Raise errors of the block as `kind`, with one line: `text` and their message."""
    try:
        yield
    except errors as error:
        line = " ".join(str(error).split())[:1000] or type(error).__name__
        raise kind(f"{text}: {line}") from error


def write_bytes(path: str | os.PathLike[str], data: bytes) -> Path:
    """Write a file atomically, see `atomic_path`; return its path."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return Path(path)


def write_text(path: str | os.PathLike[str], text: str) -> Path:
    """Write UTF-8 text atomically, see `atomic_path`; return its path."""
    return write_bytes(path, text.encode())


def write_json(path: str | os.PathLike[str], values: Any) -> Path:
    """Write values as JSON atomically, see `atomic_path`; return its path."""
    return write_text(path, json.dumps(values, indent=2) + "\n")


def write_result(path: Path, write: Callable[[Path], Any], result: str) -> None:
    """Call `write(path)`, and where that fails `write` in a new temporary folder.

    For results of long computations. The folder around `path` is created.

    Args:
        write: Function that writes a file or directory at a path.
        result: What is written, for the error: "the anatomy of a.stl".

    Raises:
        OSError: that of `write(path)`, with a note that says where the result is.
    """
    try:
        require_folder(path.parent, make=True)
        write(path)
    except OSError as error:
        error.add_note(_kept(path, write, result))
        raise


def _kept(path: Path, write: Callable[[Path], Any], result: str) -> str:
    """Write a result in a temporary folder; return what to tell of it."""
    folder: str | None = None
    try:
        folder = tempfile.mkdtemp(prefix="cathsim-")
        write(Path(folder, path.name))
    except Exception as error:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        return f"{result} is not kept, not as a temporary file either: {error}"
    return f"{result} is kept in {folder}; move it to {path.parent}"


def fill(path: str | os.PathLike[str], size: int) -> None:
    """Write `size` random bytes, which no file system compresses.

    Called before a writer such as HDF5, which a full disk crashes without an error.

    Raises:
        OSError: the disk or the quota is full.
    """
    block = os.urandom(min(size, _BLOCK))
    with open(path, "wb") as file:
        for start in range(0, size, _BLOCK):
            file.write(block[: size - start])


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}{_PARTIAL}")


def unfinished(path: Path) -> list[Path]:
    """Return temporary files and directories of writers of `path`, alive or dead."""
    digits = "[0-9a-f]" * 12
    return [*path.parent.glob(f".{glob.escape(path.name)}.{digits}{_PARTIAL}")]


def require_room(unpacked: int, stored: int) -> None:
    """Refuse a file that unpacks to far more than its size, before it is unpacked.

    Args:
        unpacked: Size in memory, bytes.
        stored: Size of the file, bytes.

    Raises:
        ValueError: if it unpacks to more than 268 MB and to more than 100 times its
            size.
    """
    most = max(_UNPACKED, _RATIO * stored)
    if unpacked > most:
        raise ValueError(
            f"it unpacks to {unpacked / 1e6:,.0f} MB from a file of "
            f"{stored / 1e6:,.1f} MB; at most {most / 1e6:,.0f} MB are read"
        )


def read_arrays(
    path: str | os.PathLike[str], names: Iterable[str] | None = None
) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz archive by name, all or those in `names`.

    No pickle is read.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no archive, is damaged, lacks an array, or unpacks to far
            more than its size, see `require_room`.
    """
    try:
        _refuse_special(path)
        with open(path, "rb") as stream, zipfile.ZipFile(stream) as archive:
            wanted = [f"{name}.npy" for name in names or ()] or archive.namelist()
            there = {*archive.namelist()}
            if lost := [name[:-4] for name in wanted if name not in there]:
                raise ValueError(f"it lacks the array {lost[0]!r}")
            held = [archive.getinfo(name) for name in wanted]
            stored = os.fstat(stream.fileno()).st_size
            require_room(sum(one.file_size for one in held), stored)
            return {
                one.filename.removesuffix(".npy"): _array(archive, one) for one in held
            }
    except FileNotFoundError:
        raise
    except Exception as error:  # zipfile and numpy fail in many ways
        text = " ".join(str(error).split())
        raise ValueError(text or type(error).__name__) from error


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    """Return the array of an entry; ValueError if its header claims more data."""
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{entry.filename} is packed in a way that numpy does not use")
    with archive.open(entry) as stream:
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): _HEADER_1, (2, 0): _HEADER_2}.get(version)
        if read is None:
            raise ValueError(f"{entry.filename} has the version {version}")
        shape, _, dtype = read(stream)
    if math.prod(shape) * max(dtype.itemsize, 1) > entry.file_size:
        raise ValueError(f"{entry.filename} holds less than its shape {shape}")
    with archive.open(entry) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)
