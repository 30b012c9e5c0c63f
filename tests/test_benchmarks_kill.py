"""The runner killed at bad moments: it goes on without a lost cell."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux"),
]

GRID = """
[[row]]
label = "PPO"
algorithm = "ppo"
preset = "demo"
observation = "internal"
tasks = ["type1_bca"]
seeds = [0, 1]
total_frames = 4096
evaluation = { episodes = 2, task_kwargs = { max_steps = 300 } }

[row.settings]
num_envs = 8
steps_per_update = 512
checkpoint_frames = 512
metrics_frames = 512
normalisation_frames = 64
task_kwargs = { max_steps = 50 }
"""
CELLS = tuple(f"type1_bca-ppo-internal-demo-seed{seed}" for seed in (0, 1))
PATIENCE = 900  # s


class Table:
    """`cathsim benchmark table` of a tiny grid in a directory."""

    def __init__(self, directory, grid=GRID):
        self.directory = directory
        (directory / "grid.toml").write_text(grid)

    def start(self, program=("-m", "cathsim_dmc.cli"), **environment):
        command = [sys.executable, *program, "benchmark", "table"]
        return subprocess.Popen(
            [*command, "--grid", "grid.toml"],
            cwd=self.directory,
            env={**os.environ, **environment},
            stdout=subprocess.DEVNULL,
            stderr=open(self.directory / "errors.txt", "ab"),
        )

    def finish(self):
        """Runs to the end; returns the results by name."""
        with self.start() as runner:
            assert runner.wait(PATIENCE) == 0, self.errors()
        return self.results()

    def errors(self):
        return (self.directory / "errors.txt").read_text()

    def results(self):
        found = (self.directory / "results").glob("*.json")
        return {path.stem: json.loads(path.read_text()) for path in found}

    def run_of(self, cell):
        return self.directory / "runs/table" / cell

    def frames(self, cell):
        """Frames of the newest checkpoint."""
        names = [path.name for path in self.run_of(cell).glob("checkpoints/0*")]
        return max(map(int, names), default=0)


def kill_all(runner):
    """kill -9 for the runner and the process of its cell at once."""
    children = Path(f"/proc/{runner.pid}/task/{runner.pid}/children").read_text()
    for pid in (runner.pid, *map(int, children.split())):
        os.kill(pid, signal.SIGKILL)
    runner.wait()


def until(condition, runner, table):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert runner.poll() is None, table.errors()
        assert time.monotonic() < end, table.errors()
        time.sleep(0.002)


def check(table, before):
    """Both cells are finished, and what was finished before is untouched."""
    after = table.finish()
    assert sorted(after) == sorted(CELLS)
    for name, values in before.items():
        assert after[name] == values
    for name, values in after.items():
        assert values["training"]["frames"] == 4096
        frames = values["training"]["curve"]["frames"]
        assert frames == sorted(set(frames)), f"{name}: frames counted twice"
        assert frames[-1] == 4096
        assert values["evaluation"]["summary"]["episodes"] == 2
    left = [path.name for path in (table.directory / "results").iterdir()]
    assert sorted(left) == sorted(f"{name}.json" for name in CELLS)


def test_killed_in_training_in_a_checkpoint_and_in_the_evaluation(tmp_path):
    table = Table(tmp_path)
    first, second = CELLS
    run = table.run_of(first)

    # In training, some time after a checkpoint.
    runner = table.start()
    until(lambda: table.frames(first) >= 512, runner, table)
    time.sleep(random.Random(0).uniform(0, 2))
    kill_all(runner)
    kept = table.frames(first)
    assert 512 <= kept < 4096 and not table.results()

    # While a checkpoint is being written.
    runner = table.start()
    until(lambda: any(run.glob("checkpoints/.unfinished-*")), runner, table)
    kill_all(runner)
    assert table.frames(first) >= kept

    # Trained to the end, evaluation under way.
    runner = table.start()
    until(lambda: table.frames(first) >= 4096, runner, table)
    kill_all(runner)
    assert not table.results()

    # In the second cell: the first one stays as it is.
    runner = table.start()
    until(lambda: table.frames(second) >= 512, runner, table)
    before = table.results()
    assert list(before) == [first]
    kill_all(runner)
    assert len(before[first]["training"]["sessions"]) == 4
    check(table, before)


# `cathsim`, but it stops at one moment and says so; the process of a cell runs its
# first lines too.
PAUSING = """
import os, sys, time
from pathlib import Path
import torchrl.collectors
from cathsim_dmc import files
from cathsim_dmc.agents import evaluation

