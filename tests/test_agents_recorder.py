"""Episodes of checkpoints, recorded during a training."""

import subprocess
import sys
import time

import pytest
import torch
from test_agents_training import run, small_ppo, without_clocks
from test_recording_training import Contents

from cathsim_dmc import suite
from cathsim_dmc.agents import ConfigError, make_config, make_env
from cathsim_dmc.agents.checkpoint import checkpoints_in, save_checkpoint
from cathsim_dmc.agents.checkpoint_recorder import CheckpointRecorder
from cathsim_dmc.agents.learners import make_learner
from cathsim_dmc.agents.metrics import MetricsFile, read_metrics
from cathsim_dmc.agents.networks import NetworkShapes

STEPS = 6


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


def recorder_of(directory, **changes):
    config = make_config("ppo", task="simple1_bca", rerun_steps=STEPS, **changes)
    return CheckpointRecorder(directory, config)


def test_each_checkpoint_plays_the_same_episode_by_the_rule_of_the_task(
    tmp_path, capsys
):
    paths = checkpoints_of_fresh_policies(tmp_path, 100, 200, 300)
    state = torch.get_rng_state()
    recorder = recorder_of(tmp_path)
    recorder.saved(paths[0])
    recorder.saved(paths[1].with_name("0000000150"))
    assert "0000000150 is not recorded, the training goes on" in capsys.readouterr().err
    # Another process goes on; what is there already is not recorded again.
    again = recorder_of(tmp_path, rerun_every=2)
    again.saved(paths[0])
    again.saved(paths[0])
    again.saved(paths[1])
    again.saved(paths[2], last=True)
    assert torch.equal(torch.get_rng_state(), state)
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


def test_a_recording_that_fails_leaves_the_training_as_it_is(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(suite, "SUITE", {"reach": None})
    result = run(small_ppo(rerun=True), tmp_path / "with")
    run(small_ppo(), tmp_path / "without")
    assert result.frames == 1_024
    with_it, without = (
        without_clocks(read_metrics(tmp_path / name / "metrics.csv"))
        for name in ("with", "without")
    )
    assert with_it == without
    assert "is not recorded, the training goes on" in capsys.readouterr().err


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
    "--algo ppo --preset demo --no-anneal --num-envs 4 --steps-per-update 256 --rerun "
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
    # Whatever moment it was, the file is whole.
    before = Contents(path)
    frames = int(checkpoints_in(out)[-1].name) + 512
    subprocess.run(train_command(out, frames, "--resume"), check=True, timeout=900)
    after = Contents(path)
    assert after.identity == before.identity
    for key, values in before.temporal.items():
        assert after.temporal[key][: len(values)] == values, key
    assert list(after.scalars("/training/checkpoint").values())[-1] == frames
    metrics = [row["frames"] for row in read_metrics(out / "metrics.csv")]
    assert list(after.scalars("/training/learner/entropy")) == metrics
