"""docs/features.md: what it names exists, and what exists is named."""

import ast
import dataclasses
import functools
import importlib
import inspect
import re
import shlex
import tomllib
from pathlib import Path

import pytest

from cathsim_dmc import cli, policies
from cathsim_dmc.agents import make_config, training
from cathsim_dmc.agents.learners import LEARNERS
from cathsim_dmc.agents.pretrained import pretrained_names
from cathsim_dmc.entities.devices import DEVICES
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.observations import OBSERVATIONS

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "features.md").read_text()
ROWS = [line for line in PAGE.splitlines() if line.startswith("| ")]
CODE = [code for row in ROWS for code in re.findall(r"`([^`]+)`", row.split("|")[-2])]
COMMANDS = [code for code in CODE if code.startswith("cathsim ")]
CALLS = [code for code in CODE if re.match(r"(cathsim_dmc|gymnasium)\.", code)]
OPTIONS = [code for code in CODE if code.startswith("{")]
QUICK = ["cathsim --version", "cathsim list", "cathsim list --devices"]
# Options of a task that are arguments of its objective or of `suite.load`.
BESIDE = {"reward", "goal_radius", "anatomy", "goal", "access"}
BESIDE |= {"arches", "pool", "first", "numbers", "random"}


@pytest.mark.parametrize("line", QUICK)
def test_quick_commands_run(line, cathsim):
    assert line in COMMANDS
    code, out, _ = cathsim(*shlex.split(line)[1:])
    assert not code and out


@pytest.mark.parametrize("line", [x for x in COMMANDS if x not in QUICK])
def test_a_command_has_its_options(line, cathsim):
    words = shlex.split(line)[1:]
    wanted = {word for word in words if re.match(r"--[a-z]", word)}
    known = words[:2] if words[0] == "phantom" else words[:1]
    algorithm = words[words.index("--algo") :][:2] if "--algo" in words else []
    code, text, _ = cathsim(*known, *algorithm, "--help")
    assert not code
    if words[0] in ("validate", "benchmark"):
        assert words[1] in text
    options = set(re.findall(r"--[a-z][a-z-]*", text))
    assert wanted <= options, line


def test_every_command_is_named():
    named = {shlex.split(line)[1] for line in COMMANDS}
    assert set(cli.COMMANDS) <= named
    from cathsim_dmc.cli.phantoms import phantoms

    verbs = {shlex.split(line)[2] for line in COMMANDS if " phantom " in line}
    assert set(phantoms._subcommands) == verbs


def _found(path):
    """What a dotted path names."""
    parts = path.split(".")
    for count in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        return functools.reduce(getattr, parts[count:], module)
    raise AssertionError(f"no module in {path}")


@pytest.mark.parametrize("code", CALLS)
def test_a_call_exists_and_takes_its_arguments(code):
    if code.startswith("gymnasium"):
        pytest.importorskip("gymnasium")
    tree = ast.parse(code, mode="eval").body
    path = ast.unparse(tree.func if isinstance(tree, ast.Call) else tree)
    found = _found(path)
    assert callable(found)
    if isinstance(tree, ast.Call):
        named = {one.arg: None for one in tree.keywords}
        inspect.signature(found).bind(*tree.args, **named)


def _options(code):
    text = re.sub(r"\btrue\b", "True", code)
    tree = ast.parse(text, mode="eval")
    dicts = [node for node in ast.walk(tree) if isinstance(node, ast.Dict)]
    return ast.literal_eval(dicts[0]) if dicts else {}


def test_options_of_tasks_are_those_of_the_page():
    given = [_options(code) for code in (*OPTIONS, *CALLS)]
    named = {name for one in given for name in one}
    fields = {field.name for field in dataclasses.fields(NavigationConfig)}
    assert named == fields | BESIDE
    config = {name: x for one in given for name, x in one.items() if name in fields}
    for name, value in config.items():
        if name not in ("effects", "devices", "lead", "lumen_friction", "rotation"):
            NavigationConfig(**{name: value})


def test_names_to_choose_from_are_those_of_the_package():
    seen = [
        one["observation"] for one in map(_options, OPTIONS) if "observation" in one
    ]
    assert {name for names in seen for name in names} == set(OBSERVATIONS)
    rows = {
        row.split("|")[1].strip(): set(re.findall(r"`([^`]+)`", row)) for row in ROWS
    }
    assert rows["policies"] == {*policies.POLICIES, "pretrained:NAME"}
    assert rows["pretrained"] == set(pretrained_names())
    assert rows["devices"] == set(DEVICES)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert rows["extras"] == set(project["optional-dependencies"])
    algorithms = {
        line.split("--algo ")[1].split()[0] for line in COMMANDS if "--algo" in line
    }
    assert algorithms == set(LEARNERS)
    assert make_config("ppo", "tuned").algorithm == "ppo"


def test_scripts_and_targets_exist():
    targets = re.findall(r"^([a-z][a-z -]*):", (ROOT / "Makefile").read_text(), re.M)
    targets = {name for line in targets for name in line.split()}
    for code in CODE:
        kind, _, name = code.partition(" ")
        if kind == "make":
            assert name in targets, code
        elif kind == "python":
            assert (ROOT / name).is_file(), code


class BegunError(Exception):
    """A training has its settings, and its first policy where one is named."""


@pytest.mark.parametrize(
    "line",
    [
        line
        for line in COMMANDS
        if " train " in line and " DIR" not in line and "--resume" not in line
    ],
)
def test_a_training_of_the_page_begins(line, cathsim, monkeypatch, tmp_path):
    def begin(*args):
        raise BegunError

    place = "make_collector" if "--initial-policy" in line else "_environment"
    monkeypatch.setattr(training, place, begin)
    monkeypatch.setattr(training, "check_usable", lambda config: None)  # of GPUs
    words = [word.replace("RUN", str(tmp_path / "run")) for word in shlex.split(line)]
    with pytest.raises(BegunError):
        cathsim(*words[1:])
