"""Files that appear whole or not at all, whoever writes or dies meanwhile."""

import io
import os
import signal
import stat
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from cathsim_dmc import files


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_failure_leaves_the_older_file_and_nothing_else(tmp_path):
    target = files.write_text(tmp_path / "a.txt", "old")
    with pytest.raises(ZeroDivisionError), files.atomic_path(target) as path:
        path.write_text("half")
        1 / 0  # noqa: B018
    with pytest.raises(RuntimeError, match="nothing was written"):
        with files.atomic_path(target):
            pass
    assert target.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_wrong_paths_are_refused_before_the_work(tmp_path):
    with pytest.raises(ValueError, match="end in .npz, got 'a.txt'"):
        with files.atomic_path(tmp_path / "a.txt", ".npz"):
            raise AssertionError
    with pytest.raises(FileNotFoundError, match="no directory"):
        with files.atomic_path(tmp_path / "missing" / "a.txt"):
            raise AssertionError


KILLED = """
import os, signal, sys
from cathsim_dmc import files
with files.atomic_path(sys.argv[1]) as path:
    path.write_text("half")
    print("writing", flush=True)
    sys.stdin.read()
"""


def writer(target, script=KILLED):
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(target)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "writing\n"
    return process


def test_what_the_dead_left_goes_and_what_the_living_write_stays(tmp_path):
    target = files.write_text(tmp_path / "a.txt", "old")
    dead, alive = writer(target), writer(target)
    dead.send_signal(signal.SIGKILL)
    dead.communicate()
    assert len(names(tmp_path)) == 3
    # A file of another target, and one that only looks alike, are none of its business.
    (tmp_path / ".b.txt.0123456789ab.partial").write_text("another")
    (tmp_path / ".a.txt.mine.partial").write_text("mine")
    files.write_text(target, "new")
    left = [name for name in names(tmp_path) if name.endswith(".partial")]
    assert len(left) == 3
    assert target.read_text() == "new"
    # The living one still succeeds.
    alive.communicate("")
    assert alive.returncode == 0
    assert target.read_text() == "half"
    assert names(tmp_path) == [
        ".a.txt.mine.partial",
        ".b.txt.0123456789ab.partial",
        "a.txt",
    ]


DIRECTORY = """
import sys
from cathsim_dmc import files
with files.atomic_directory(sys.argv[1]) as path:
    (path / "half").write_text("half")
    print("writing", flush=True)
    sys.stdin.read()
"""


def test_directories_of_the_dead_go_and_those_of_the_living_stay(tmp_path):
    target = tmp_path / "data"
    dead, alive = writer(target, DIRECTORY), writer(target, DIRECTORY)
    dead.send_signal(signal.SIGKILL)
    dead.communicate()
    assert len(list(tmp_path.rglob("half"))) == 2
    files.remove_abandoned(tmp_path, "another")
    assert len(list(tmp_path.rglob("half"))) == 2
    files.remove_abandoned(tmp_path)
    assert len(list(tmp_path.rglob("half"))) == 1
    alive.communicate("")
    assert alive.returncode == 0
    assert names(tmp_path) == ["data"] and names(target) == ["half"]
    # The next writer of the same path does it too.
    dead = writer(tmp_path / "more", DIRECTORY)
    dead.send_signal(signal.SIGKILL)
    dead.communicate()
    with files.atomic_directory(tmp_path / "more") as path:
        (path / "whole").write_text("")
    assert names(tmp_path) == ["data", "more"]


def archive(path, **texts):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as stream:
        for name, text in texts.items():
            stream.writestr(f"{name}.npy", text)
    return path


def npy(array, **header):
    """Bytes of an array that says of itself what its header says."""
    buffer = io.BytesIO()
    wanted = {"descr": "<f8", "fortran_order": False, "shape": array.shape}
    np.lib.format.write_array_header_1_0(buffer, {**wanted, **header})
    return buffer.getvalue() + array.tobytes()


def test_arrays_from_outside_fill_no_memory_and_run_nothing(tmp_path):
    path, good = tmp_path / "a.npz", npy(np.arange(3.0))
    archive(path, a=good, b=good)
    assert files.read_arrays(path, 10_000, ["a"])["a"].tolist() == [0, 1, 2]
    assert files.read_arrays(path, 10_000).keys() == {"a", "b"}
    with pytest.raises(ValueError, match="it lacks c"):
        files.read_arrays(path, 10_000, ["a", "c"])
    with pytest.raises(ValueError, match="unpack to"):
        files.read_arrays(archive(path, a=npy(np.zeros(10**6))), 10**6)
    assert path.stat().st_size < 20_000  # a bomb
    for shape in ((2**45,), (2**40, 2**40), (-1,), (4,), (True,), (0, 10**20)):
        with pytest.raises(ValueError):
            files.read_arrays(archive(path, a=npy(np.zeros(3), shape=shape)), 10**6)
    with pytest.raises(ValueError, match="allow_pickle=False"):
        files.read_arrays(archive(path, a=npy(np.zeros(3), descr="|O")), 10**6)
    for data in (b"", b"PK", good):
        path.write_bytes(data)
        with pytest.raises(ValueError):
            files.read_arrays(path, 10**6)


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_the_umask_decides_who_may_read(tmp_path, umask):
    before = os.umask(umask)
    try:
        files.write_text(tmp_path / "a.json", "{}")
        with files.atomic_path(tmp_path / "b.bin") as path:
            path.write_bytes(b"1")
    finally:
        os.umask(before)
    for name in ("a.json", "b.bin"):
        mode = stat.S_IMODE((tmp_path / name).stat().st_mode)
        assert mode == 0o666 & ~umask