MOMENT, steps = os.environ["PAUSE_AT"], 0
write, replace, step_mdp = files.write_bytes, os.replace, evaluation.step_mdp

def pause():
    Path("paused").touch()
    time.sleep(3600)

def write_bytes(path, data):
    if MOMENT == "checkpoint" and Path(path).name == "learning.pt":
        pause()
    return write(path, data)

def put_in_place(source, target):
    if MOMENT == "result" and Path(target).parent.name == "results":
        pause()
    return replace(source, target)

def stepped(*args, **kwargs):
    global steps
    steps += 1
    if MOMENT == "evaluation" and steps == 10:
        pause()
    return step_mdp(*args, **kwargs)

files.write_bytes, os.replace, evaluation.step_mdp = write_bytes, put_in_place, stepped
from cathsim_dmc.cli import main

if __name__ == "__main__":
    sys.exit(main())
"""
# One cell, trained in seconds.
SHORT = (
    GRID.replace("[0, 1]", "[0]")
    .replace("total_frames = 4096", "total_frames = 1024")
    .replace("max_steps = 300", "max_steps = 30")
)


@pytest.mark.parametrize("moment", ["checkpoint", "evaluation", "result"])
def test_killed_in_the_midst_of(tmp_path, moment):
    table, cell = Table(tmp_path, SHORT), CELLS[0]
    (tmp_path / "pausing.py").write_text(PAUSING)
    runner = table.start(["pausing.py"], PAUSE_AT=moment)
    until((tmp_path / "paused").exists, runner, table)
    kill_all(runner)
    trained = table.run_of(cell) / "checkpoints/0000001024/checkpoint.json"
    assert table.results() == {}
    if moment == "checkpoint":
        assert table.frames(cell) == 0
        assert any(table.run_of(cell).glob("checkpoints/.unfinished-*/policy.pt"))
    else:
        assert table.frames(cell) == 1024
        written = trained.stat().st_mtime_ns
    values = table.finish()[cell]
    assert values["training"]["frames"] == 1024
    assert len(values["training"]["sessions"]) == 2
    frames = values["training"]["curve"]["frames"]
    assert frames == [512, 1024]
    assert values["evaluation"]["summary"]["episodes"] == 2
    if moment != "checkpoint":
        assert trained.stat().st_mtime_ns == written, "it was trained again"
    assert [path.name for path in (tmp_path / "results").iterdir()] == [f"{cell}.json"]
    assert not list(table.run_of(cell).glob("checkpoints/.*"))


def test_the_runner_alone_killed_takes_its_cell_along(tmp_path):
    table = Table(tmp_path)
    runner = table.start()
    until(lambda: table.frames(CELLS[0]) >= 512, runner, table)
    children = Path(f"/proc/{runner.pid}/task/{runner.pid}/children").read_text()
    runner.kill()
    runner.wait()
    end = time.monotonic() + PATIENCE
    while any(_alive(int(pid)) for pid in children.split()):
        assert time.monotonic() < end, "the cell's process lives on"
        time.sleep(0.1)
    check(table, table.results())


@pytest.mark.parametrize("seed", range(3))
def test_killed_at_random(tmp_path, seed):
    table, moments = Table(tmp_path), random.Random(seed)
    before = {}
    for _ in range(4):
        runner = table.start()
        begun = time.monotonic()
        moment = moments.uniform(2, 40)
        while runner.poll() is None and time.monotonic() - begun < moment:
            time.sleep(0.05)
        if runner.poll() is None:
            kill_all(runner)
        now = table.results()
        assert all(now[name] == values for name, values in before.items())
        before = now
    check(table, before)


def test_stopped_politely_it_leaves_a_checkpoint_and_goes_on(tmp_path):
    table = Table(tmp_path)
    runner = table.start()
    until(lambda: (table.run_of(CELLS[0]) / "metrics.csv").exists(), runner, table)
    time.sleep(3)
    runner.send_signal(signal.SIGINT)
    assert runner.wait(PATIENCE) == 130, table.errors()
    assert "interrupted" in table.errors()
    assert table.frames(CELLS[0]) > 0
    check(table, table.results())


def _alive(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
