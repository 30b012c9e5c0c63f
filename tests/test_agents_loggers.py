"""Loggers beside metrics.csv, and what is called at each checkpoint."""

import csv
import subprocess
import sys

import pytest
import synthetic_env
import torch
from conftest import slow

from cathsim_dmc.agents import ConfigError, make_config, train
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.agents.loggers import EXTRAS, FigureLogger
from cathsim_dmc.agents.training_log import read_metrics

CLOCKS = ("seconds", "frames_per_second")


def run(out, logger=None, frames=1_024, resume=False, **options):
    config = make_config(
        "ppo", task="reach", num_envs=16, total_frames=frames, minibatch_size=128,
        normalisation_frames=256, steps_per_update=512, epochs=2, metrics_frames=512,
        checkpoint_frames=512, keep_checkpoints=1, logger=logger,
    )  # fmt: skip
    return train(config, out, resume, False, synthetic_env.make_env, **options)


def series(rows, name):
    """(frames, figure) of rows of metrics.csv, where it is known."""
    known = [(row["frames"], row[name]) for row in rows if row[name] is not None]
    return [(int(frames), pytest.approx(value)) for frames, value in known]


def from_csv(out, name):
    with open(out / "csv" / "scalars" / f"{name}.csv", newline="") as file:
        return [(int(frames), float(value)) for frames, value in csv.reader(file)]


def from_tensorboard(out, name):
    loader = pytest.importorskip(
        "tensorboard.backend.event_processing.event_file_loader"
    )
    (path,) = (out / "tensorboard").iterdir()
    events = loader.LegacyEventFileLoader(str(path)).Load()
    found = [(e.step, v) for e in events for v in e.summary.value if v.tag == name]
    return [(step, value.simple_value) for step, value in found]


READERS = {"csv": from_csv, "tensorboard": from_tensorboard}


@pytest.mark.parametrize("logger", ["csv", *slow("tensorboard")])
def test_a_logger_shows_metrics_csv_as_one_series_over_processes(tmp_path, logger):
    if logger in EXTRAS:
        pytest.importorskip(logger)
    for frames in (1_024, 2_048):
        run(tmp_path / "run", logger, frames, resume=frames > 1_024)
        rows = read_metrics(tmp_path / "run" / "metrics.csv")
        for name in ("step_reward", "episode_reward", "loss_critic", "seconds"):
            expected = series(rows, name)
            assert READERS[logger](tmp_path / "run", name) == expected
            assert expected
    assert len(rows) == 4
    # Showing disturbs nothing.
    run(tmp_path / "plain")
    run(tmp_path / "plain", None, 2_048, resume=True)
    plain = read_metrics(tmp_path / "plain" / "metrics.csv")
    for row in rows + plain:
        for name in CLOCKS:
            row.pop(name)
    assert rows == plain


def test_weights_and_biases_writes_files_only(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    rows = [{"frames": 512.0, "seconds": 1.0, "success": None}]
    logger = FigureLogger("wandb", tmp_path, rows)
    logger.show({"frames": 1_024.0, "seconds": 2.0, "success": 0.5})
    logger.close()
    (offline,) = (tmp_path / "wandb").glob("offline-run-*/run-*.wandb")
    assert offline.stat().st_size


@pytest.mark.parametrize("logger", EXTRAS)
def test_without_its_package_a_logger_is_refused_before_any_work(
    tmp_path, logger, monkeypatch
):
    monkeypatch.setitem(sys.modules, logger, None)
    with pytest.raises(ConfigError, match=rf"pip install .*\.\[{logger}\]"):
        run(tmp_path / "run", logger)
    assert not (tmp_path / "run").exists()


def test_an_unknown_logger_is_refused():
    with pytest.raises(ConfigError, match="csv, tensorboard, trackio, wandb"):
        make_config("ppo", logger="paper")


@pytest.mark.slow
def test_trainings_without_a_logger_import_none():
    text = (
        "import sys, cathsim_dmc.agents.training\n"
        "print([n for n in ('tensorboard', 'wandb', 'imageio') if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


def test_each_checkpoint_is_told_and_its_random_numbers_are_its_own(tmp_path):
    told = []

    def draw(checkpoint):
        Checkpoint.open(checkpoint)
        told.append(checkpoint.name)
        torch.rand(7)

    run(tmp_path / "told", on_checkpoint=draw)
    run(tmp_path / "plain")
    assert told == ["0000000512", "0000001024"]
    both = [read_metrics(tmp_path / n / "metrics.csv") for n in ("told", "plain")]
    for row in sum(both, []):
        for name in CLOCKS:
            row.pop(name)
    assert both[0] == both[1]
