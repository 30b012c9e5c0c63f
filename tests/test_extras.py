"""What an installation without the extras says, before any work."""

import re
import sys
import tomllib
from pathlib import Path

import pytest

from cathsim_dmc import agents, extras
from cathsim_dmc.recording import coco, dataset, image_set

ROOT = Path(__file__).parents[1]


def demonstrate(folder):
    agents.record_demonstrations("type1_bca", folder / "out", episodes=1)


CALLS = [
    ("gymnasium", lambda folder: __import__("cathsim_dmc.gym")),
    ("gymnasium", demonstrate),
    ("minari", demonstrate),
    ("minari", lambda folder: list(dataset.read_episodes(folder))),
    ("h5py", lambda folder: image_set.write(folder / "out")),
    ("h5py", lambda folder: coco.labels(folder / "a.h5", 0)),
]


@pytest.mark.parametrize(("module", "call"), CALLS)
def test_a_missing_package_is_named_with_its_extra(module, call, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "cathsim_dmc.gym", raising=False)
    with pytest.raises(ModuleNotFoundError, match=f"^{module} is not installed") as e:
        call(tmp_path)
    assert "pip install -c constraints.txt -e '.[gym]'" in str(e.value)
    assert not list(tmp_path.iterdir())


def test_nothing_is_installed_by_a_name_that_no_index_has():
    """The package is installed from a checkout or from a wheel."""
    published = re.compile(r"pip install [^\n]*cathsim[-_]dmc\b(?!-)")
    pages = [
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob("docs/**/*.ipynb"),
    ]
    sources = [*ROOT.glob("cathsim_dmc/**/*.py"), *ROOT.glob("examples/*.py")]
    wrong = [path for path in pages + sources if published.search(path.read_text())]
    assert not wrong


def test_the_extras_that_are_named_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    sources = ROOT.glob("cathsim_dmc/**/*.py")
    named = {
        extra
        for path in sources
        for extra in re.findall(r'extras\.\w+\("(\w+)"', path.read_text())
    }
    assert named and named <= set(project["optional-dependencies"])
    assert extras.adding("gym").endswith("adds it")
