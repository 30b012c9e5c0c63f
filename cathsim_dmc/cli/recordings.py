"""`cathsim dataset`, `replay` and `replay-error`."""

from pathlib import Path
from typing import Annotated

from tyro import conf

from cathsim_dmc import bounds
from cathsim_dmc.cli.options import (
    CHECK_FAILED,
    Json,
    Modules,
    Ray,
    print_json,
    say,
    told_of_losses,
)
from cathsim_dmc.recording import viewer
from cathsim_dmc.recording.image_set import ImageSetOptions, write
from cathsim_dmc.tasks.snapshot import versions


def dataset(
    out: Annotated[Path, conf.Positional],
    /,
    processes: int | None = None,
    ray: Ray = False,
    json: Json = False,
    *,
    options: Annotated[ImageSetOptions, conf.arg(name=""), conf.UseAppendAction],
) -> int:
    """Write labelled fluoroscopy: images, masks, keypoints, forces.

    Of random arches, or of the anatomies that are given.

    Args:
        out: Folder of the dataset; the same command continues an interrupted run.
        processes: Number of processes; one per core by default.
        options: Content of the dataset.
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
    port: int | None = None,
    data_port: int | None = None,
) -> int:
    """Open a recording in the Rerun viewer.

    Args:
        recording: Path of an .rrd file.
        web: Whether to serve it to a browser instead of opening a window.
        port: Port of the web page; by default 9090.
        data_port: Port that the page reads the recording from; by default 9876, or
            another one if it is taken. A browser on another machine needs both ports:
            ssh -L 9090:localhost:9090 -L 9876:localhost:9876 MACHINE
    """
    for name, one in {"port": port, "data_port": data_port}.items():
        if one is not None:
            bounds.whole(name, one, 1, 65535)
    if port is not None and not web:
        raise ValueError(f"--port is {port}, the port of a web page; add --web")
    port = viewer.WEB_PORT if port is None else port
    viewer.open_viewer(recording, web=web, port=port, data_port=data_port)
    return 0


def replay_error(
    file: Annotated[Path, conf.Positional], /, json: Json = False, modules: Modules = ()
) -> int:
    """Repeat the control step of a physics error; report whether it fails again.

    Args:
        file: File of a folder `errors` of a training or an evaluation.
    """
    from cathsim_dmc.simulation.error_files import PhysicsError

    error = PhysicsError.load(file)
    step, now = error.replay(), versions()
    found, force = step.errors[0], float(step.wall_force.peak_max[0])
    same = found == error.reason
    if json:
        check = {"name": "same error", "value": found, "unit": "", "passed": same}
        print_json(
            {
                "checks": [{**check, "bound": error.reason}],
                "task": error.task,
                "options": dict(error.options),
                "largest_contact_N": force,
                "versions": {"file": dict(error.snapshot.versions), "now": now},
            }
        )
    else:
        steps = int(error.snapshot.arrays["rollout.steps"][0]) + 1
        print(f"{error.task} {dict(error.options)}, control step {steps}")
        print(f"it failed by: {error.reason}; now: {found or 'no error'}")
        print(f"largest contact {force:.3g} N in a physics step")
        if now != error.snapshot.versions:
            print(f"versions then {dict(error.snapshot.versions)}, now {now}")
    return 0 if same else CHECK_FAILED
