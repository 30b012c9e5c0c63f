"""Pictures as an MP4 for slides; needs the extra `mp4`."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Sequence
from fractions import Fraction

from PIL import Image

SUFFIX = ".mp4"
# Of H.264: 0 keeps everything, 23 is the usual choice; text stays sharp at 20.
_QUALITY = "20"


def require_encoder() -> None:
    """Raise ImportError if PyAV is not installed."""
    if importlib.util.find_spec("av") is None:
        raise ImportError(
            "an MP4 needs PyAV: pip install 'cathsim-dmc[mp4]'; a .webp or .gif film "
            "needs nothing more"
        )


def write_mp4(
    path: str | os.PathLike[str],
    pictures: Sequence[Image.Image],
    tick: int,
    hold: int,
) -> None:
    """Write pictures of one size as H.264, which every slide program plays.

    Args:
        pictures: RGB pictures, at least one.
        tick: Time that each is shown, ms.
        hold: Time that the last one is shown, ms.

    Raises:
        ImportError: PyAV is not installed.
    """
    require_encoder()
    import av

    # Colours are coded for two by two pixels.
    width, height = (side - side % 2 for side in pictures[0].size)
    with av.open(str(path), "w", format="mp4") as file:
        stream = file.add_stream("libx264", rate=Fraction(1000, tick))
        stream.width, stream.height = width, height
        stream.pix_fmt, stream.options = "yuv420p", {"crf": _QUALITY}
        for picture in [*pictures, *[pictures[-1]] * (hold // tick)]:
            frame = av.VideoFrame.from_image(picture.crop((0, 0, width, height)))
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
