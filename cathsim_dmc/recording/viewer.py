"""Opening recordings in the viewer of the installed Rerun package."""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from urllib.parse import quote

# First bytes of every recording of the current format.
_MAGIC = b"RRF2"
# Near the end of every whole one, before four bytes of a checksum.
_FOOTER, _FOOTER_AT = b"RRF2FOOT", -12
_SUFFIX = ".rrd"
LOOPBACK = "127.0.0.1"
WEB_PORT = 9090


class ViewerError(RuntimeError):
    """The viewer cannot be opened; the message says how to mend it."""


def check_recording(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of a recording after looking at both of its ends.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a Rerun recording, or only the beginning of one.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no recording at {path}")
    with open(path, "rb") as stream:
        start = stream.read(len(_MAGIC))
        stream.seek(0, os.SEEK_END)
        stream.seek(max(0, stream.tell() + _FOOTER_AT))
        end = stream.read(len(_FOOTER))
    if path.suffix != _SUFFIX or start != _MAGIC:
        raise ValueError(
            f"{path} is not a Rerun recording (*{_SUFFIX}); write one with write_rrd, "
            "or bring an older one up to date with `rerun rrd migrate`"
        )
    if end != _FOOTER:
        raise ValueError(
            f"{path} is cut off: the end of a recording is missing; record it again, "
            "or complete one that an older Rerun wrote with `rerun rrd migrate`"
        )
    return path.resolve()


def viewer_command(path: Path) -> list[str]:
    """Return the command that opens a recording in a window of its own."""
    return [_executable(), str(path), "--new", "--bind", LOOPBACK]


def serve_command(path: Path, host: str, port: int, data_port: int) -> list[str]:
    """Return the command that serves a recording to browsers.

    Args:
        path: The recording.
        host: Address to listen on, for the web page and for the data.
        port: Port of the web page.
        data_port: Port of the data that the page loads.
    """
    ports = ["--port", str(data_port), "--web-viewer-port", str(port)]
    return [_executable(), str(path), "--serve-web", "--bind", host, *ports]


def web_address(host: str, port: int, data_port: int) -> str:
    """Return the address to type into a browser while a recording is served."""
    data = quote(f"rerun+http://{host}:{data_port}/proxy", safe="")
    return f"http://{host}:{port}?url={data}"


def has_display(environment: Mapping[str, str] | None = None) -> bool:
    """Whether the environment variables name a display."""
    if not sys.platform.startswith("linux"):
        return True
    environment = os.environ if environment is None else environment
    return any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def open_viewer(
    path: str | os.PathLike[str],
    *,
    web: bool = False,
    host: str = LOOPBACK,
    port: int = WEB_PORT,
    announce: Callable[[str], None] | None = None,
) -> int:
    """Open a recording in the Rerun viewer and wait until it is closed.

    Args:
        path: A ``.rrd`` file.
        web: Serve a web viewer until interrupted, for machines without a display.
        host: Address to serve on; the default is reachable from this machine only.
        port: Port of the web page.
        announce: Called with the address to open in a browser before serving.

    Returns:
        The exit status of the viewer.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a Rerun recording.
        ViewerError: if Rerun is not installed, a window is asked for where there is
            no display, or the port is taken.
    """
    recording = check_recording(path)
    if not web and not has_display():
        raise ViewerError(
            f"no display to open {recording.name} on; serve it with web=True (in the "
            "shell: --web) and open the address in a browser, or copy the file to a "
            "machine with a screen"
        )
    command = viewer_command(recording)
    if web:
        data_port = _checked_ports(host, port)
        command = serve_command(recording, host, port, data_port)
        if announce is not None:
            announce(web_address(host, port, data_port))
    # `announce` has given the address already.
    return _wait(command, {"RUST_LOG": "warn", **os.environ})


def _wait(command: list[str], environment: Mapping[str, str]) -> int:
    """Runs a command until it ends; it ends with this process at Ctrl-C and SIGTERM."""

    def stop(number: int, frame: object) -> None:
        raise SystemExit(128 + number)

    handled = threading.current_thread() is threading.main_thread()
    previous = signal.signal(signal.SIGTERM, stop) if handled else None
    try:
        with subprocess.Popen(command, env=environment) as process:
            try:
                return process.wait()
            finally:
                process.terminate()
    except KeyboardInterrupt:
        # Ctrl-C is how serving ends.
        return 0
    finally:
        if handled:
            signal.signal(signal.SIGTERM, previous)


def _executable() -> str:
    """The viewer of this interpreter's package: of the version of the recordings."""
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise ViewerError("the Rerun viewer is missing; pip install rerun-sdk")
    names = ("Rerun.app/Contents/MacOS/Rerun", "rerun.exe", "rerun")
    for path in (Path(found.origin).parent / name for name in names):
        if path.exists():
            return str(path)
    raise ViewerError("the Rerun viewer is missing; install rerun-sdk again")


def _checked_ports(host: str, port: int) -> int:
    """Return a free port for the data after making sure that ``port`` is free."""
    with socket.socket() as page, socket.socket() as data:
        page.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            page.bind((host, port))
        except OSError as error:
            raise ViewerError(
                f"cannot serve on {host}:{port} ({error.strerror}); choose another port"
            ) from error
        data.bind((host, 0))
        return data.getsockname()[1]
