"""Tools beside the package: the matrix of versions."""

import importlib
import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import nbformat
import pytest
from conftest import slow
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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


def test_scripts_answer_help_and_refuse_what_they_do_not_know():
    """Else `--help` begins to measure, or writes pages."""
    folders = "docs/scripts", "benchmarks", "tools", "examples"
    paths = [p for name in folders for p in (TOOLS.parent / name).glob("*.py")]
    texts = {path.name: path.read_text() for path in paths}
    scripts = {name for name, text in texts.items() if "__main__" in text}
    reading = {n for n in scripts if re.search(r"ArgumentParser|tyro", texts[n])}
    assert len(scripts) > 40 and scripts == reading
    for words in (["--help"], ["--no-such-option"]):
        command = [sys.executable, TOOLS.parent / "docs/scripts/figures.py", *words]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.stdout.startswith("usage:") == (words == ["--help"])
        assert done.returncode == (0 if words == ["--help"] else 2)


@pytest.mark.parametrize(
    "words",
    [
        ("tools/trajectories.py", "--only", "x"),
        *slow(("docs/scripts/vessel.py", "costs")),
    ],
)
def test_scripts_refuse_parts_that_they_do_not_know(words):
    """Else they end in a traceback, or write pages and measure nothing."""
    script, *rest = words
    done = subprocess.run(
        [sys.executable, TOOLS.parent / script, *rest], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert f"{rest[-1]}" in done.stderr.splitlines()[-1]


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


def test_the_lock_has_all_requirements_at_the_pinned_versions():
    """And neither labmaze nor CUDA; `make lock` writes it."""
    root, cuda = TOOLS.parent, ("nvidia-", "cuda-", "numba-cuda", "triton")
    lines = (root / "requirements.lock").read_text().splitlines()
    locked = [x for x in lines if not x.startswith("#")]
    versions = dict(x.partition(" ;")[0].split("==") for x in locked)
    names = {canonicalize_name(name) for name in versions}
    assert not [x for x in names if x.startswith(cuda)]
    assert "labmaze" not in names
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["test"]]
    for extra in extras:
        if f"cathsim-dmc[{extra}]" in extras["test"]:
            wanted += extras[extra]
    for text in wanted:
        one = Requirement(text)
        if not one.name.startswith(("cathsim-dmc", *cuda)):
            found = versions[canonicalize_name(one.name)]
            assert one.specifier.contains(found), f"{text}, locked {found}: make lock"
    pins = (root / "constraints.txt").read_text().splitlines()
    for line in pins:
        if "==" in line and not line.startswith("#"):
            name, version = line.split("==")
            assert versions.get(canonicalize_name(name), version) == version, line


def test_the_container_installs_the_lock_and_runs_the_tests():
    text = (TOOLS.parent / "Dockerfile").read_text()
    assert len(text.splitlines()) <= 12
    for word in ("requirements.lock", "--no-deps", 'CMD ["make", "test"]'):
        assert word in text
    # The stamps that keep make from installing again.
    made = (TOOLS.parent / "Makefile").read_text()
    for stamp in (".created", ".installed", ".installed-test"):
        assert f"touch .venv/{stamp}" in text and f"$(VENV)/{stamp}:" in made


def test_notebooks_install_in_colab_and_get_a_badge(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS.parent / "docs" / "scripts"))
    notebooks = importlib.import_module("notebooks")
    monkeypatch.setattr(notebooks, "TUTORIALS", tmp_path)
    source = TOOLS.parent / "docs" / "tutorials"
    for path in source.glob("*.ipynb"):
        shutil.copy(path, tmp_path)
        first, second, *_ = nbformat.read(path, as_version=4).cells
        assert second.id == "colab" and first.source.startswith("# ")
        exec(second.source, {})  # does nothing here
    for _ in range(2):  # the second time changes nothing
        monkeypatch.setattr(sys, "argv", ["", "--repository", "someone/cathsim"])
        notebooks.main()
        seen = {p.name: p.read_text() for p in tmp_path.iterdir()}
    for name, text in seen.items():
        link = f"github/someone/cathsim/blob/main/docs/tutorials/{name}"
        assert text.count(link) == 1 and text.count("badge.svg") == 1
        assert 'REPOSITORY = \\"someone/cathsim\\"' in text
    monkeypatch.setattr(sys, "argv", ["", "--repository", ""])
    notebooks.main()
    for path in source.glob("*.ipynb"):
        assert (tmp_path / path.name).read_text() == path.read_text()
