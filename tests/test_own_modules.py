"""Tasks of one's own on the command line: `--import`, entry points, kept names."""

import dataclasses
import importlib
import json
import sys
import textwrap

import pytest
from dm_control import suite as dm_suite

from cathsim_dmc import agents, cli, suite
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.navigation import Navigation

MODULE = """
from cathsim_dmc import suite

suite.register(
    "{task}",
    suite.TaskDefinition(
        "A short task.", "type1", "bca", options={{"max_steps": 3}}
    ),
)
"""
SMALL = (
    *("--total-frames", 16, "--num-envs", 2, "--hidden", 8, "--steps-per-update", 16),
    *("--minibatch-size", 16, "--epochs", 1, "--normalisation-frames", 4, "--quiet"),
)


@pytest.fixture
def forget(monkeypatch):
    """Tasks and modules of a test are forgotten after it."""
    before, loaded = dict(suite.TASKS), set(sys.modules)
    tagged, path = dict(suite.SUITE), list(sys.path)

    def forgotten():
        suite.TASKS.clear()
        suite.TASKS.update(before)
        for name in set(suite.SUITE) - set(tagged):
            del suite.SUITE._tasks[name]
            for kept in suite.SUITE._tags.values():
                kept.pop(name, None)
        suite._register_domain()
        for name in set(sys.modules) - loaded:
            if "own_" in name:
                del sys.modules[name]

    yield forgotten
    forgotten()
    sys.path[:] = path


@pytest.fixture
def module(tmp_path, monkeypatch, forget):
    """A function that writes a module with a task into the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)  # undone, with the caches of importlib

    def write(name, task):
        text = MODULE.format(task=task)
        (tmp_path / f"{name}.py").write_text(textwrap.dedent(text))
        return name

    return write


@pytest.mark.slow
def test_a_run_on_an_own_task_says_which_module_it_needs(cathsim, module, forget):
    module("own_one", "own_short")
    code, _, err = cathsim("train", "own_short", "--out", "run", *SMALL)
    assert code == 2 and "--import MODULE" in err and len(err) < 500
    code, out, err = cathsim(
        "train", "own_short", "--import", "own_one", "--out", "run", *SMALL
    )
    assert code == 0, err
    config = json.loads(open("run/config.json").read())
    assert config["modules"] == ["own_one"]
    forget()
    plays = ("--episodes", 1, "--no-baseline", "--json")
    code, _, err = cathsim("eval", "run", *plays)
    assert code == 2 and "if you trust them" in err and "--import own_one" in err
    assert "own_one" not in sys.modules, "a file chose what runs"
    code, _, err = cathsim("train", "own_short", "--resume", "--out", "run")
    assert code == 2 and "--import own_one" in err
    with pytest.raises(ValueError, match="Python: import own_one"):
        agents.evaluate("run", episodes=1)
    code, out, err = cathsim("eval", "--import", "own_one", "run", *plays)
    assert code == 0, err
    played = json.loads(out)["policy"]
    assert played["task"] == "own_short" and played["episodes"][0]["length"] == 3
    forget()
    code, _, err = cathsim(
        "record", "run", "--import=own_one", "--gif", "a.gif", "--no-fluoroscopy"
    )
    assert code == 0, err
    code, out, _ = cathsim("list", "--json")
    assert "own_short" in json.loads(out)["tasks"]


@pytest.mark.parametrize("command", ["demos own_demo --out a-v0 --episodes 1", "list"])
def test_commands_take_own_tasks(cathsim, module, command):
    if command.startswith("demos"):
        pytest.importorskip("minari")
    module("own_two", "own_demo")
    code, out, err = cathsim(*command.split(), "--import", "own_two")
    assert code == 0, err
    assert "own_demo" in out or "episodes succeed" in out


class Timed(Navigation):
    def should_terminate_episode(self, physics):
        return super().should_terminate_episode(physics) or physics.time() > 0.1


def test_a_task_of_a_class_of_ones_own_is_loaded_by_dm_control(forget):
    known = suite.TASKS["simple1_bca"]
    with pytest.raises(ValueError, match="^task is 'Timed'.*subclass"):
        suite.register("own_time", dataclasses.replace(known, task="Timed"))
    suite.register("own_time", dataclasses.replace(known, task=Timed))
    env = dm_suite.load("cathsim", "own_time", {"random": 0, "max_steps": 50})
    env.reset()
    lasts = [env.step(env.action_spec().minimum).last() for _ in range(3)]
    assert lasts == [False, False, True]
    with pytest.raises(ValueError, match="Timed overrides should_terminate_episode"):
        BatchSimulation(suite.make_task("own_time"), 2)


def test_a_task_of_ones_own_has_an_id_of_gymnasium(forget):
    gymnasium = pytest.importorskip("gymnasium")
    ids = importlib.import_module("cathsim_dmc.gym").IDS  # before the task is there
    suite.register("own_id", suite.TASKS["simple1_bca"])
    assert ids["cathsim/own_id-v0"] == "own_id"
    assert gymnasium.spec("cathsim/own_id-v0").kwargs == {"task": "own_id"}


OBJECTIVE = """
from cathsim_dmc import suite
from cathsim_dmc.tasks.objectives import Cannulation

