"""The long load, short: the script runs and its bounds can fail."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "long_load.py"
pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="reads /proc"
)


def run(*arguments):
    return subprocess.run(
        [sys.executable, str(SCRIPT), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=500,
    )


def test_a_folder_that_is_not_there_is_refused_before_the_load(tmp_path):
    done = run("--out", tmp_path / "none" / "load.json")
    assert done.returncode == 2
    assert "no directory" in done.stderr


def test_a_load_of_the_warm_up_alone_is_refused():
    done = run("--steps", 16)
    assert done.returncode == 2
    assert "--steps is 16; it must be 32 or more" in done.stderr


@pytest.mark.slow
def test_eight_thousand_steps_keep_the_bounds(tmp_path):
    out = tmp_path / "load.json"
    done = run("--steps", 8_000, "--rounds", 2, "--out", out)
    report = json.loads(out.read_text())
    assert done.stdout == out.read_text()
    assert done.returncode == (0 if report["passed"] else 1)
    assert report["steps"] >= 8_000 and len(report["speeds"]["fresh"]) == 2
    broken = [check for check in report["checks"] if not check["passed"]]
    # How fast a busy machine is says nothing.
    assert [c for c in broken if not c["name"].startswith("speed")] == []
