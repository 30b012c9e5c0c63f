"""The cache of compiled loops: no fault of it stops a run, and none goes unsaid."""

import ast
import atexit
import ctypes
import errno
import logging
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import filelock
import numba
import pytest
from numba.core import caching

import cathsim_dmc
from cathsim_dmc import compiled_ahead, compiled_cache, first_load, suite
from cathsim_dmc.collision import native
from cathsim_dmc.compiled import compiled


def double(number):
    return 2 * number


def loop():
    """The function as a new process makes it: its answer, and what it found on disk."""
    made = compiled(double)
    answer = made(21)
    hits = sum(made._compiled.stats.cache_hits.values())
    return answer, hits


def call_by_c():
    made = native.callback("int64(int64)")(double)
    answer = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64)(made.address)(21)
    return answer, made.made.cache_hits


KINDS = pytest.mark.parametrize("run", [loop, call_by_c])


@pytest.fixture
def folder(monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setattr(compiled_cache, "_told", set())
    return tmp_path / "kept"


def files(folder, suffix):
    return sorted(folder.rglob(f"*.{suffix}"))


def cut(share):
    return lambda data: data[: int(share * len(data))]


DAMAGES = {
    "empty": cut(0),
    "first bytes": lambda data: data[:3],
    "half": cut(0.5),
    "all but the end": lambda data: data[:-1],
    "zeros": lambda data: bytes(len(data)),
    "zeros at the end": lambda data: data[: len(data) // 2] + bytes(len(data) // 2),
    "text": lambda data: b"not a cache",
}


@KINDS
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_cache_is_compiled_anew(run, suffix, damage, folder, caplog):
    assert run() == (42, 0)
    assert run() == (42, 1)
    assert not caplog.records
    (path,) = files(folder, suffix)
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert run() == (42, 0)
    (record,) = caplog.records
    assert str(path) in record.getMessage() and "\n" not in record.getMessage()
    assert "compiled again" in record.getMessage()
    assert run() == (42, 1)  # it is whole again
    assert len(caplog.records) == 1


@KINDS
def test_a_warning_is_given_once(run, folder, caplog):
    run()
    for _ in range(3):
        for path in files(folder, "nbi"):
            path.write_bytes(b"")
        run()
    assert len(caplog.records) == 1


@KINDS
def test_a_file_that_cannot_be_read_stops_nothing(run, folder, caplog):
    run()
    for path in files(folder, "nb?"):
        path.unlink()
        path.mkdir()  # also for root no file that can be read or replaced
    assert run() == (42, 0)
    texts = [record.getMessage() for record in caplog.records]
    assert "is damaged" in texts[0] and "cannot be kept" in texts[1]


@KINDS
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EROFS])
def test_a_full_disk_stops_nothing(run, code, folder, caplog, monkeypatch):
    def full(*_):
        raise OSError(code, "no room")

    monkeypatch.setattr(caching.IndexDataCacheFile, "_open_for_write", full)
    assert run() == (42, 0) == run()
    (record,) = caplog.records
    assert str(folder) in record.getMessage() and "no room" in record.getMessage()
    assert "NUMBA_CACHE_DIR" in record.getMessage()


@KINDS
def test_code_that_an_index_names_by_mistake_is_not_run(
    run, folder, caplog, monkeypatch
):
    """The disk fills up between the index of new sources and their code."""
    run()
    monkeypatch.setattr(caching.UserProvidedCacheLocator, "get_source_stamp", bytes)
    with monkeypatch.context() as context:
        context.setattr(compiled_cache._Files, "_save_data", lambda *_: None)
        assert run() == (42, 0)
    assert run() == (42, 0)
    assert "is damaged" in caplog.text
    assert run() == (42, 1)


@KINDS
def test_without_a_folder_nothing_is_kept(run, folder, caplog, capsys, monkeypatch):
    """As in a read-only installation of a user without a home."""
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    compiled_cache.keep_together()
    assert run() == (42, 0) == run()
    (record,) = caplog.records
    assert "neither it nor the user's cache folder" in record.getMessage()
    assert "NUMBA_CACHE_DIR" in record.getMessage()
    assert "the result is cached" not in capsys.readouterr().err
    assert compiled_cache.has_compiled()


def test_a_warning_is_one_line_on_standard_error(folder, capfd, monkeypatch):
    logger = logging.getLogger("cathsim_dmc.compiled_cache")
    loop()
    files(folder, "nbi")[0].write_bytes(b"")
    monkeypatch.setattr(logger, "handlers", [logging.lastResort])
    monkeypatch.setattr(logger, "propagate", False)
    capfd.readouterr()
    loop()
    assert len(capfd.readouterr().err.splitlines()) == 1


