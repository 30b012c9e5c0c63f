import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
import rerun_cli
from recording_samples import make_episode, make_tube

from cathsim_dmc.recording import viewer
from cathsim_dmc.recording.rerun_log import write_rrd
from cathsim_dmc.recording.viewer import ViewerError, check_recording, open_viewer


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("rrd") / "e.rrd"
    return write_rrd(make_episode(3), make_tube(), path)


@pytest.fixture
def commands(monkeypatch):
    started = []

    def wait(command):
        started.append(command)
        return 3

    monkeypatch.setattr(viewer, "_wait", wait)
    return started


def test_only_recordings_are_opened(recording, tmp_path):
    assert check_recording(recording) == recording.resolve()
    with pytest.raises(FileNotFoundError, match="no recording"):
        check_recording(tmp_path / "e.rrd")
    other = tmp_path / "e.rrd"
    other.write_text("hello")
    with pytest.raises(ValueError, match="not a Rerun recording"):
        check_recording(other)


def test_no_display_is_an_error_that_names_the_way_out(
    recording, commands, monkeypatch
):
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ViewerError, match="--web"):
        open_viewer(recording)
    assert commands == []
    monkeypatch.setenv("DISPLAY", ":0")
    assert open_viewer(recording) == 3
    ((executable, *arguments),) = commands
    assert Path(executable).parent == Path(rerun_cli.__file__).parent
    assert arguments == [str(recording.resolve()), "--bind", "127.0.0.1", "--new"]


def test_serving_needs_no_display_but_a_free_port(recording, commands, monkeypatch):
    monkeypatch.setattr(viewer, "has_display", lambda: False)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ViewerError, match="choose another port"):
            open_viewer(recording, web=True, port=port)
    assert commands == []
    addresses = []
    open_viewer(recording, web=True, port=port, announce=addresses.append)
    (command,) = commands
    data_port = command[command.index("--port") + 1]
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert addresses[0].startswith(f"http://127.0.0.1:{port}?url=rerun")
    assert f"%3A{data_port}%2F" in addresses[0]


def answer(port):
    """Text of the page at a port, or None."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as page:
            return page.read().decode()
    except OSError:
        return None


@pytest.mark.parametrize(
    ("name", "status"), [("SIGINT", 0), ("SIGTERM", 128 + signal.SIGTERM)]
)
def test_a_browser_gets_a_page_until_the_command_ends(recording, name, status):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    code = (
        # A shell starts what runs in the background deaf to Ctrl-C.
        "import signal, sys; "
        "signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from cathsim_dmc.recording import open_viewer; "
        f"sys.exit(open_viewer({str(recording)!r}, web=True, port={port}))"
    )
    server = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        deadline = time.monotonic() + 20
        while (text := answer(port)) is None:
            assert server.poll() is None and time.monotonic() < deadline
            time.sleep(0.1)
        assert "Rerun" in text
        # To the command alone: its children end with it.
        server.send_signal(signal.Signals[name])
        assert server.wait(timeout=20) == status
        assert answer(port) is None
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)
