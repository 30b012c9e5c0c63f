"""Processes that are killed, disks that are full, folders that cannot be written."""

import errno
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
import synthetic_env
from recording_samples import make_episode, make_tube
from test_agents_training import run, small_ppo

import cathsim_dmc
from cathsim_dmc import agents, cli, files, style, suite
from cathsim_dmc.agents import ConfigError, evaluate, evaluation, submission, training
from cathsim_dmc.agents.checkpoint import Checkpoint, checkpoints_in
from cathsim_dmc.agents.training_log import read_metrics
from cathsim_dmc.analysis import heatmap
from cathsim_dmc.anatomy.tree_file import read_tree
from cathsim_dmc.cli import bridging, phantoms
from cathsim_dmc.cli.agents import record
from cathsim_dmc.cli.task_options import TaskOptions
from cathsim_dmc.pictures import animation
from cathsim_dmc.recording import dataset, image_set, rerun_log
from cathsim_dmc.validation import rig


@pytest.mark.parametrize("kind", ["a file", "under a file"])
def test_folders_that_cannot_be_written_are_refused_before_the_work(
    tmp_path, monkeypatch, kind
):
    out = tmp_path / "out"
    out.write_text("mine")
    out = out if kind == "a file" else out / "run"
    monkeypatch.setattr(synthetic_env, "make_env", work)
    with pytest.raises((OSError, ConfigError), match="out"):
        run(small_ppo(), out, make_env=work)
    with pytest.raises(OSError, match="out"):
        evaluate("push", "type1_bca", out_dir=out, make_env=work)
    monkeypatch.setattr(suite, "load", work)
    with pytest.raises(OSError, match="out"):
        record("push", out / "a.rrd", task="type1_bca", options=TaskOptions())
    assert (tmp_path / "out").read_text() == "mine"


# Every command that writes, and what it would do first that takes its time.
WRITERS = {
    "train type1_bca --out OUT": (training, "_prepare"),
    "train type1_bca --out OUT/run": (training, "_prepare"),
    "eval push --task type1_bca --out OUT": (evaluation, "_first_episodes"),
    "submit push --task type1_bca --out OUT/a.json": (evaluation, "evaluate"),
    "record push --task type1_bca --out OUT/a.rrd": (suite, "load"),
    "record push --task type1_bca --gif OUT/a.gif": (suite, "load"),
    "demos type1_bca --out OUT/a-v0": (suite, "make_task"),
    "play type1_bca --out OUT": (suite, "load"),
    "dataset OUT": (image_set, "_shards"),
    "dataset OUT/set": (image_set, "_shards"),
    "export type1_bca --out OUT/a": (suite, "load"),
    "serve type1_bca --log OUT/a.jsonl": (suite, "load"),
    "drive push --connect h:1 --log OUT/a.jsonl": (bridging, "connect"),
    "phantom import a.stl --out OUT": (phantoms, "import_scan"),
    "phantom build a.json --out OUT/a/b": (phantoms, "read_tree"),
    "phantom generate type1 --out OUT": (phantoms.shipped, "load"),
    "phantom check type1 --figure OUT/a.png": (suite, "load_anatomy"),
    "phantom export type1 --out OUT/a.xml": (suite, "load_anatomy"),
}


def work(*arguments, **options):
    raise AssertionError("work was begun")


@pytest.fixture
def read_only(tmp_path, monkeypatch):
    """A folder that is read-only, also for root."""
    folder = tmp_path / "kept"
    folder.mkdir()
    access = os.access

    def denied(path, mode):
        return os.fspath(path) != str(folder) and access(path, mode)

    monkeypatch.setattr(files.os, "access", denied)
    return folder


