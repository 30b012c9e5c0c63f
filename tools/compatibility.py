"""Compatibility: the tests in fresh environments of several Pythons and versions.

    python tools/compatibility.py                 # smoke test everywhere
    python tools/compatibility.py --tests         # the fast suite everywhere

Every Python of `PYTHONS` that is on the path is tried with three sets of versions: the
pinned ones (constraints.txt), the newest allowed and the lowest allowed ones of the
main dependencies. A set that cannot be installed is reported, but is no failure. Exit
code 1: a set was installed and failed.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PYTHONS = ("python3.11", "python3.12", "python3.13", "python3.14")
# dm-control requires labmaze, which has no wheel for these Pythons.
LABMAZE = f"{ROOT / 'tools' / 'labmaze'} ; python_version >= '3.13'"
SETS = ("pinned", "newest", "lowest")
# Dependencies whose lowest allowed version is installed; the others follow from them.
MAIN = ("numpy", "scipy", "mujoco", "dm-control", "torch", "torchrl", "trimesh", "tyro")
# One task, stepped; one image; one network.
SMOKE = ROOT / "tools" / "smoke.py"


def lowest() -> list[str]:
    """The lowest allowed versions of the main dependencies, as pins."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = []
    for requirement in project["dependencies"]:
        found = re.fullmatch(r"([\w-]+)\s*>=\s*([\d.]+).*", requirement)
        if found and found[1] in MAIN:
            version = found[2] if "." in found[2] else f"{found[2]}.0"
            pins.append(f"{found[1]}=={version}" + ".*" * (version.count(".") < 2))
    return pins


def environment(python: str, versions: str, folder: Path, tests: bool) -> tuple:
    """Makes a fresh environment; returns its Python, and an error text or None."""
    subprocess.run([python, "-m", "venv", str(folder)], check=True)
    inside = folder / "bin" / "python"
    wanted = [f"{ROOT}[test]" if tests else str(ROOT), LABMAZE]
    if versions == "pinned":
        wanted += ["--constraint", str(ROOT / "constraints.txt")]
    if versions == "lowest":
        wanted += lowest()
    done = subprocess.run(
        [str(inside), "-m", "pip", "install", "--quiet", "--no-compile", *wanted],
        capture_output=True,
        text=True,
    )
    lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
    return inside, None if done.returncode == 0 else (lines or ["pip failed"])[0]


def is_there(python: str) -> bool:
    """Whether an interpreter is on the path and runs."""
    if shutil.which(python) is None:
        return False
    return subprocess.run([python, "-c", ""], capture_output=True).returncode == 0


def attempt(python: str, versions: str, tests: bool) -> dict:
    """Installs and tests one cell of the matrix; returns its result."""
    cell = {"python": python, "versions": versions}
    if not is_there(python):
        return {**cell, "result": "no such interpreter"}
    with tempfile.TemporaryDirectory(prefix="compatibility-") as folder:
        inside, wrong = environment(python, versions, Path(folder) / "venv", tests)
        if wrong:
            return {**cell, "result": f"not installable: {wrong}"}
        command = [str(inside), str(SMOKE)]
        if tests:
            command = [str(inside), "-m", "pytest", "-q", "-m", "not slow"]
        done = subprocess.run(
            command, cwd=ROOT if tests else folder, capture_output=True, text=True
        )
        last = (done.stdout.strip() or done.stderr.strip()).splitlines()[-1:]
        result = "passed" if done.returncode == 0 else "FAILED"
        return {**cell, "result": result, "detail": " ".join(last)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tests", action="store_true", help="run the fast suite")
    parser.add_argument("--python", nargs="*", default=PYTHONS)
    parser.add_argument("--versions", nargs="*", default=SETS, choices=SETS)
    arguments = parser.parse_args()
    cells = []
    for python in arguments.python:
        for versions in arguments.versions:
            cells.append(attempt(python, versions, arguments.tests))
            print(json.dumps(cells[-1]), flush=True)
    return 1 if any(cell["result"] == "FAILED" for cell in cells) else 0


if __name__ == "__main__":
    sys.exit(main())
