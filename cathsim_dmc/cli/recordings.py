"""`cathsim dataset` and `replay`."""

from pathlib import Path
from typing import Annotated

from tyro import conf

from cathsim_dmc.cli.options import Json, print_json, say
from cathsim_dmc.recording import viewer
from cathsim_dmc.recording.image_set import ImageSetOptions, write


def dataset(
    out: Annotated[Path, conf.Positional],
    /,
    processes: int | None = None,
    json: Json = False,
    *,
    options: Annotated[ImageSetOptions, conf.arg(name="")],
) -> int:
    """Write labelled fluoroscopy of random arches: images, masks, keypoints, forces.

    Args:
        out: Folder of the data set; an interrupted run goes on in it.
        processes: Number of processes; one per core by default.
        options: Content of the data set.
    """
    done = write(out, options, processes=processes, say=say)
    if json:
        print_json(done)
        return 0
    held = ", ".join(f"{count} {name}" for name, count in done["frames"].items())
    print(f"{held} images, {done['frames_per_second']:.0f} new ones a second: {out}")
    return 0


def replay(
    recording: Annotated[Path, conf.Positional], /, web: bool = False, port: int = 9090
) -> int:
    """Open a recording in the Rerun viewer.

    Args:
        recording: Path of an .rrd file.
        web: Whether to serve it to a browser instead of opening a window.
        port: Port of the web page.
    """
    viewer.open_viewer(recording, web=web, port=port)
    return 0
