"""The command line: what it prints, where, and with which exit code."""

import dataclasses
import json
import subprocess
import sys

import pytest
from conftest import TASKS

from cathsim_dmc import cli, suite
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.arch import arch


@pytest.fixture
def cathsim(monkeypatch, capsys):
    """Returns a function that runs `cathsim ARGUMENTS`: (code, stdout, stderr)."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["cathsim", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        captured = capsys.readouterr()
        return end.value.code or 0, captured.out, captured.err

    return run


def only_json(text):
    """The object that is the whole of a text."""
    return json.loads(text)


# What works.


def test_list_shows_every_task_with_a_line(cathsim):
    code, out, err = cathsim("list")
    assert code == 0 and not err
    for name in (*TASKS, "navigate"):
        assert name in out
    assert "brachiocephalic" in out


def test_list_as_json(cathsim):
    code, out, err = cathsim("list", "--json")
    assert code == 0 and not err
    printed = only_json(out)
    assert printed["domain"] == "cathsim"
    assert list(printed["tasks"]) == list(suite.SUITE)
    assert all(line and "\n" not in line for line in printed["tasks"].values())


def test_help_names_every_command(cathsim):
    code, out, _ = cathsim("--help")
    assert code == 0
    for command in ("list", "train", "eval", "record", "replay", "phantom", "validate"):
        assert command in out


def test_generated_phantom_can_be_navigated(cathsim, tmp_path):
    directory = tmp_path / "arch"
    code, out, err = cathsim("phantom", "generate", "type2", "--out", directory)
    assert code == 0, err
    assert str(directory) in out and "bca" in out
    kwargs = {"phantom": str(directory), "goal": "lcca", "random": 1}
    environment = suite.load("cathsim", "navigate", task_kwargs=kwargs)
    made = environment.reset().observation
    environment.close()
    named = suite.load(
        "cathsim", "navigate", task_kwargs={**kwargs, "phantom": "type2"}
    )
    expected = named.reset().observation
    named.close()
    for key, value in expected.items():
        assert made[key].tobytes() == value.tobytes(), key


def test_generated_phantom_of_a_seed(cathsim, tmp_path):
    code, _, err = cathsim(
        "phantom", "generate", "I", "--seed", 4, "--out", tmp_path / "random"
    )
    assert code == 0, err
    anatomy = Anatomy.load(tmp_path / "random")
    usual = arch.load("simple1")
    assert set(anatomy.goals) >= {"bca", "lcca"}
    drawn = anatomy.tree.vessel("bca").centreline.length
    assert drawn != usual.tree.vessel("bca").centreline.length


def test_check_prints_one_object_and_passes(cathsim):
    code, out, err = cathsim("phantom", "check", "type1", "--json")
    printed = only_json(out)
    assert code == 0, [check for check in printed["checks"] if not check["passed"]]
    for check in printed["checks"]:
        assert {"name", "value", "unit", "bound", "passed"} <= set(check)
        assert isinstance(check["passed"], bool)


def test_a_failed_check_exits_with_one(cathsim, tmp_path):
    """An arch that has lost three pieces of its wall leaks."""
    whole = arch.load("type1")
    leaking = dataclasses.replace(whole, name="leaking", wall=whole.wall[3:])
    leaking.save(tmp_path)
    code, out, _ = cathsim("phantom", "check", tmp_path, "--json")
    assert code == 1
    failed = [c["name"] for c in only_json(out)["checks"] if not c["passed"]]
    assert any("coverage" in name for name in failed), failed


@pytest.mark.slow
def test_evaluation_prints_one_object(cathsim):
    code, out, err = cathsim(
        "eval",
        "random",
        "--task",
        "type1_bca",
        "--episodes",
        2,
        "--no-baseline",
        "--threads",
        1,
        "--json",
    )
    assert code == 0, err
    assert isinstance(only_json(out), dict)


def test_a_reader_that_stops_early_is_no_error():
    program = (
        "import sys; sys.argv = ['cathsim', 'list', '--json']\n"
        "from cathsim_dmc import cli; cli.main()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        process.stdout.close()
        assert process.wait(timeout=60) == 0
        assert process.stderr.read() == ""


# Bad input: exit code 2, a message on stderr, nothing on stdout, nothing done.

BAD = {
    "no such command": (["trian"], ["train", "eval"]),
    "no arguments": (["train"], ["task", "out"]),
    "no such task": (["train", "type9", "--out", "OUT"], ["type9", *TASKS]),
    "no such algorithm": (
        ["train", "type1_bca", "--out", "OUT", "--algo", "dqn"],
        ["ppo", "sac"],
    ),
    "no such observation": (
        ["train", "type1_bca", "--out", "OUT", "--observation", "pixels"],
        ["pixels", "internal", "image", "sequential", "tracking"],
    ),
    "no such hyper-parameter": (
        ["train", "type1_bca", "--out", "OUT", "--settings", '{"gama": 0.9}'],
        ["gama", "gamma"],
    ),
    "settings that are no JSON": (
        ["train", "type1_bca", "--out", "OUT", "--settings", "gamma=1"],
        ["gamma=1", "JSON object"],
    ),
    "settings that are no object": (
        ["train", "type1_bca", "--out", "OUT", "--settings", "[1]"],
        ["[1]", "JSON object"],
    ),
    "no such goal": (
        [
            *("train", "navigate", "--out", "OUT"),
            *("--phantom", "type1", "--goal", "x"),
        ],
        ["bca", "lcca", "lsa"],
    ),
    "no such arch": (
        ["phantom", "generate", "type7", "--out", "OUT"],
        ["type7", *arch.ARCHES],
    ),
    "no such phantom": (
        ["phantom", "check", "OUT"],
        ["directory", *arch.ARCHES],
    ),
    "no such scan": (
        ["phantom", "import", "OUT.obj", "--centreline", "OUT.csv", "--out", "OUT"],
        ["OUT.csv", ".mrk.json"],
    ),
    "no such checkpoint": (["eval", "OUT"], ["no checkpoint", "OUT"]),
    "no task to evaluate on": (["eval", "random"], ["needs a task"]),
    "no such task to evaluate on": (
        ["eval", "random", "--task", "type9"],
        ["type9", *TASKS],
    ),
    "no such recording": (["replay", "OUT.rrd"], ["OUT.rrd"]),
    "no such task to record": (
        ["record", "push", "--task", "type9", "--out", "OUT.rrd"],
        ["type9", *TASKS],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(cathsim, tmp_path, monkeypatch, case):
    arguments, words = BAD[case]
    monkeypatch.chdir(tmp_path)
    code, out, err = cathsim(*arguments)
    assert code == 2, err
    assert out == ""
    assert "Traceback" not in err
    # Boxes of the parser break lines.
    flat = " ".join(err.replace("│", " ").split())
    for word in words:
        assert word in flat, f"{word!r} not in: {flat}"
    assert not list(tmp_path.iterdir()), "work was begun"
