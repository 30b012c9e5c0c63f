"""`cathsim dataset` and `replay`."""

from pathlib import Path
from typing import Annotated

from tyro import conf

from cathsim_dmc import bounds
from cathsim_dmc.cli.options import Json, Ray, print_json, say, told_of_losses
from cathsim_dmc.recording import viewer
from cathsim_dmc.recording.image_set import ImageSetOptions, write


def dataset(
    out: Annotated[Path, conf.Positional],
    /,
    processes: int | None = None,
    ray: Ray = False,
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
    with told_of_losses():
        done = write(out, options, processes=processes, say=say, on_cluster=ray)
    if json:
        print_json(done)
        return 0
    held = ", ".join(f"{count} {name}" for name, count in done["frames"].items())
    print(f"{held} images, {done['frames_per_second']:.0f} new ones a second: {out}")
    return 0


def replay(
    recording: Annotated[Path, conf.Positional],
    /,
    web: bool = False,
    port: int = viewer.WEB_PORT,
    data_port: int | None = None,
) -> int:
    """Open a recording in the Rerun viewer.

    Args:
        recording: Path of an .rrd file.
        web: Whether to serve it to a browser instead of opening a window.
        port: Port of the web page.
        data_port: Port that the page reads the recording from; by default 9876, or
            another one if it is taken. A browser on another machine needs both ports:
            ssh -L 9090:localhost:9090 -L 9876:localhost:9876 MACHINE
    """
    for name, one in {"port": port, "data_port": data_port}.items():
        if one is not None:
            bounds.whole(name, one, 1, 65535)
    viewer.open_viewer(recording, web=web, port=port, data_port=data_port)
    return 0
