"""Opening recordings in the viewer of the installed Rerun package."""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

# First bytes of every recording of the current format.
_MAGIC = b"RRF2"
# Near the end of every whole one, before four bytes of a checksum.
_FOOTER, _END = b"RRF2FOOT", -4
_SUFFIX = ".rrd"
LOOPBACK, WEB_PORT = "127.0.0.1", 9090


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
    data = path.read_bytes()
    if path.suffix != _SUFFIX or not data.startswith(_MAGIC):
        raise ValueError(
            f"{path} is not a Rerun recording (*{_SUFFIX}); write one with write_rrd, "
            "or bring an older one up to date with `rerun rrd migrate`"
        )
    if not data[:_END].endswith(_FOOTER):
        raise ValueError(
            f"{path} is cut off: the end of a recording is missing; record it again, "
            "or complete one that an older Rerun wrote with `rerun rrd migrate`"
        )
    return path.resolve()


def has_display() -> bool:
    """Whether there is a display to open a window on."""
    named = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return bool(named) or not sys.platform.startswith("linux")


def open_viewer(
    path: str | os.PathLike[str],
    *,
    web: bool = False,
    port: int = WEB_PORT,
    announce: Callable[[str], None] | None = None,
) -> int:
    """Open a recording in the Rerun viewer and wait until it is closed.

    Args:
        path: A ``.rrd`` file.
        web: Serve a web viewer until interrupted, for machines without a display.
        port: Port of the web page, which is reachable from this machine only.
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
    command = [_executable(), str(recording), "--bind", LOOPBACK]
    if not web:
        return _wait([*command, "--new"])
    data_port = _checked_ports(port)
    if announce is not None:
        data = quote(f"rerun+http://{LOOPBACK}:{data_port}/proxy", safe="")
        announce(f"http://{LOOPBACK}:{port}?url={data}")
    ports = ["--port", str(data_port), "--web-viewer-port", str(port)]
    return _wait([*command, "--serve-web", *ports])


def _wait(command: list[str]) -> int:
    """Runs a command until it ends; it ends with this process at Ctrl-C and SIGTERM."""

    def stop(number: int, frame: object) -> None:
        raise SystemExit(128 + number)

    handled = threading.current_thread() is threading.main_thread()
    previous = signal.signal(signal.SIGTERM, stop) if handled else None
    # `announce` has given the address already.
    environment = {"RUST_LOG": "warn", **os.environ}
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
    folder = Path(found.origin).parent if found and found.origin else Path()
    for name in ("Rerun.app/Contents/MacOS/Rerun", "rerun.exe", "rerun"):
        if found and (folder / name).exists():
            return str(folder / name)
    raise ViewerError("the Rerun viewer is missing; pip install rerun-sdk")


def _checked_ports(port: int) -> int:
    """Return a free port for the data after making sure that ``port`` is free."""
    with socket.socket() as page, socket.socket() as data:
        page.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            page.bind((LOOPBACK, port))
        except OSError as error:
            raise ViewerError(
                f"cannot serve on port {port} ({error.strerror}); choose another port"
            ) from error
        data.bind((LOOPBACK, 0))
        return data.getsockname()[1]
