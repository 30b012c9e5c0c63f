"""Files that appear whole or not at all, whoever writes or dies meanwhile."""

import io
import os
import stat
import zipfile
from pathlib import Path

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


@pytest.mark.parametrize("write", [Path.write_bytes, lambda path, _: path.mkdir()])
def test_what_is_left_for_a_day_goes(tmp_path, write):
    target, own, other = tmp_path / "a.txt", "0123456789ab.partial", "mine.partial"
    # Of a killed writer, of another target, not of ours, and of one that lives.
    made = [tmp_path / f".{name}" for name in (f"a.txt.{own}", f"b.txt.{own}")]
    made += [tmp_path / f".a.txt.{other}", tmp_path / ".a.txt.ba9876543210.partial"]
    for path in made:
        write(path, b"half")
    for path in made[:3]:
        os.utime(path, (1e9, 1e9))
    files.write_text(target, "new")
    assert [path.exists() for path in made] == [False, True, True, True]
    files.remove_abandoned(tmp_path)
    assert [path.exists() for path in made] == [False, False, True, True]
    assert target.read_text() == "new"


def test_writers_of_one_path_all_succeed(tmp_path):
    target = tmp_path / "a.txt"
    with files.atomic_path(target) as first, files.atomic_path(target) as second:
        first.write_text("first")
        second.write_text("second")
    assert target.read_text() == "first"
    assert names(tmp_path) == ["a.txt"]


def test_a_directory_appears_whole_or_not_at_all(tmp_path):
    with pytest.raises(ZeroDivisionError):
        with files.atomic_directory(tmp_path / "data") as path:
            (path / "half").write_text("half")
            1 / 0  # noqa: B018
    assert names(tmp_path) == []
    with files.atomic_directory(tmp_path / "data") as path:
        (path / "whole").write_text("whole")
    assert names(tmp_path) == ["data"] and names(tmp_path / "data") == ["whole"]


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
