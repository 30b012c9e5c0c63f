"""Episodes of checkpoints, recorded during a training."""

import logging

import pytest
import torch
from test_agents_training import run, small_ppo, without_clocks

from cathsim_dmc import suite
from cathsim_dmc.agents import make_config, report, train
from cathsim_dmc.agents.metrics import read_metrics
from cathsim_dmc.recording import Episode

SMALL = {"num_envs": 1, "steps_per_update": 32, "normalisation_frames": 0, "epochs": 1}


def test_each_checkpoint_plays_the_same_episode_by_the_rule_of_the_task(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(report, "CHECKPOINT_STEPS", 6)
    config = make_config(
        task="simple1_bca", total_frames=64, checkpoint_frames=32, **SMALL
    )
    train(config.replace(rerun=True), tmp_path / "with", progress=False)
    state = torch.get_rng_state()
    train(config, tmp_path / "without", progress=False)
    assert torch.equal(torch.get_rng_state(), state)
    files = sorted(path.name for path in (tmp_path / "with/recordings").iterdir())
    frames = ("0000000032", "0000000064")
    assert files == [f"{name}.{kind}" for name in frames for kind in ("npz", "rrd")]
    first, second = (
        Episode.load(tmp_path / f"with/recordings/{name}.npz") for name in frames
    )
    assert first.steps == second.steps == 6
    assert (first.qpos[0] == second.qpos[0]).all() and first.seed == 1_000_000


def test_a_recording_that_fails_leaves_the_training_as_it_is(
    tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr(suite, "SUITE", {"reach": None})
    with caplog.at_level(logging.ERROR):
        result = run(small_ppo(rerun=True), tmp_path / "with")
    run(small_ppo(), tmp_path / "without")
    assert result.frames == 1_024
    with_it, without = (
        without_clocks(read_metrics(tmp_path / name / "metrics.csv"))
        for name in ("with", "without")
    )
    assert with_it == without
    assert "is not recorded, the training goes on" in caplog.text


def test_a_task_that_cannot_be_recorded_is_refused_at_once(tmp_path):
    with pytest.raises(ValueError, match="no task 'reach'"):
        run(small_ppo(rerun=True, task="reach"), tmp_path / "run")
    assert not (tmp_path / "run").exists()
