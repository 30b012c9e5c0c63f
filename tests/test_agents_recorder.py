"""Episodes of checkpoints, recorded beside a training."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_agents_training import run, small_ppo, without_clocks
from test_recording_training import Contents

from cathsim_dmc import suite
from cathsim_dmc.agents import ConfigError, checkpoint_recorder, make_config, make_env
from cathsim_dmc.agents.checkpoint import checkpoints_in, save_checkpoint
from cathsim_dmc.agents.checkpoint_recorder import CheckpointRecorder
from cathsim_dmc.agents.checkpoint_recording import newest_lines, record
from cathsim_dmc.agents.learners import make_learner
from cathsim_dmc.agents.metrics import MetricsFile, read_metrics
from cathsim_dmc.agents.networks import NetworkShapes

STEPS = 6


@pytest.fixture
def reach(monkeypatch):
    """Lets the synthetic task pass for one of the suite."""
    monkeypatch.setattr(suite, "SUITE", {"reach": None})


def checkpoints_of_fresh_policies(directory, *frames):
    config = make_config("ppo", task="simple1_bca", num_envs=1, steps_per_update=32)
    env = make_env(config.task, num_envs=1, num_threads=1)
    shapes = NetworkShapes.of(env)
    env.close()
    learner = make_learner(config, shapes, directory)
    table = MetricsFile(directory / "metrics.csv", ["frames", "success", "loss"])
    paths = []
    for count in frames:
        table.append({"frames": count, "success": 0.5, "loss": 1.0})
        paths.append(
            save_checkpoint(
                directory,
                config=config,
                shapes=shapes,
                frames=count,
                seconds=1.0,
                policy=learner.policy_state(),
                learning={},
            )
        )
    return paths


def test_each_checkpoint_plays_the_same_episode_by_the_rule_of_the_task(tmp_path):
    paths = checkpoints_of_fresh_policies(tmp_path, 100, 200, 300)
    gone = paths.pop(1).with_name("0000000150")
    assert record(tmp_path, STEPS, None, [paths[0], gone])
    # Another process goes on; what is there already is not recorded again.
    assert record(tmp_path, STEPS, None, paths)
    found = Contents(tmp_path / "training.rrd")
    assert found.scalars("/training/checkpoint") == {100: 100, 300: 300}
    head = dict(found.temporal["/world/catheter/head", "Points3D:positions"])
    assert list(head) == [*range(100, 107), *range(300, 307)]
    # One seed, and one policy here: one episode, which moves.
    first, second = (
        [head[begin + step] for step in range(STEPS + 1)] for begin in (100, 300)
    )
    assert first == second and first[0] != first[-1]
    assert found.scalars("/training/success/mean") == {100: 0.5, 200: 0.5, 300: 0.5}
    assert ("/world/vessel", "Mesh3D:vertex_positions") in found.static


def test_of_several_checkpoints_that_wait_the_newest_is_taken():
    reading, writing = os.pipe()
    os.write(writing, b"a\nb\nc")
    lines = newest_lines(reading)
    assert next(lines) == Path("b")
    os.write(writing, b"d\n")
    os.close(writing)
    assert list(lines) == [Path("cd")]
    os.close(reading)


def test_a_recorder_that_crashes_leaves_the_training_as_it_is(
    tmp_path, reach, monkeypatch, capsys
):
    monkeypatch.setattr(checkpoint_recorder, "_PROCESS", "cathsim_dmc.no_such_module")
    result = run(small_ppo(rerun=True), tmp_path / "with")
    run(small_ppo(), tmp_path / "without")
    assert result.frames == 1_024
    with_it, without = (
        without_clocks(read_metrics(tmp_path / name / "metrics.csv"))
        for name in ("with", "without")
    )
    assert with_it == without
    assert "the training is untouched, see" in capsys.readouterr().err
    log = tmp_path / "with" / checkpoint_recorder.LOG_FILE
    assert "no_such_module" in log.read_text()


def test_a_recorder_that_reads_nothing_keeps_nobody_waiting(
    tmp_path, reach, monkeypatch
):
    monkeypatch.setattr(checkpoint_recorder, "PATIENCE", 0.2)
    recorder = CheckpointRecorder(tmp_path, small_ppo(rerun=True))
    recorder._command = [sys.executable, "-c", "import time; time.sleep(600)"]
    began = time.monotonic()
    with recorder:
        # More than any pipe holds.
        for _ in range(20_000):
            recorder.saved(tmp_path / "checkpoints" / "0000000001")
        process = recorder._process
    assert time.monotonic() - began < 20
    assert process.returncode == -signal.SIGKILL


@pytest.mark.skipif(not hasattr(os, "SCHED_IDLE"), reason="needs Linux")
def test_it_runs_only_when_a_core_is_idle(tmp_path, reach, monkeypatch):
    recorder = CheckpointRecorder(tmp_path, small_ppo(rerun=True))
    recorder._command = [sys.executable, "-c", "import sys; sys.stdin.read()"]
    with recorder:
        pid = recorder._process.pid
        assert os.sched_getscheduler(pid) == os.SCHED_IDLE
        assert os.getpriority(os.PRIO_PROCESS, pid) == 19
        assert os.getsid(pid) == pid


def test_every_nth_checkpoint_and_the_last_one_are_told(tmp_path, reach):
    recorder = CheckpointRecorder(tmp_path, small_ppo(rerun=True, rerun_every=3))
    told = tmp_path / "told"
    script = f"import sys; open({str(told)!r}, 'w').write(sys.stdin.read())"
    recorder._command = [sys.executable, "-c", script]
    with recorder:
        for number in range(1, 8):
            recorder.saved(Path(str(number)))
        recorder.saved(Path("8"), last=True)
    assert told.read_text().split() == ["3", "6", "8"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"task": "reach"}, "task of the suite, task is 'reach'"),
        ({"task": "type1_bca", "rerun_viewer": "here"}, "give spawn, connect"),
    ],
)
def test_what_cannot_be_recorded_is_refused_at_once(tmp_path, settings, message):
    config = small_ppo(rerun=True, **settings)
    with pytest.raises(ConfigError, match=message):
        run(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


SMALL = (
    "--algo ppo --preset demo --num-envs 4 --steps-per-update 256 --rerun "
    "--minibatch-size 64 --epochs 1 --checkpoint-frames 512 --metrics-frames 256 "
    "--normalisation-frames 16 --rerun-steps 20"
).split()


def train_command(out, frames, *more):
    command = [sys.executable, "-m", "cathsim_dmc.cli", "train", "simple1_bca"]
    return [*command, "--out", str(out), "--frames", str(frames), *SMALL, *more]


@pytest.mark.slow
def test_a_killed_training_goes_on_with_its_recording(tmp_path):
    out, path = tmp_path / "run", tmp_path / "run" / "training.rrd"
    with open(tmp_path / "errors.txt", "w") as errors:
        process = subprocess.Popen(train_command(out, 10**6), stderr=errors)
    end = time.monotonic() + 900
    while not path.exists() or len(checkpoints_in(out)) < 2:
        assert process.poll() is None, (tmp_path / "errors.txt").read_text()
        assert time.monotonic() < end
        time.sleep(0.05)
    process.kill()
    process.wait()
    # Whatever moment it was, the file is whole, now and when the recorder is done.
    before = Contents(path)
    while _recorders(out):
        assert time.monotonic() < end
        time.sleep(0.1)
    frames = int(checkpoints_in(out)[-1].name) + 512
    subprocess.run(train_command(out, frames, "--resume"), check=True, timeout=900)
    after = Contents(path)
    assert after.identity == before.identity
    for key, values in before.temporal.items():
        assert after.temporal[key][: len(values)] == values, key
    assert list(after.scalars("/training/checkpoint").values())[-1] == frames
    metrics = [row["frames"] for row in read_metrics(out / "metrics.csv")]
    assert list(after.scalars("/training/learner/entropy")) == metrics


def _recorders(out):
    """Processes that record a run."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = entry.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"cathsim_dmc.agents.checkpoint_recording" in words:
            found += [entry] if str(out).encode() in words else []
    return found