EMPTY = """
import numpy as np
from numba.core import event
from cathsim_dmc import suite
from cathsim_dmc.physics import adapters
from cathsim_dmc.simulation.batch import BatchSimulation

class Listener(event.Listener):
    def on_start(self, event):
        compiled.append(event.data["dispatcher"])

    def on_end(self, event):
        pass

compiled = []
event.register("numba:compile", Listener())
for task, options in (
    ("type1_lcca", {}),
    ("type1_lcca_pair", {}),
    ("type1_lcca", {"device": "wire_035_glide"}),
    ("type1_lcca", {"vessel": "living"}),
):
    environment = suite.load("cathsim", task, options)
    assert compiled
    if not options:
        assert "made" not in vars(adapters.motion)  # no vessel moves
    compiled.clear()
    environment.reset()
    environment.step(np.ones(environment.action_spec().shape))
    assert not compiled, (task, options, compiled)
    batch = BatchSimulation(suite.make_task(task, **options), 3)
    compiled.clear()
    batch.reset()
    batch.step(np.ones((3, batch.num_actions)))
    assert not compiled, (task, options, compiled)
"""


@pytest.mark.slow
def test_nothing_compiles_after_a_task_is_loaded(tmp_path):
    own = {"NUMBA_CACHE_DIR": str(tmp_path), "MUJOCO_GL": "disable"}
    run = [sys.executable, "-c", EMPTY]
    done = subprocess.run(run, env=os.environ | own, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("compiling for this machine") == 1


LOADED = """
import sys
from cathsim_dmc import compiled_ahead, suite
compiled_ahead.enabled = False
suite.load("cathsim", sys.argv[1])
"""


COLLIDER = {"loops.of_link"}
# Coaxial devices call these before `settle`.
FIRST = COLLIDER | {"adapters.blood", "dispatcher._passive", "dispatcher._control"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "left"),
    [("type1_lcca", COLLIDER), ("type1_lcca_pair", FIRST), ("type1_lcca_wire", FIRST)],
)
def test_a_second_process_compiles_what_the_first_one_reaches_last(
    task, left, tmp_path, monkeypatch
):
    expected = []
    monkeypatch.setattr(compiled_ahead, "expect", expected.append)
    suite.make_task(task)
    own = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "MUJOCO_GL": "disable"}
    first = [sys.executable, "-m", "cathsim_dmc.first_load", *expected, str(tmp_path)]
    subprocess.run(first, env=own, check=True)
    before = set(files(tmp_path, "nbc"))
    assert before
    subprocess.run([sys.executable, "-c", LOADED, task], env=own, check=True)
    found = [path.name for path in set(files(tmp_path, "nbc")) - before]
    # One signature of each: both processes compile for the same arrays.
    assert sorted(name.rsplit("-", 1)[0] for name in found) == sorted(left)


@pytest.fixture
def started(monkeypatch):
    """Commands that the second process would have."""
    commands, ends = [], []

    def start(command, *, env, **_):
        strings = [one for one in sys.path if isinstance(one, str)]
        assert env["PYTHONPATH"].split(os.pathsep) == strings
        commands.append(command)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(atexit, "register", ends.append)
    for name in "_expected", "_started":
        monkeypatch.setattr(compiled_ahead, name, [])
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    yield commands
    assert len(ends) == len(commands)  # it ends with this process


def test_a_second_process_starts_once_and_only_for_what_is_missing(
    folder, started, monkeypatch
):
    monkeypatch.setattr(sys, "path", [*sys.path, folder])  # Python skips a Path
    loop()
    assert not started  # no task has been made
    compiled_ahead.expect("type1_bca")
    compiled_ahead.expect("type1_lcca")  # the last one counts
    loop()
    assert not started  # nothing is missing
    for path in files(folder, "nbi"):
        path.unlink()
    loop()
    call_by_c()
    (command,) = started
    assert command[1:4] == ["-m", "cathsim_dmc.first_load", "type1_lcca"]
    assert Path(command[4]).is_relative_to(folder)


def test_one_second_process_loads_for_a_cache(tmp_path, monkeypatch):
    loaded = []
    monkeypatch.setattr(first_load, "load", loaded.append)
    with filelock.FileLock(tmp_path / "first_load.lock"):
        first_load.main("type1_lcca", str(tmp_path))
    assert not loaded
    first_load.main("type1_lcca", str(tmp_path))
    assert loaded == ["type1_lcca"]