@pytest.mark.parametrize("line", WRITERS)
def test_a_read_only_folder_is_refused_before_the_work(
    read_only, monkeypatch, capsys, line
):
    monkeypatch.setattr(*WRITERS[line], work)
    words = line.replace("OUT", str(read_only)).split()
    monkeypatch.setattr(sys, "argv", ["cathsim", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr().err
    assert ended.value.code == 2, said
    assert f"PermissionError: {read_only} cannot be written to" in said
    assert not list(read_only.iterdir())


def test_a_read_only_folder_is_refused_before_the_work_in_python(
    read_only, monkeypatch
):
    episode, surface = make_episode(), make_tube()
    calls = {
        "record": lambda: cathsim_dmc.record(object(), "push", read_only / "a.npz"),
        "record_actions": lambda: submission.record_actions(
            "push", read_only / "a.npz", "type1_lcca"
        ),
        "save": lambda: episode.save(read_only / "a.npz"),
        "animate": lambda: animation.animate(episode, surface, read_only / "a.gif"),
        "write_rrd": lambda: rerun_log.write_rrd(episode, surface, read_only / "a.rrd"),
        "heatmap": lambda: heatmap.heatmap(
            np.zeros((0, 3)), np.zeros(0), surface, read_only / "a.png"
        ),
        "style": lambda: style.save(None, read_only / "a.png"),
        "dataset": lambda: dataset.check_free(read_only / "a-v0"),
    }
    for module, name in (
        (evaluation, "evaluate"), (rerun_log, "Log"), (animation, "_frames"),
        (heatmap, "force_map"), (np, "savez_compressed"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, work)
    for name, call in calls.items():
        with pytest.raises(PermissionError, match="chmod u"):
            call()
            raise AssertionError(name)
    assert not list(read_only.iterdir())


def test_a_device_or_pipe_is_neither_read_nor_replaced(tmp_path):
    """`/dev/zero` has no end, and a file renamed to `/dev/null` would replace it."""
    pipe = tmp_path / "a.npz"
    os.mkfifo(pipe)
    for call in (
        lambda: files.require_file(pipe),
        lambda: files.write_text(pipe, "x"),
        lambda: files.read_arrays("/dev/null"),
        lambda: read_tree("/dev/null"),
    ):
        with pytest.raises(ValueError, match=r"is a device or a pipe; give the name"):
            call()
    assert pipe.is_fifo()


@pytest.mark.parametrize(
    "line",
    [
        "eval push --task type1_bca --friction 3 --out OUT/run",
        "submit push --task type1_bca --episodes 0 --out OUT/new/a.json",
        "record push --task type1_bca --friction 3 --out OUT/new/a.npz",
        "play type1_bca --friction 3 --out OUT/new",
    ],
)
def test_a_refused_command_leaves_no_folder(tmp_path, monkeypatch, capsys, line):
    words = line.replace("OUT", str(tmp_path)).split()
    monkeypatch.setattr(sys, "argv", ["cathsim", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr().err
    assert ended.value.code == 2 and said.count("\n") == 1, said
    assert not list(tmp_path.iterdir())


def test_an_error_with_a_long_name_stays_short(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["cathsim", "replay", "x" * 5000])
    with pytest.raises(SystemExit):
        cli.main()
    assert len(capsys.readouterr().err) < 2000


def test_a_folder_in_the_place_of_a_file_is_refused_before_the_work(tmp_path):
    (tmp_path / "a.npz").mkdir()
    with pytest.raises(IsADirectoryError, match="give a file name in it"):
        with files.atomic_path(tmp_path / "a.npz"):
            raise AssertionError


@pytest.mark.parametrize("json", [True, False])
def test_an_evaluation_that_cannot_be_written_is_printed(
    tmp_path, monkeypatch, capsys, json
):
    def full(path, values):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(files, "write_json", full)
    line = f"eval push --task simple1_bca --max-steps 1 --episodes 1 --out {tmp_path}"
    words = [*line.split(), "--no-baseline", *["--json"] * json]
    monkeypatch.setattr(sys, "argv", ["cathsim", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr()
    assert ended.value.code == 2 and "No space left on device" in said.err
    assert '"episodes"' in said.out if json else "safe success" in said.out


@pytest.fixture
def full_disk(tmp_path, monkeypatch):
    """Folders `data`, where nothing can be written to its end, and `temporary`."""
    data, temporary = tmp_path / "data", tmp_path / "temporary"
    data.mkdir(), temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    for name in "replace", "rename":
        real = getattr(os, name)

        def moved(source, target, real=real):
            if data in Path(target).parents:
                raise OSError(errno.ENOSPC, "No space left on device", str(target))
            real(source, target)

        monkeypatch.setattr(os, name, moved)
    return data, temporary


SHORT = {"max_steps": 2}
LATE = {
    "evaluation.json": lambda path: agents.evaluate(
        "push", "simple1_bca", 1, task_kwargs=SHORT, out_dir=path.parent
    ),
    "sub.json": lambda path: submission.submit("push", path, "simple1_bca", episodes=1),
    "actions.npz": lambda path: agents.record_actions(
        "push", path, "simple1_bca", episodes=1, task_kwargs=SHORT
    ),
    "demos-v0": lambda path: agents.record_demonstrations(
        "simple1_bca", path, 1, task_kwargs=SHORT
    ),
    "anatomy": lambda path: phantoms._save(rig.tube(0.06, 4e-3), path),
}


@pytest.mark.parametrize("name", LATE)
def test_a_result_that_cannot_be_written_is_kept_elsewhere(full_disk, name):
    data, temporary = full_disk
    with pytest.raises(OSError, match="No space left on device") as caught:
        LATE[name](data / name)
    (folder,) = temporary.iterdir()
    (note,) = caught.value.__notes__
    assert note.endswith(f" is kept in {folder}; move it to {data}")
    assert (folder / name).exists()
    assert not [one for one in data.rglob("*") if one.is_file()]


def test_a_result_that_is_kept_nowhere_is_told(full_disk, monkeypatch, cathsim):
    data, temporary = full_disk

    def full(path):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    def command(*_, **options):
        files.write_result(data / "a", full, "the anatomy of a.stl")

    monkeypatch.setattr(phantoms, "import_scan", command)
    code, _, error = cathsim("phantom", "import", "a.stl", "--out", str(data / "b"))
    assert code == 2 and "data/a'; the anatomy of a.stl is not kept" in error
    assert not list(temporary.iterdir())


@pytest.mark.parametrize(
    ("line", "file"),
    [
        ("eval push --task simple1_bca --out OUT", "evaluation.json"),
        ("eval push --task simple1_bca --out OUT", "heatmap.png"),
        ("phantom generate simple1 --out OUT", "anatomy.npz"),
        ("submit push --task simple1_bca --out OUT/a.json", "a.npz"),
    ],
)
def test_a_folder_with_the_name_of_a_result_is_refused_before_the_work(
    tmp_path, monkeypatch, cathsim, line, file
):
    monkeypatch.setattr(agents, "evaluate", work)
    monkeypatch.setattr(evaluation, "evaluate", work)
    monkeypatch.setattr(phantoms.shipped, "load", work)
    monkeypatch.setattr(submission, "ships", lambda policy: False)
    (tmp_path / file).mkdir()
    code, _, error = cathsim(*line.replace("OUT", str(tmp_path)).split())
    assert code == 2 and f"{file} is a directory" in error


# Kills.

TRAIN = """
import sys
sys.path[:0] = sys.argv[3:]
import synthetic_env
from recording_samples import make_episode, make_tube
from test_agents_training import small_ppo
from cathsim_dmc.agents import train
config = small_ppo(total_frames=int(sys.argv[2]), checkpoint_frames=512)
print("begins", flush=True)
train(config, sys.argv[1], True, False, synthetic_env.make_env)
"""


@pytest.mark.slow
def test_a_training_that_is_killed_loses_nothing_finished(tmp_path):
    (tmp_path / "config.json").write_text("{}")

    def started(frames):
        command = [sys.executable, "-c", TRAIN, str(tmp_path), str(frames), *sys.path]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout.readline() == "begins\n"
        return process

    reached = []
    for moment in np.random.default_rng().uniform(0.5, 5.0, 5):
        process = started(10**9)
        time.sleep(moment)
        process.kill()
        assert process.wait() == -signal.SIGKILL
        found = checkpoints_in(tmp_path)
        for path in found:
            Checkpoint.open(path).policy()
            Checkpoint.open(path).learning_state()
        reached.append(int(found[-1].name) if found else 0)
    assert reached == sorted(reached) and reached[-1] > 0
    assert started(reached[-1] + 512).wait() == 0
    frames = [row["frames"] for row in read_metrics(tmp_path / "metrics.csv")]
    assert frames == sorted(set(frames)) and frames[-1] == reached[-1] + 512
