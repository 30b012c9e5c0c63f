"""Locks that keep other processes from writing the same folder or file."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from cathsim_dmc import files


@contextlib.contextmanager
def only_process(
    lock_file: str | os.PathLike[str], kind: type[Exception], text: str
) -> Iterator[None]:
    """Hold a lock for the block; a killed process releases it.

    Args:
        lock_file: File of the lock, which stays.
        kind: Error that is raised where another process holds the lock.
        text: Its message.
    """
    lock = FileLock(lock_file)
    with files.refused(kind, text, Timeout):
        lock.acquire(blocking=False)
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def only_writer(path: Path) -> Iterator[None]:
    """Reserve the path of a directory that the block writes at its end.

    What a process that was killed has left of it is removed, and what one that does
    not reserve the path is writing there.

    Raises:
        FileExistsError: another process has reserved it.
        OSError: the directory around it is missing or read-only.
    """
    files.require_folder(path.parent)
    lock_file = path.with_name(f".{path.name}.lock")
    text = f"another process writes {path}; wait for its end, or choose another name"
    with only_process(lock_file, FileExistsError, text):
        try:
            for left in filter(Path.is_dir, files.unfinished(path)):
                shutil.rmtree(left)
            yield
        finally:
            with contextlib.suppress(OSError):
                lock_file.unlink()
