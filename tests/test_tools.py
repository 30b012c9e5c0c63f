"""Tools beside the package: the matrix of versions."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

TOOLS = Path(__file__).parents[1] / "tools"


def test_an_interpreter_that_is_only_a_name_is_not_there(tmp_path):
    """As the shims of pyenv are."""
    shim = tmp_path / "python3.99"
    shim.write_text("#!/bin/sh\nexit 127\n")
    shim.chmod(0o755)
    done = subprocess.run(
        [sys.executable, TOOLS / "compatibility.py", "--python", shim, "python0"]
        + ["--versions", "pinned"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    results = [json.loads(line)["result"] for line in done.stdout.splitlines()]
    assert results == ["no such interpreter"] * 2


def test_what_stands_for_labmaze_is_the_version_that_is_pinned():
    """Else pip would look for the one of the index, whose source needs bazel."""
    project = tomllib.loads((TOOLS / "labmaze" / "pyproject.toml").read_text())[
        "project"
    ]
    pins = (TOOLS.parent / "constraints.txt").read_text().splitlines()
    assert f"labmaze=={project['version'].partition('+')[0]}" in pins
    assert project["requires-python"] == ">=3.13"
    makefile = (TOOLS.parent / "Makefile").read_text()
    installing = [
        line
        for line in makefile.splitlines()
        if "--editable ." in line or "*.whl" in line
    ]
    assert all("$(LABMAZE)" in line for line in installing)
