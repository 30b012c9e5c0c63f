import contextlib
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


def test_only_recordings_are_opened(recording, tmp_path):
    assert check_recording(recording) == recording.resolve()
    other = tmp_path / "e.rrd"
    with pytest.raises(FileNotFoundError, match="give a recording"):
        check_recording(other)
    other.write_text("hello")
    with pytest.raises(ValueError, match="not a whole Rerun recording"):
        check_recording(other)
    arrays = tmp_path / "e.npz"
    arrays.write_bytes(b"PK")
    with pytest.raises(ValueError, match="the viewer opens .*e.rrd"):
        check_recording(arrays)
    other.unlink()
    with pytest.raises(ValueError, match="no recording is beside .*--out FILE.rrd"):
        check_recording(arrays)


def test_no_display_is_an_error_that_names_the_way_out(recording, monkeypatch):
    started = []
    monkeypatch.setattr(viewer.os, "execve", lambda *given: started.append(given))
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ViewerError, match="--web"):
        open_viewer(recording)
    assert started == []
    monkeypatch.setenv("DISPLAY", ":0")
    open_viewer(recording)
    ((executable, command, _),) = started
    assert Path(executable).parent == Path(rerun_cli.__file__).parent
    assert command[1:] == [str(recording.resolve()), "--bind", "127.0.0.1", "--new"]


def test_both_ports_of_the_page_can_be_chosen(recording, monkeypatch):
    started = []
    monkeypatch.setattr(viewer.os, "execve", lambda *given: started.append(given))
    with socket.socket() as one, socket.socket() as two:
        for probe in (one, two):
            probe.bind(("127.0.0.1", 0))
        ports = one.getsockname()[1], two.getsockname()[1]
        two.listen()
        with pytest.raises(ViewerError, match=f"data_port {ports[1]} cannot be used"):
            open_viewer(recording, web=True, port=free_port(), data_port=ports[1])
        with pytest.raises(ViewerError, match=f"port {ports[1]} cannot be used"):
            open_viewer(recording, web=True, port=ports[1])
        with pytest.raises(ViewerError, match=f"port is {ports[0]}, as is the port"):
            open_viewer(recording, web=True, port=ports[0], data_port=ports[0])
        with pytest.raises(ViewerError, match="port is 9876, as is the port of"):
            open_viewer(recording, web=True, port=9876)
    assert not started
    open_viewer(recording, web=True, port=ports[0], data_port=ports[1])
    command = started[0][1]
    assert command[-5:] == [
        *("--port", str(ports[1]), "--serve-web"),
        *("--web-viewer-port", str(ports[0])),
    ]


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_browser_gets_a_page_until_the_command_ends(recording):
    port = free_port()
    code = (
        "from cathsim_dmc.recording.viewer import open_viewer; "
        f"open_viewer({str(recording)!r}, web=True, port={port})"
    )
    page, text, deadline = f"http://127.0.0.1:{port}/", None, time.monotonic() + 20
    with subprocess.Popen([sys.executable, "-c", code], stderr=-3) as server:
        while text is None and time.monotonic() < deadline:
            with contextlib.suppress(OSError), urllib.request.urlopen(page) as answer:
                text = answer.read().decode()
            time.sleep(0.1)
        server.terminate()
    assert "Rerun" in text
    with pytest.raises(OSError):
        urllib.request.urlopen(page)
