"""Opening recordings in the viewer of the installed Rerun package."""

import importlib.util
import os
import socket
import sys
from pathlib import Path

from cathsim_dmc import files

# First bytes of every recording of the current format.
_MAGIC = b"RRF2"
# Near the end of every complete recording, before a checksum of four bytes.
_FOOTER, _END = b"RRF2FOOT", -4
LOOPBACK, WEB_PORT, DATA_PORT = "127.0.0.1", 9090, 9876


class ViewerError(RuntimeError):
    """The viewer cannot be opened; the message says how to mend it."""


def check_recording(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of a complete recording.

    Raises:
        OSError: there is no such file, or it is a directory.
        ValueError: the file is no complete recording of this version of Rerun.
    """
    path = files.require_source(path, "a recording (.rrd) of `cathsim record`")
    if path.suffix == ".npz":
        beside = path.with_suffix(".rrd")
        way = f"the viewer opens the recording beside them, {beside}"
        if not beside.is_file():
            way = "no recording is beside them; `cathsim record POLICY --out FILE.rrd` "
            way += "writes both"
        raise ValueError(f"{path} holds the arrays of an episode; {way}")
    with path.open("rb") as stream:
        begin = stream.read(len(_MAGIC))
        stream.seek(max(path.stat().st_size - len(_FOOTER) + _END, 0))
        end = stream.read()
    if begin != _MAGIC or end[:_END] != _FOOTER:
        raise ValueError(
            f"{path} is not a whole Rerun recording of this version; record it again, "
            "or bring an older one up to date with `rerun rrd migrate`"
        )
    return path.resolve()


def open_viewer(
    path: str | os.PathLike[str],
    *,
    web: bool = False,
    port: int = WEB_PORT,
    data_port: int | None = None,
) -> None:
    """Replace this process by the Rerun viewer of a recording; does not return.

    Args:
        path: path of the .rrd file.
        web: whether to serve it to a browser; the viewer prints the address.
        port: port of the web page.
        data_port: port from which the page reads the data; a browser on another machine
            needs both, see docs/how-to.md. None takes 9876, or another one if it is
            taken; the printed address names it.

    Raises:
        OSError, ValueError: see `check_recording`.
        ViewerError: there is no viewer, no display for its window, or a port is taken.
    """
    recording = check_recording(path)
    named = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not (web or named):
        raise ViewerError(
            f"no display to open {recording.name} on; serve it with web=True (in the "
            "shell: --web) and open the address in a browser, or copy the file to a "
            "machine with a screen"
        )
    found = importlib.util.find_spec("rerun_cli")
    folder = Path(found.origin).parent if found and found.origin else Path()
    # The viewer of the installed package has the version of the recordings.
    names = ("Rerun.app/Contents/MacOS/Rerun", "rerun.exe", "rerun")
    viewer = next((folder / one for one in names if (folder / one).is_file()), None)
    if not found or viewer is None:
        raise ViewerError("the Rerun viewer is missing; pip install rerun-sdk")
    how = ["--new"] if data_port is None else ["--port", str(data_port)]
    if web:
        how += ["--serve-web", "--web-viewer-port", str(port)]
        if port == (data_port or DATA_PORT):
            raise ViewerError(
                f"port is {port}, as is the port of the data; give another one "
                f"(--port {port + 1})"
            )
        _require_free("port", port)
        if data_port is not None:
            _require_free("data_port", data_port)
    command = [str(viewer), str(recording), "--bind", LOOPBACK, *how]
    os.execve(viewer, command, {"RUST_LOG": "warn,re_sdk=info", **os.environ})


def _require_free(name: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            option = name.replace("_", "-")
            raise ViewerError(
                f"{name} {port} cannot be used ({error.strerror}); give another one "
                f"(--{option} {port + 1})"
            ) from error
