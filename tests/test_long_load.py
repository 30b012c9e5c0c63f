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


@pytest.mark.slow
def test_a_short_load_is_measured(tmp_path):
    out = tmp_path / "load.json"
    done = run("--steps", 400, "--simulations", 4, "--rounds", 1, "--out", out)
    report = json.loads(out.read_text())
    assert done.stdout == out.read_text()
    checks = {check["name"]: check for check in report["checks"]}
    assert report["steps"] >= 400
    assert done.returncode == (0 if report["passed"] else 1)
    for name in ("MuJoCo warnings", "observations with NaN", "physics errors"):
        assert checks[name]["value"] == 0
    assert len(report["speeds"]["fresh"]) == 1


def test_a_folder_that_is_not_there_is_refused_before_the_load(tmp_path):
    done = run("--out", tmp_path / "none" / "load.json")
    assert done.returncode == 2
    assert "make the directory" in done.stderr


@pytest.mark.slow
def test_forty_thousand_steps_keep_the_bounds():
    done = run("--steps", 40_000, "--rounds", 5)
    report = json.loads(done.stdout)
    broken = [check for check in report["checks"] if not check["passed"]]
    # How fast a busy machine is says nothing.
    assert [c for c in broken if not c["name"].startswith("speed")] == []
