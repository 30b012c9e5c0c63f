"""A grid killed and interrupted: it goes on without a lost cell."""

import json
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

    def __init__(self, directory):
        self.directory = directory
        (directory / "grid.toml").write_text(GRID)

    def start(self):
        command = [sys.executable, "-m", "cathsim_dmc.cli", "benchmark", "table"]
        return subprocess.Popen(
            [*command, "--grid", "grid.toml"],
            cwd=self.directory,
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


def test_killed_in_one_cell_and_interrupted_in_the_next(tmp_path):
    table, (first, second) = Table(tmp_path), CELLS
    with table.start() as runner:
        until(lambda: table.frames(first) >= 512, runner, table)
        runner.kill()
    kept = table.frames(first)
    assert 512 <= kept < 4096 and not table.results()
    # Trained to the end, evaluation under way.
    with table.start() as runner:
        until(lambda: table.frames(first) >= 4096, runner, table)
        runner.kill()
    written = table.run_of(first) / "checkpoints/0000004096/checkpoint.json"
    time_of_checkpoint = written.stat().st_mtime_ns
    with table.start() as runner:
        until(lambda: table.frames(second) >= 512, runner, table)
        runner.send_signal(signal.SIGINT)
        assert runner.wait(PATIENCE) == 130, table.errors()
    assert "interrupted after" in table.errors()
    before = table.results()
    assert list(before) == [first] and table.frames(second) < 4096
    check(table, before)
    assert written.stat().st_mtime_ns == time_of_checkpoint, "it was trained again"
