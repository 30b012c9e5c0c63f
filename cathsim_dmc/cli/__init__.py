"""The command `cathsim`: the module of a command is imported when it is called."""

import io
import os
import sys
from collections.abc import Callable
from typing import Any

from tyro import conf
from tyro.extras import SubcommandApp

from cathsim_dmc import __version__
from cathsim_dmc.cli import modules
from cathsim_dmc.cli.interrupts import Interrupts
from cathsim_dmc.cli.opengl import import_command
from cathsim_dmc.cli.options import BAD_INPUT, INTERRUPTED

_DESCRIPTION = (
    "Autonomous endovascular navigation: train, evaluate, record, validate. "
    "`cathsim COMMAND --help` explains a command, `cathsim --version` prints the "
    "version."
)
_LONGEST = 1500  # characters of an error
# Module and function of each command, and its summary.
COMMANDS = {
    "train": ("training:command", "Train an agent."),
    "list": ("listing:show", "List the tasks, or the devices with their properties."),
    "dataset": ("recordings:dataset", "Write labelled fluoroscopy as a dataset."),
    "eval": ("agents:evaluate", "Evaluate a policy: success, reward, forces."),
    "table": ("result_tables:table", "Compare evaluations as a table in Markdown."),
    "submit": ("agents:submit", "Write a file for the leaderboard."),
    "record": ("agents:record", "Record one episode: as a Rerun file, or as a film."),
    "demos": ("agents:demos", "Write demonstrations of the expert as a dataset."),
    "replay": ("recordings:replay", "Open a recording in the Rerun viewer."),
    "replay-error": (
        "recordings:replay_error",
        "Repeat the control step of a physics error.",
    ),
    "play": ("agents:play", "Cannulate by hand, with the forces on the screen."),
    "upload": ("sharing:upload", "Upload a policy or a dataset to a hub."),
    "serve": ("bridging:serve", "Serve a task as a device over TCP."),
    "drive": ("bridging:drive", "Drive a device over TCP with a trained policy."),
    "doctor": ("checks:doctor", "Check the installation; list remedies."),
    "export": ("exporting:export", "Write a scene as MJCF, or a policy as ONNX."),
    "phantom": ("phantoms:phantoms", "Import, build, check and export anatomies."),
    "validate": ("checks:validate", "Compare the physics with theory."),
    "benchmark": ("checks:benchmark", "Measure the speed on this machine."),
}


def main() -> None:
    """Run the command line."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Its encoding may lack signs such as µ.
        sys.stdout.reconfigure(errors="backslashreplace")
    interrupts = Interrupts()
    try:
        _require_here()
        code = _run(sys.argv[1:])
        if out := sys.stdout:  # None where it is closed
            out.flush()
    except BrokenPipeError:
        # The reader, such as `head`, has closed the pipe; do not flush again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except KeyboardInterrupt:
        code = _interrupted(interrupts)
    except (ValueError, OSError, RuntimeError, ImportError, ArithmeticError,
            MemoryError) as error:  # fmt: skip
        # Errors with a message for the user; others are bugs and keep their traceback.
        # An interrupt may make an import fail.
        code = _interrupted(interrupts) if interrupts.came else _refused(error)
    sys.exit(code)


def _interrupted(interrupts: Interrupts) -> int:
    interrupts.handled()
    print("cathsim: interrupted", file=sys.stderr)
    return INTERRUPTED


def _refused(error: Exception) -> int:
    told = "; ".join([str(error), *getattr(error, "__notes__", ())])
    text = " ".join(told.split()) or "no message"
    if len(text) > _LONGEST:  # as a name of thousands of characters makes it
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    print(f"cathsim: {type(error).__name__}: {text}", file=sys.stderr)
    return BAD_INPUT


def _require_here() -> None:
    """Raises FileNotFoundError if the current folder has been deleted."""
    try:
        os.getcwd()
    except FileNotFoundError as error:
        text = "the current folder has been deleted; change to another one (cd)"
        raise FileNotFoundError(text) from error


def _run(arguments: list[str]) -> int:
    if arguments == ["--version"]:
        print(f"cathsim-dmc {__version__}")
        return 0
    app = SubcommandApp()
    for name, (where, summary) in COMMANDS.items():
        command: Any = _line(summary)
        if arguments[:1] == [name]:
            module, _, function = where.partition(":")
            own = modules.Own.of(arguments)
            found = import_command(f"cathsim_dmc.cli.{module}", arguments)
            own.load()
            command = getattr(found, function)
            if name == "train":  # its options depend on its arguments
                command = command(arguments[1:])
        app.command(command, name=name)
    return app.cli(
        prog="cathsim", description=_DESCRIPTION, config=(conf.OmitArgPrefixes,)
    )


def _line(summary: str) -> Callable[[], int]:
    """Returns a placeholder for a command that is only listed."""

    def listed() -> int:
        raise AssertionError("another command is called")

    listed.__doc__ = summary
    return listed