@pytest.mark.parametrize("absent", ["core", "interpreter", "program", "wish"])
def test_a_process_compiles_alone_where_no_second_one_can_run(
    absent, folder, started, monkeypatch
):
    def fail(*_, **__):
        raise FileNotFoundError

    if absent == "core":
        monkeypatch.setattr(os, "cpu_count", lambda: 1)
    elif absent == "interpreter":
        monkeypatch.setattr(sys, "executable", None)
    elif absent == "program":
        monkeypatch.setattr(subprocess, "Popen", fail)
    else:
        monkeypatch.setattr(compiled_ahead, "enabled", False)
    compiled_ahead.expect("type1_lcca")
    assert loop() == (42, 0)
    assert not started


@KINDS
def test_what_another_process_compiles_is_waited_for(run, folder, monkeypatch):
    kept, taken = {}, []

    class Lock(filelock.FileLock):
        """The lock of a function that another process compiles meanwhile."""

        def acquire(self, *arguments, **options):
            taken.append(self)
            for path, content in kept.items():
                path.write_bytes(content)
            return super().acquire(*arguments, **options)

    monkeypatch.setattr(filelock, "FileLock", Lock)
    run()
    kept.update((path, path.read_bytes()) for path in files(folder, "nb?"))
    for path in kept:
        path.unlink()
    assert run() == (42, 1)
    # Of the function in both runs, and of its index in the first.
    assert [lock.is_locked for lock in taken] == [False, False, False]


def test_signatures_saved_at_the_same_time_are_all_kept(tmp_path):
    def save(first):
        own = compiled_cache._Files(str(tmp_path), "function", b"stamp")
        for number in range(first, first + 20):
            own.save(number, number)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(save, range(0, 80, 20)))
    found = compiled_cache._Files(str(tmp_path), "function", b"stamp")
    assert [found.load(number) for number in range(80)] == list(range(80))


@KINDS
def test_a_process_that_never_ends_is_not_waited_for(run, folder, monkeypatch, caplog):
    run()
    lock = next(path for path in files(folder, "lock") if ".nbi" not in path.name)
    for path in files(folder, "nb?"):
        path.unlink()
    monkeypatch.setattr(compiled_cache, "_LONGEST_WAIT", 0.1)
    with filelock.FileLock(lock):
        assert run() == (42, 0)
    assert run() == (42, 1)
    assert not caplog.records


@KINDS
def test_one_line_tells_of_compiling_and_none_of_loading(run, folder, capsys):
    run()
    run()
    assert capsys.readouterr().err.count("compiling for this machine, once") == 1
    compiled_cache._told.clear()
    run()
    assert not capsys.readouterr().err
    assert not compiled_cache.has_compiled()


def test_a_part_is_compiled_with_its_caller_alone():
    made = compiled(double)
    made._inner.compile((numba.float64,))
    (part,) = made._inner.overloads.values()
    engine = part.library._codegen._engine
    assert not engine.is_symbol_defined(part.fndesc.mangled_name)

    @compiled
    def call(number):
        return made(number) + 1.0

    assert call(20.5) == 42.0


COMPILING = {"compiled", "law", "inlined", "callback", "_adapter"}


def used_by_compiled(tree):
    """Names that the compiled functions of a module refer to."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            by = {ast.unparse(each).split("(")[0] for each in node.decorator_list}
            if by & COMPILING:
                yield from (x.id for x in ast.walk(node) if isinstance(x, ast.Name))


def test_another_mujoco_compiles_anew(monkeypatch):
    stamp = compiled_cache._stamp.__wrapped__
    before = stamp()
    assert stamp() == before
    monkeypatch.setattr(compiled_cache.metadata, "version", lambda name: "0")
    assert stamp() != before


def test_a_change_of_any_source_of_compiled_code_compiles_anew():
    """The functions that compiled code calls and the constants that it contains."""
    package, missed = Path(cathsim_dmc.__file__).parent, set()
    kept = set(compiled_cache.sources())
    for path in package.rglob("*.py"):
        tree = ast.parse(path.read_text())
        used = set(used_by_compiled(tree))
        if used and path not in kept:
            missed.add(str(path))
        for node in tree.body:
            if not isinstance(node, ast.ImportFrom):
                continue
            names = (node.module or "").split(".")
            source = package.parent.joinpath(*names).with_suffix(".py")
            if names[0] != "cathsim_dmc" or source in kept or not source.exists():
                continue
            missed |= {f"{source}: {n.name}" for n in node.names if n.name in used}
    assert not missed
