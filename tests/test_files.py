"""Files that appear whole or not at all, whoever writes or dies meanwhile."""

import codecs
import errno
import io
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from cathsim_dmc import agents, files, locks, suite
from cathsim_dmc.agents.comparison import Comparison
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.scan.importer import import_scan
from cathsim_dmc.anatomy.tree_file import read_tree
from cathsim_dmc.bridge import Log
from cathsim_dmc.recording import dataset, image_set
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.simulation import mjcf
from cathsim_dmc.tasks.snapshot import Snapshot


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


@pytest.mark.parametrize("given", [None, 3, ["a.npz"], b"a.npz"])
@pytest.mark.parametrize(
    ("name", "use"),
    [
        ("path", files.write_text),
        ("directory", lambda path, _: Anatomy.load(path)),
        ("mesh_path", lambda path, _: import_scan(path)),
        ("path", lambda path, _: read_tree(path)),
        ("path", lambda path, _: Episode.load(path)),
        ("path", lambda path, _: Snapshot.load(path)),
        ("path", lambda path, _: agents.EvaluationResult.load(path)),
        ("a path", lambda path, _: Comparison.of([path])),
        ("out", lambda path, _: image_set.write(path)),
        ("out", lambda path, _: agents.record_demonstrations("type1_bca", path)),
        ("path", lambda path, _: dataset.export([], path)),
        ("directory", lambda path, _: mjcf.write_mjcf("type1_bca", path)),
    ],
)
def test_what_is_no_path_is_refused_by_name(name, use, given):
    words = f"{name} is {given!r}; it must be a path, a str or a pathlib.Path"
    with pytest.raises(ValueError, match=re.escape(words)):
        use(given, "text")


@pytest.mark.parametrize("given", ["study", [], None])
def test_one_text_is_no_list_of_paths(given):
    words = f"paths is {given!r}; it must be a list of at least one file or folder"
    with pytest.raises(ValueError, match=re.escape(words)):
        Comparison.of(given)
    with pytest.raises(ValueError, match="episodes is .* a list of .* Episode"):
        dataset.export(given, "out")


def test_an_anatomy_is_named_by_its_directory(tmp_path):
    file = files.write_text(tmp_path / "anatomy.npz", "text")
    with pytest.raises(ValueError, match="npz', which is a file; give a directory"):
        suite.load_anatomy(file)


def test_a_home_that_no_shell_has_expanded_is_refused(tmp_path, monkeypatch):
    """A folder called ~ would be made: deleting it by name deletes the home."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    words = f"only a shell takes ~ .*; give {tmp_path}/home/data"
    for require in (
        files.require_place,
        lambda folder: files.require_folder(folder, make=True),
        lambda folder: files.require_file(folder / "a", later=True),
        lambda folder: files.write_text(folder / "a", "text"),
    ):
        with pytest.raises(FileNotFoundError, match=words):
            require(Path("~/data"))
    assert names(tmp_path) == []
    # A name may begin so, and a folder may be called so.
    files.require_folder("~data/x", make=True)
    (tmp_path / "~").mkdir()
    files.require_folder("~/data", make=True)


@pytest.mark.parametrize(
    "arguments",
    [
        ("replay-error", "{}"),
        ("phantom", "build", "{}", "--out", "d"),
        ("submit", "{}", "--out", "d.json"),
        ("eval", "expert", "--task", "type1_bca", "--start", "{}"),
        ("validate", "forces", "--episode", "{}"),
        ("replay", "{}"),
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_a_missing_file_is_named_with_what_to_give(cathsim, tmp_path, arguments):
    (tmp_path / "folder.npz").mkdir()
    for name, text in ("none.npz", "no file "), ("folder.npz", "is a directory"):
        path = str(tmp_path / name)
        code, _, error = cathsim(*(one.format(path) for one in arguments))
        assert code == 2
        assert path in error and text in error and "; give a" in error
        assert "Errno" not in error


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc")
def test_a_folder_that_takes_no_file_is_refused_whatever_its_bits_say(tmp_path):
    with pytest.raises(PermissionError, match="/proc cannot be written to: "):
        files.require_place("/proc/missing")
    files.require_folder(tmp_path)
    assert names(tmp_path) == []


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
    with pytest.raises(FileExistsError, match="data has been made by another process"):
        with files.atomic_directory(tmp_path / "data") as path:
            (path / "other").write_text("other")
    assert names(tmp_path) == ["data"] and names(tmp_path / "data") == ["whole"]


def test_the_next_writer_removes_what_a_killed_one_has_left(tmp_path):
    (tmp_path / "data-v0").mkdir()  # other names
    killed = f"""
