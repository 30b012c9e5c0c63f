"""Tools beside the package: the audit, and the matrix of versions."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[1] / "tools"
AUDIT = TOOLS / "audit.py"
HOLE = {"id": "CVE-1", "fix_versions": ["2.1"]}
SOUND = {"name": "a", "version": "1.0", "vulns": []}
BROKEN = {"name": "b", "version": "2.0", "vulns": [HOLE]}
UNKNOWN = {"name": "c", "skip_reason": "not found"}


@pytest.fixture
def audit(tmp_path):
    """Runs the audit with a pip-audit that answers so, by service."""

    def run(**answers):
        script = tmp_path / "pip-audit"
        script.write_text(
            f"#!{sys.executable}\nimport sys\nanswers = {answers!r}\n"
            "service, = [a.partition('=')[2] for a in sys.argv if 'service' in a]\n"
            "if service not in answers:\n    sys.exit('ConnectionError')\n"
            "print(answers[service])\n"
        )
        script.chmod(0o755)
        (tmp_path / "constraints.txt").write_text("# pins\na==1.0\nb==2.0\n")
        return subprocess.run(
            [sys.executable, AUDIT, script, tmp_path / "constraints.txt"],
            capture_output=True,
            text=True,
        )

    return run


def answer(*packages):
    return json.dumps({"dependencies": packages})


def test_a_hole_fails_the_audit(audit):
    done = audit(pypi=answer(SOUND, BROKEN, UNKNOWN))
    assert done.returncode == 1, done.stderr
    assert "b 2.0: CVE-1, mended in 2.1" in done.stdout
    assert "2 of 3 packages audited, 1 holes" in done.stdout
    assert "not audited: c" in done.stdout


def test_the_next_database_is_asked_where_one_knows_nothing(audit):
    done = audit(pypi=answer(UNKNOWN), osv=answer(SOUND))
    assert done.returncode == 0 and "osv: 1 of 1 packages audited" in done.stdout
    assert audit(osv=answer(BROKEN)).returncode == 1


def test_nothing_audited_is_not_called_sound(audit):
    for answers in ({}, {"pypi": answer(UNKNOWN)}):
        done = audit(**answers)
        assert done.returncode == 0, done.stderr
        assert "audit of 2 packages skipped" in done.stdout


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
