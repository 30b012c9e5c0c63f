"""Formats of film files, and the encoder of MP4."""

import contextlib
import errno
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cathsim_dmc import extras
from cathsim_dmc.files import atomic_path

MP4 = ".mp4"  # needs the extra `video`
SUFFIXES = (".gif", ".webp", MP4)
# Constant rate factor of H.264: 0 is lossless, 23 is the default; letters stay sharp at
# 20.
_RATE_FACTOR = "20"


def check_film(path: Path) -> None:
    """Raise ValueError or ImportError unless a film of this name can be written."""
    if path.suffix not in SUFFIXES:
        raise ValueError(f"a film is a {' or '.join(SUFFIXES)} file, not {path.name}")
    if path.suffix == MP4:
        extras.require("video", "imageio_ffmpeg")


def write_mp4(path: Path, pictures: Sequence[np.ndarray], tick: int, hold: int) -> Path:
    """Write pictures as H.264 in an MP4 file, whole or not at all.

    Args:
        pictures: RGB pictures (rows, columns, 3) uint8 of one size, at least one.
        tick: Time that each is shown, ms.
        hold: Time that the last one is shown longer, ms.

    Raises:
        OSError: the film cannot be written, as on a full disk.
    """
    import imageio_ffmpeg

    # Colours are coded for two by two pixels.
    rows, columns = (side - side % 2 for side in pictures[0].shape[:2])
    held = [pictures[-1]] * (hold // tick)
    with atomic_path(path, MP4) as temporary:
        film = imageio_ffmpeg.write_frames(
            temporary, (columns, rows), fps=1000 / tick, codec="libx264",
            quality=None, macro_block_size=2, ffmpeg_log_level="error",
            output_params=["-crf", _RATE_FACTOR, "-f", "mp4"],
        )  # fmt: skip
        film.send(None)  # starts the encoder
        with contextlib.suppress(OSError):  # the encoder has ended before
            for picture in [*pictures, *held]:
                film.send(np.ascontiguousarray(picture[:rows, :columns]))
        film.close()
        _require_whole(temporary, len(pictures) + len(held))
    return path


def _require_whole(path: Path, count: int) -> None:
    """Raise OSError unless a film has `count` pictures; the encoder does not check."""
    import imageio_ffmpeg

    try:
        found, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError:  # it lacks its end
        found = 0
    if found != count:
        text = f"the encoder has written {found} of {count} pictures, as on a full disk"
        raise OSError(errno.EIO, text)