import os
from pathlib import Path
from cathsim_dmc import files, locks
path = Path({str(tmp_path / "data")!r})
with locks.only_writer(path), files.atomic_directory(path) as folder:
    with files.atomic_directory(f"{{path}}.b"):
        (folder / "half").write_text("half")
        os.kill(os.getpid(), 9)
"""
    assert subprocess.run([sys.executable, "-c", killed]).returncode == -9
    assert len(names(tmp_path)) == 4
    with locks.only_writer(tmp_path / "data"):
        assert not files.unfinished(tmp_path / "data")
    (other,) = files.unfinished(tmp_path / "data.b")
    assert names(tmp_path) == [other.name, "data-v0"]


def test_a_full_disk_names_what_was_being_written(tmp_path, small_disk):
    with small_disk(1000), pytest.raises(OSError, match=r"File too large: .*data'"):
        with files.atomic_directory(tmp_path / "data") as path:
            (path / "half").write_bytes(bytes(2000))
    log = Log(tmp_path / "log")
    with small_disk(10), pytest.raises(OSError, match=r"File too large: .*log'"):
        log.write("event")
    assert names(tmp_path) == ["log"]


def test_arrays_from_outside_run_nothing(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.arange(3), b=np.zeros(2))
    assert files.read_arrays(path, ["a"])["a"].tolist() == [0, 1, 2]
    assert files.read_arrays(path).keys() == {"a", "b"}
    with pytest.raises(ValueError, match="it lacks the array 'c'"):
        files.read_arrays(path, ["a", "c"])
    np.savez(path, a=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle=False"):
        files.read_arrays(path)
    for data in (b"", b"PK", b"text"):
        path.write_bytes(data)
        with pytest.raises(ValueError):
            files.read_arrays(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes")
def test_neither_a_pipe_nor_a_directory_is_replaced(tmp_path):
    pipe, folder = tmp_path / "pipe", tmp_path / "folder"
    os.mkfifo(pipe)
    folder.mkdir()
    with pytest.raises(ValueError, match="device or a pipe"):
        files.write_text(pipe, "text")
    with pytest.raises(IsADirectoryError, match="give a file name in it"):
        files.write_text(folder, "text")
    assert pipe.is_fifo() and names(tmp_path) == ["folder", "pipe"]


def test_a_name_that_is_too_long_is_no_fault_of_its_folder(tmp_path):
    with pytest.raises(OSError) as caught:
        files.write_text(tmp_path / ("a" * 250), "text")
    assert caught.value.errno == errno.ENAMETOOLONG


def test_texts_of_windows_are_read(tmp_path):
    (tmp_path / "a.json").write_bytes(codecs.BOM_UTF8 + "ü".encode())
    assert files.read_text(tmp_path / "a.json") == "ü"


@pytest.mark.parametrize(("stored", "most"), [(10, 2**28), (2**28, 100 * 2**28)])
def test_files_may_unpack_to_this_much(stored, most):
    files.require_room(most, stored)
    with pytest.raises(ValueError, match="it unpacks to"):
        files.require_room(most + 1, stored)


@pytest.mark.parametrize("size", [0, 5, 2**20, 2**20 + 3])
def test_a_probe_of_the_disk_is_as_large_as_asked_for(tmp_path, size):
    files.fill(tmp_path / "probe", size)
    assert (tmp_path / "probe").stat().st_size == size


def test_an_error_keeps_the_file_that_it_names(tmp_path):
    with pytest.raises(FileNotFoundError) as caught, files.naming(tmp_path / "a"):
        (tmp_path / "b").read_text()
    assert caught.value.filename == str(tmp_path / "b")


def test_an_array_with_less_data_than_its_header_says_is_refused(tmp_path):
    stream = io.BytesIO()
    np.save(stream, np.zeros(10))
    data = stream.getvalue().replace(b"(10,)", b"(99,)")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("values.npy", data)
    with pytest.raises(ValueError, match="holds less than its shape"):
        files.read_arrays(tmp_path / "a.npz")