def objective(anatomy, goal, *, bonus=1.0, terms=()):
    reward = {"success": bonus} | dict.fromkeys(terms, -1.0)
    return Cannulation.to(anatomy, goal, reward=reward, goal_radius=0.5)

suite.register(
    "own_bonus", suite.TaskDefinition("A bonus.", "simple1", "bca", None, objective)
)
"""


def test_options_of_an_own_objective_are_given_on_the_command_line(
    cathsim, module, tmp_path
):
    module("own_four", "own_fourth")
    (tmp_path / "own_four.py").write_text(OBJECTIVE)
    play = "eval", "push", "--task", "own_bonus", "--import", "own_four", "--json"
    play += "--no-baseline", "--episodes", 1
    given = "--option", "bonus=70", "--option", 'terms=["time"]'
    code, out, err = cathsim(*play, *given)
    assert code == 0, err
    result = json.loads(out)["policy"]
    options = {"bonus": 70, "terms": ["time"]}
    assert options.items() <= result["settings"]["task_kwargs"].items()
    (episode,) = result["episodes"]
    assert abs(episode["reward"] + episode["length"] - 70) <= 1
    for wrong in ("bonus", "=3", "bonus=3 --option bonus=4"):
        code, _, err = cathsim(*play, "--option", *wrong.split())
        assert code == 2 and "it must be name=value" in err
    code, _, err = cathsim(*play, "--option", "bonuss=3")
    assert code == 2 and "no task option 'bonuss'" in err


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_commands_with_the_option_import_the_modules(cathsim, command):
    """`serve`, `export` and `replay-error` once had it and imported nothing."""
    words = [command] + ["type1_bca"] * (command == "train")
    code, out, _ = cathsim(*words, "--help")
    assert code == 0
    assert ("--import MODULE" in out) == (command in cli.modules.COMMANDS)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "give the name of a module"),
        ("own_missing", "no such module in Python's path, nor in"),
        ("own_three.py", "no such module"),
        ("own-three", "without .py"),
        ("own_broken", "--import own_broken fails: division by zero"),
        ("own_lacks", "No module named 'own_nothing'"),
    ],
)
def test_modules_that_cannot_be_imported_are_named(
    cathsim, module, tmp_path, name, message
):
    module("own_three", "own_third")
    (tmp_path / "own_broken.py").write_text("1 / 0")
    (tmp_path / "own_lacks.py").write_text("import own_nothing")
    code, out, err = cathsim("list", "--import", name)
    assert code == 2 and message in err and not out
    assert "Traceback" not in err


def distribution(folder, name, value):
    """A distribution that is installed in a folder, with an entry point."""
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n"
    )
    (about / "entry_points.txt").write_text(f"[cathsim.tasks]\nmine = {value}\n")


def test_tasks_of_installed_packages_are_there(cathsim, module, tmp_path):
    module("own_four", "own_fourth")
    distribution(tmp_path, "own_package", "own_four")
    code, out, err = cathsim("list", "--json")
    assert code == 0 and not err
    assert "own_fourth" in json.loads(out)["tasks"]


def test_a_function_may_register_them(cathsim, module, tmp_path):
    (tmp_path / "own_five.py").write_text(
        "def tasks():\n    import own_six\n\n\nvalue = 3\n"
    )
    module("own_six", "own_sixth")
    distribution(tmp_path, "own_package", "own_five:tasks")
    code, out, _ = cathsim("list", "--json")
    assert code == 0 and "own_sixth" in json.loads(out)["tasks"]


def test_an_installed_package_that_fails_is_left_out(cathsim, module, tmp_path):
    (tmp_path / "own_seven.py").write_text("raise OSError('broken')")
    distribution(tmp_path, "own_package", "own_seven")
    code, out, err = cathsim("list", "--json")
    assert code == 0 and "type1_bca" in json.loads(out)["tasks"]
    assert "own_package is left out: its entry point mine = own_seven fails" in err
    assert "OSError: broken" in err


def test_a_misspelt_task_gives_those_that_are_like_it():
    with pytest.raises(ValueError, match="such as type1_lcca") as caught:
        suite.make_task("type1_lca")
    assert len(str(caught.value)) < 300
