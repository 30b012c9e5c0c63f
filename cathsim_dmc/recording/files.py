"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str], suffix: str) -> Iterator[Path]:
    """Yield a temporary path that becomes ``path`` when the block ends well.

    The temporary file lies in the same directory, so the final rename is atomic; it
    is removed when the block raises, and an older ``path`` then stays as it was.

    Raises:
        ValueError: if ``path`` does not end in ``suffix``.
        FileNotFoundError: if the directory does not exist.
        RuntimeError: if the block ends without having written anything.
    """
    path = Path(path)
    if path.suffix != suffix:
        raise ValueError(f"the file name must end in {suffix}, got {path.name!r}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"no directory {path.parent}; create it first")
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}.partial")
    try:
        yield temporary
        if not temporary.is_file():
            raise RuntimeError(f"nothing was written for {path}")
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
