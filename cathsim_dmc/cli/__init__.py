"""The command `cathsim`. Thin: every command imports what it needs when it runs."""

import os
import sys
from pathlib import Path
from typing import Annotated

from tyro import conf
from tyro.extras import SubcommandApp

from cathsim_dmc import __version__
from cathsim_dmc.cli import agents, training
from cathsim_dmc.cli.installation import doctor
from cathsim_dmc.cli.measurements import validate
from cathsim_dmc.cli.options import (
    BAD_INPUT,
    INTERRUPTED,
    Json,
    print_json,
)  # fmt: skip
from cathsim_dmc.cli.phantoms import phantoms

_DESCRIPTION = (
    "Autonomous endovascular navigation: train, evaluate, record, validate. "
    "`cathsim COMMAND --help` explains a command, `cathsim --version` names it."
)

app = SubcommandApp()
# First of the list of commands; what it does is put there when its arguments are known.
app.command(name="train")(training.command([]))


@app.command(name="list")
def list_tasks(devices: bool = False, json: Json = False) -> int:
    """List the tasks, or the devices with their properties.

    Args:
        devices: Whether to list the devices in place of the tasks.
    """
    from rich.console import Console
    from rich.table import Table

    if devices:
        from cathsim_dmc.cli import devices as library

        return library.show(json)
    from cathsim_dmc import suite

    lines = {name: make.__doc__.splitlines()[0] for name, make in suite.SUITE.items()}
    if json:
        print_json({"domain": suite.DOMAIN, "tasks": lines})
        return 0
    table = Table("task", "what to do", box=None)
    for name, line in lines.items():
        if not name.endswith(tuple(f"_{suffix}" for suffix in suite.COAXIAL)):
            table.add_row(name, line)
    for suffix, (_, words) in suite.COAXIAL.items():
        table.add_row(f"…_{suffix}", f"Each task but navigate, {words}.")
    Console().print(table)
    return 0


@app.command
def dataset(
    out: Annotated[Path, conf.Positional],
    /,
    anatomies: tuple[int, int, int] = (8, 2, 2),
    sequences: int = 32,
    frames: int = 32,
    views: int = 2,
    stride: int = 1,
    size: int = 128,
    vessel: str = "rigid",
    pictures: bool = False,
    seed: int = 0,
    processes: int | None = None,
    json: Json = False,
) -> int:
    """Write labelled fluoroscopy of random arches: images, masks, keypoints, forces.

    Args:
        out: Folder of the data set; an interrupted run goes on in it.
        anatomies: Number of arches in train, val and test.
        sequences: Number of motions in each anatomy.
        frames: Number of frames of a sequence.
        views: Number of C-arms that see each motion.
        stride: Control steps of 40 ms from frame to frame.
        size: Pixels along a side of an image.
        vessel: State of the vessel: rigid, silicone or living.
        pictures: Whether to write the images as PNG too, for tools of COCO.
        seed: Seed of all that is drawn.
        processes: Number of processes; one per core by default.
    """
    from cathsim_dmc.recording.image_set import ImageSetOptions, write

    done = write(
        out,
        ImageSetOptions(
            sequences, frames, views, stride, size, vessel, anatomies, pictures, seed
        ),
        processes=processes,
        say=lambda text: print(text, file=sys.stderr, flush=True),
    )
    rates = done.new / done.seconds, done.new / done.processor
    if json:
        found = {**vars(done), "path": str(out), "frames_per_second": rates[0]}
        print_json({**found, "frames_per_processor_second": rates[1]})
        return 0
    held = ", ".join(f"{count} {name}" for name, count in done.frames.items())
    print(f"{held} images, {rates[0]:.0f} new ones a second: {out}")
    return 0


agents.add_to(app)
app.command(doctor)
app.command(phantoms, name="phantom", help="Make, import and check anatomies.")
app.command(validate)


def main() -> None:
    """Run the command line."""
    try:
        code = _run(sys.argv[1:])
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader, such as `head`, has seen enough; nor may the exit flush again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except KeyboardInterrupt:
        print("cathsim: interrupted", file=sys.stderr)
        code = INTERRUPTED
    except (
        ValueError,
        OSError,
        RuntimeError,
        ImportError,
        ArithmeticError,
        MemoryError,
    ) as error:
        # Errors with a message for the user; anything else is ours, with traceback.
        text = " ".join(str(error).split()) or "no message"
        print(f"cathsim: {type(error).__name__}: {text}", file=sys.stderr)
        code = BAD_INPUT
    sys.exit(code)


def _run(arguments: list[str]) -> int:
    if arguments == ["--version"]:
        print(f"cathsim-dmc {__version__}")
        return 0
    app.command(name="train")(training.command(arguments))
    app.command(name="eval")(agents.evaluation(arguments))
    return app.cli(
        prog="cathsim",
        description=_DESCRIPTION,
        config=(conf.OmitArgPrefixes,),
    )
