"""Tools beside the package: the matrix of versions."""

import json
import subprocess
import sys
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
