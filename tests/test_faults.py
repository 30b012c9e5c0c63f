"""Processes that are killed, disks that are full, folders that cannot be written."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import synthetic_env
from test_agents_training import run, small_ppo

from cathsim_dmc import suite
from cathsim_dmc.agents import ConfigError, evaluate
from cathsim_dmc.agents.checkpoint import Checkpoint, checkpoints_in
from cathsim_dmc.agents.training_log import read_metrics
from cathsim_dmc.cli.agents import record
from cathsim_dmc.cli.task_options import TaskOptions


@pytest.mark.parametrize("kind", ["a file", "under a file", "read-only"])
def test_folders_that_cannot_be_written_are_refused_before_the_work(
    tmp_path, monkeypatch, kind
):
    out = tmp_path / "out"
    if kind == "read-only":
        if os.geteuid() == 0:
            pytest.skip("root may write everywhere")
        out.mkdir(mode=0o500)
        out = out / "run"
    else:
        out.write_text("mine")
        out = out if kind == "a file" else out / "run"

    def work(*arguments, **options):
        raise AssertionError("work was begun")

    monkeypatch.setattr(synthetic_env, "make_env", work)
    with pytest.raises((OSError, ConfigError), match="out"):
        run(small_ppo(), out, make_env=work)
    with pytest.raises(OSError, match="out"):
        evaluate("push", "type1_bca", out_dir=out, make_env=work)
    monkeypatch.setattr(suite, "load", work)
    with pytest.raises(OSError, match="out"):
        record("push", out / "a.rrd", task="type1_bca", options=TaskOptions())
    if kind != "read-only":
        assert (tmp_path / "out").read_text() == "mine"


# Kills.

TRAIN = """
import sys
sys.path[:0] = sys.argv[3:]
import synthetic_env
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
