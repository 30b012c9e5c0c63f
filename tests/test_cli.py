"""The command line: what it prints, where, and with which exit code."""

import dataclasses
import importlib
import inspect
import io
import json
import math
import re
import shlex
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest
import tyro
from conftest import TASKS
from recording_samples import make_episode

from cathsim_dmc import __version__, cli, suite
from cathsim_dmc.agents import LEARNERS, Checkpoint
from cathsim_dmc.agents.checkpoint import checkpoints_in
from cathsim_dmc.agents.episodes import EpisodeOutcome
from cathsim_dmc.agents.policies import FunctionPolicy
from cathsim_dmc.analysis.force_statistics import EpisodeForces, Statistics
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.arch.arch import ArchSeed
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.bridge import ServeOptions
from cathsim_dmc.cli import agents as commands
from cathsim_dmc.cli import checks, options, result_tables, task_options, training
from cathsim_dmc.cli import phantoms as cli_phantoms
from cathsim_dmc.entities.devices import DEVICES
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.image_set import ImageSetOptions
from cathsim_dmc.validation import wall
from cathsim_dmc.validation.checks import Check, Report

# What works.


def test_list_shows_every_task_with_a_line_and_variants_once(cathsim):
    code, out, err = cathsim("list")
    assert code == 0 and not err
    for name in (*(n for n in TASKS if not n.endswith(("_wire", "_pair"))), "navigate"):
        assert name in out
    tasks, policies = out.split("Shipped policies:")
    assert tasks.count("_pair") == tasks.count("_wire") == 1
    assert "pretrained:navigator_pair" in policies
    assert "brachiocephalic" in out


def test_signs_that_an_encoding_lacks_are_spelt(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "argv", ["cathsim", "list", "--devices"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    assert rb"EI tip N\xb7mm\xb2" in out.buffer.getvalue()


def test_a_reader_that_has_seen_enough_is_no_failure():
    process = started("list")
    process.stdout.close()
    assert process.wait(60) == 0, process.stderr.read()


def test_a_closed_output_is_no_error(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "argv", ["cathsim", "--version"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0


@pytest.mark.parametrize(
    ("words", "place", "file"),
    [
        pytest.param(
            *(("phantom", "import", "x.stl"), "one", "one/anatomy.npz"),
            marks=pytest.mark.slow,
        ),
        (("phantom", "generate", "simple1"), "one", "one/anatomy.npz"),
        (("phantom", "build", "tree.json"), "one", "one/anatomy.npz"),
        (("eval", "push", "--task", "type1_bca"), "one", "one/evaluation.json"),
        pytest.param(
            *(("submit", "push", "--task", "type1_bca"), "one.json", "one.json"),
            marks=pytest.mark.slow,
        ),
        (("record", "push", "--task", "simple1_bca"), "one.npz", "one.npz"),
    ],
)
def test_a_command_says_which_file_it_replaces(
    cathsim, tmp_path, monkeypatch, words, place, file
):
    anatomy = phantoms.load("simple1")
    monkeypatch.setattr(cli_phantoms, "import_scan", lambda *where, **how: anatomy)
    tree = types.SimpleNamespace(build=lambda access: anatomy)
    monkeypatch.setattr(cli_phantoms, "read_tree", lambda path: tree)
    short = ("--max-steps", 1) if words[0] in ("eval", "record") else ()
    more = {"submit": ("--episodes", 2), "eval": ("--episodes", 1)}.get(words[0], ())
    text = f"{tmp_path / file}, which was there before, is replaced"
    # Those that simulate are not run without a file of before.
    simulates = bool(more or short)
    if simulates:
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    for there in (False, True)[simulates:]:
        code, out, err = cathsim(*words, *short, *more, "--out", tmp_path / place)
        assert code == 0 and (text in err) == there, err
        if words[0] == "submit":
            assert "2 episodes; success: 100 %; safe success, 0.5 N: 100 %" in out


@pytest.mark.parametrize("kind", [("type1",), ("test", "--index", 3)])
@pytest.mark.parametrize("more", [("--variant", "aberrant"), ("--neck",)])
def test_a_variant_that_would_change_nothing_is_refused(cathsim, tmp_path, kind, more):
    out = "--out", tmp_path / "x"
    code, _, err = cathsim("phantom", "generate", *kind, *more, *out)
    assert code == 2 and "which only I, II and III take" in err
    assert not list(tmp_path.iterdir())


def test_a_deleted_folder_is_named(cathsim, tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    code, out, err = cathsim("phantom", "generate", "type1", "--out", "here")
    assert (code, out) == (2, "")
    assert "the current folder has been deleted; change to another" in err


def test_list_as_json(cathsim):
    code, out, err = cathsim("list", "--json")
    assert code == 0 and not err
    printed = json.loads(out)
    assert printed["domain"] == "cathsim"
    assert list(printed["tasks"]) == list(suite.SUITE)
    assert all(line and "\n" not in line for line in printed["tasks"].values())


def test_the_devices_are_listed_in_the_units_that_are_named(cathsim):
    code, out, err = cathsim("list", "--devices", "--json")
    assert code == 0 and not err
    rows = json.loads(out)["devices"]
    assert list(rows) == list(DEVICES)
    wire, catheter = rows["wire_035_glide"], rows["steerable_5f"]
    assert wire["outer_diameter_mm"] == pytest.approx(0.035 * 25.4)
    assert catheter["lumen_diameter_mm"] == pytest.approx(1.0)
    # Nitinol, 48 GPa with a Poisson's ratio of 0.33; diameters of the core in mm.
    for part, core in (("shaft", 0.5), ("tip", 0.28)):
        bending = 48e3 * math.pi * core**4 / 64
        assert wire[f"{part}_bending_stiffness_n_mm2"] == pytest.approx(bending)
        torsion = wire[f"{part}_torsional_stiffness_n_mm2"]
        assert torsion == pytest.approx(bending / 1.33)
    assert wire["tip_length_mm"] == pytest.approx(30.0)
    assert 1.0 < wire["linear_density_g_per_m"] < 3.0  # the core alone has 1.3
    assert wire["shape"] == "45° in 6.3 mm, 4 mm straight"
    assert catheter["shape"] == "straight; steerable"
    _, out, _ = cathsim("list", "--devices")
    assert re.search(r"wire_035_glide +0\.889 +0 +147 +14\.5 +30 +45°", out)


def test_generated_phantom_can_be_navigated(cathsim, tmp_path):
    directory = tmp_path / "arch"
    directory.mkdir()
    (directory / "check.png").write_bytes(b"of another one")
    code, out, err = cathsim("phantom", "generate", "type2", "--out", directory)
    assert code == 0, err
    assert not (directory / "check.png").exists()
    assert str(directory) in out and "bca" in out
    kwargs = {"anatomy": str(directory), "goal": "lcca", "random": 1}
    environment = suite.load("cathsim", "navigate", task_kwargs=kwargs)
    made = environment.reset().observation
    environment.close()
    named = suite.load(
        "cathsim", "navigate", task_kwargs={**kwargs, "anatomy": "type2"}
    )
    expected = named.reset().observation
    named.close()
    for key, value in expected.items():
        assert made[key].tobytes() == value.tobytes(), key


@pytest.mark.slow
def test_check_prints_one_object_and_passes(cathsim):
    code, out, err = cathsim("phantom", "check", "type1", "--json")
    printed = json.loads(out)
    assert code == 0, [check for check in printed["checks"] if not check["passed"]]
    for check in printed["checks"]:
        assert {"name", "value", "unit", "bound", "passed"} <= set(check)
        assert isinstance(check["passed"], bool)


@pytest.mark.slow
def test_a_failed_check_exits_with_one(cathsim, tmp_path):
    """An arch that has lost a triangle of its surface has edges without two."""
    whole = phantoms.load("simple1")
    surface = Surface(whole.surface.vertices, whole.surface.faces[1:])
    dataclasses.replace(whole, name="torn", scan=surface).save(tmp_path)
    code, out, _ = cathsim("phantom", "check", tmp_path, "--json")
    assert code == 1
    failed = [c["name"] for c in json.loads(out)["checks"] if not c["passed"]]
    assert any("edges of the surface" in name for name in failed), failed


def test_every_option_of_a_task_is_one_of_the_evaluation(cathsim, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    _, out, _ = cathsim("eval", "--help")
    for task in ("type1_bca", "navigate", "arch_bca"):
        for name in set(suite.task_options(task)) - {"observation", "effects"}:
            assert f"--{name.replace('_', '-')}" in out, name


def test_an_evaluation_takes_options_of_the_task(cathsim):
    ranges = {"friction": [0.02, 0.06]}
    code, out, err = cathsim(
        *("eval", "push", "--task", "simple1_bca", "--episodes", 1, "--threads", 1),
        *("--randomisation", json.dumps(ranges), "--device", "steerable_4f"),
        *("--reward", '{"path": -1}', "--max-steps", 3, "--no-baseline", "--json"),
        *("--vessel", "silicone"),
    )
    assert code == 0, err
    found = json.loads(out)["policy"]
    assert found["settings"]["task_kwargs"] == {
        "randomisation": ranges, "device": "steerable_4f", "reward": {"path": -1},
        "max_steps": 3, "vessel": "silicone",
    }  # fmt: skip
    assert found["episodes"][0]["length"] == 3


def test_the_doctor_names_what_is_missing_and_what_to_do(cathsim, monkeypatch):
    real = checks.metadata.version
    versions = {"mujoco": "4.0.0"}

    def version(name):
        if name == "trimesh":
            raise checks.metadata.PackageNotFoundError(name)
        return versions.get(name) or real(name)

    code, out, _ = cathsim("doctor", "--json")
    found = {check["name"]: check for check in json.loads(out)["checks"]}
    assert code == 0 and all(check["passed"] for check in found.values())
    assert {"Python", "numpy", "OMP_NUM_THREADS", "compiled kernels", "OpenGL"} < {
        *found
    }
    monkeypatch.setattr(checks.metadata, "version", version)
    code, out, _ = cathsim("doctor")
    assert code == 1
    failed = [line for line in out.splitlines() if line.startswith("FAIL")]
    assert len(failed) == 2 and "pip install 'mujoco<4,>=3.17'" in failed[0]
    assert "trimesh: not installed" in failed[1]


def test_the_doctor_renders_to_see_whether_opengl_works(monkeypatch):
    """Without a display, GLFW gives contexts that cannot render."""
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    found = checks._opengl()
    assert "none (MUJOCO_GL glfw)" in found.value and "egl or osmesa" in found.note


def test_an_evaluation_reports_each_episode(cathsim):
    code, out, err = cathsim(
        *("eval", "push", "--task", "simple1_bca", "--episodes", 2, "--threads", 1),
        *("--max-steps", 5, "--no-baseline", "--report", "--protocol", "varied"),
    )
    assert code == 0, err
    title, *rows = out[out.index("task simple1_bca, protocol varied") :].splitlines()
    assert __version__ in title and "max_steps=5" in out
    episodes = [row for row in rows if "out of time" in row]
    assert len(episodes) == 2
    for row, device in zip(episodes, ("steerable_5f", "steerable_4f"), strict=True):
        assert device in row and " 0.2 " in row, row  # s, five control steps


@pytest.mark.parametrize(
    ("kind", "end"),
    [("success", "goal reached"), ("physics_error", "physics error"),
     ("given_up", "given up"), ("failed", "failed"), (None, "out of time")],
)  # fmt: skip
def test_a_report_says_how_an_episode_ended(kind, end):
    states = {name: name == kind for name in ("success", "failed", "physics_error")}
    states["terminated"] = kind is not None
    forces = EpisodeForces(mean_sum=Statistics(0.1, 0.2, 0.75))
    episode = EpisodeOutcome(
        env=0, reward=1.0, length=50, forces=forces, path_ratio=1.5, **states
    )
    row = result_tables._outcome(7, {"arch": 3, "device": "wire"}, episode)
    assert (row["seed"], row["anatomy"], row["device"]) == ("7", "arch 3", "wire")
    drawn = {"anatomy": "type2"}  # of a pool of anatomies
    assert result_tables._outcome(7, drawn, episode)["anatomy"] == "type2"
    assert (row["end"], row["time, s"], row["path ratio"]) == (end, "2.0", "1.50")
    assert (row["mean force, mN"], row["largest sum, N"]) == ("100", "0.75")


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("tracking,force", ["tracking", "force"]),
        ("tracking, force", ["tracking", "force"]),
        ('["tracking","force"]', ["tracking", "force"]),
        ("tracking", "tracking"),
    ],
)
def test_the_command_line_takes_several_names_as_a_list(text, meant):
    kind = task_options.task_kind(())
    given = tyro.cli(kind, args=["--observation", text, "--device", "a,b"]).given
    assert given == {"observation": meant, "device": "a,b"}
    devices = tyro.cli(kind, args=["--devices", "wire_035_glide,berenstein_5f"]).given
    assert devices == {"devices": ["wire_035_glide", "berenstein_5f"]}


def test_an_evaluation_keeps_the_options_that_a_policy_was_trained_with(monkeypatch):
    policy = FunctionPolicy(lambda observation: observation, "trained")
    policy.task, policy.task_kwargs = "type1_bca", {"rotation": True, "friction": 0.1}
    seen = {}

    def play(*arguments, task_kwargs, **others):
        seen.update(task_kwargs)
        raise InterruptedError

    monkeypatch.setattr(commands.agents, "load_policy", lambda *_: policy)
    monkeypatch.setattr(commands.agents, "evaluate", play)
    with pytest.raises(InterruptedError):
        commands.evaluate("trained", options=task_options.TaskOptions(goal="lcca"))
    assert seen == {"rotation": True, "friction": 0.1, "goal": "lcca"}


OUT = Path("OUT")
# A command, the function that it ends in, and what that is to be given.
HANDED_ON = [
    (
        "play simple1_bca --out OUT --seed 5 --episodes 2 --speed 3 --hands gamepad "
        "--max-steps 7",
        "play:play",
        {"task": "simple1_bca", "out": OUT, "seed": 5, "episodes": 2, "speed": 3.0,
         "hands": "gamepad", "task_kwargs": {"max_steps": 7}, "policy": None},
    ),
    (
        "demos simple1_bca --out OUT --seed 5 --episodes 2 --noise 0.2 --threads 1 "
        "--observation internal force --max-steps 7",
        "agents:record_demonstrations",
        {"episodes": 2, "observation": ("internal", "force"), "seed": 5, "noise": 0.2,
         "task_kwargs": {"max_steps": 7}, "num_threads": 1},
    ),
    (
        "eval push --task simple1_bca --out OUT --seed 5 --episodes 2 --threads 1 "
        "--protocol varied --simulation-device cuda:1 --max-steps 7",
        "agents:evaluate",
        {"task": "simple1_bca", "episodes": 2, "seed": 5, "protocol": "varied",
         "task_kwargs": {"max_steps": 7}, "num_threads": 1, "error_dir": OUT / "errors",
         "simulation_device": "cuda:1", "on_cluster": False, "start": None},
    ),
    (
        "eval --anatomy type1 push --phantom OUT --goal lcca,bca --threads 1 "
        "--access descending,",
        "agents:evaluate",
        {"task": "navigate",
         "task_kwargs": {"anatomy": ["type1", "OUT"], "goal": ["lcca", "bca"],
                         "access": ["descending", None]}},
    ),
    (
        "demos navigate --out OUT --anatomy type1 --goal bca",
        "agents:record_demonstrations",
        {"task_kwargs": {"anatomy": "type1", "goal": "bca"}},
    ),
    (
        "record push --task navigate --anatomy type1 --anatomy type2 --out OUT.rrd",
        "suite:load",
        {"task_kwargs": {"anatomy": ["type1", "type2"], "random": 1_000_000}},
    ),
    (
        "play navigate --anatomy type1 --anatomy type2 --out OUT",
        "play:play",
        {"task_kwargs": {"anatomy": ["type1", "type2"]}},
    ),
    (
        "submit push --out OUT.json --task type1_bca --episodes 2 --threads 1",
        "agents.submission:submit",
        {"policy": "push", "task": "type1_bca", "episodes": 2, "num_threads": 1},
    ),
    (
        "export type1_bca --out OUT --seed 5 --wall prisms --max-steps 7",
        "cli.exporting:write_mjcf",
        {"seed": 5, "wall": "prisms", "task_kwargs": {"max_steps": 7}},
    ),
    (
        "export pretrained:type1_bca --out OUT --task type1_lcca --seed 5",
        "cli.exporting:write_onnx",
        {"task": "type1_lcca", "task_kwargs": {}, "seed": 5},
    ),
    (
        "export pretrained:type1_bca --out OUT",
        "cli.exporting:write_onnx",
        {"task": None, "seed": 1_000_000},
    ),
    (
        "phantom generate type1 --out OUT --access descending",
        "anatomy.phantoms:load",
        {"name": "type1", "access": "descending"},
    ),
    (
        "replay e.rrd --web --port 9191 --data-port 9292",
        "recording.viewer:open_viewer",
        {"path": Path("e.rrd"), "web": True, "port": 9191, "data_port": 9292},
    ),
    (
        "dataset --anatomy type1 OUT --anatomy type2 --anatomies 1 0 1",
        "cli.recordings:write",
        {"options": ImageSetOptions(anatomy=("type1", "type2"), anatomies=(1, 0, 1))},
    ),
    (
        "dataset OUT --processes 2 --frames 5 --stride 3 --size 64 --seed 5",
        "cli.recordings:write",
        {"options": ImageSetOptions(frames=5, stride=3, size=64, seed=5),
         "processes": 2, "on_cluster": False},
    ),
    (
        "validate forces --mean 0.3 --sd 0.05 --margin 0.2",
        "validation.force_sensors:compare_forces",
        {"episode": None, "mean": 0.3, "sd": 0.05, "margin": 0.2},
    ),
    (
        "phantom export type1 --out OUT.xml --wall prisms",
        "anatomy.export:write_mjcf",
        {"wall": "prisms"},
    ),
    (
        "phantom generate II --out OUT --seed 5 --variant aberrant "
        "--access descending",
        "anatomy.arch.arch:build_seed",
        {"seed": ArchSeed(5, "II", "aberrant"), "access": "descending"},
    ),
    (
        "phantom import a.stl --out OUT --name own --units cm --frame RAS --axes ILA "
        "--inlet 1 2 3 --heart 4 5 6 --rename a=b --centreline c.csv --label 3",
        "cli.phantoms:import_scan",
        {"centreline_paths": (Path("c.csv"),), "units": "cm", "mesh_frame": "RAS",
         "axes": "ILA", "labels": (3,), "name": "own", "inlet": (1.0, 2.0, 3.0),
         "heart": (4.0, 5.0, 6.0), "rename": {"a": "b"}, "device": None},
    ),
    (
        "serve simple1_bca --port 0 --episodes 2 --lockstep --missed hold "
        "--watchdog 0.5 --force-limit 0.7",
        "bridge:serve",
        {"options": ServeOptions(True, "hold", 0.5, 0.7), "episodes": 2},
    ),
    (
        "record push --task simple1_bca --out OUT.rrd --seed 5 --max-steps 7",
        "suite:load",
        {"task_name": "simple1_bca", "task_kwargs": {"max_steps": 7, "random": 5}},
    ),
]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "place", "given"), HANDED_ON, ids=[row[1] for row in HANDED_ON]
)
def test_options_are_handed_on(cathsim, tmp_path, monkeypatch, words, place, given):
    """To the function that does the work; what it does with them is tested there."""
    name, function = place.split(":")
    module, seen = importlib.import_module(f"cathsim_dmc.{name}"), {}
    signature = inspect.signature(getattr(module, function))

    def called(*arguments, **options):
        bound = signature.bind(*arguments, **options)
        bound.apply_defaults()
        seen.update(bound.arguments)
        raise SystemExit

    monkeypatch.setattr(module, function, called)
    monkeypatch.chdir(tmp_path)
    cathsim(*words.split())
    assert {key: seen.get(key, "not given") for key in given} == given


@pytest.mark.parametrize("kept", [True, False])
def test_a_check_of_a_phantom_ends_with_the_code_of_its_report(
    cathsim, monkeypatch, kept
):
    found = Report("x", [Check("a", 1.0, "", "", kept)], {"type1": {"measures": {}}})
    monkeypatch.setattr(wall, "validate_anatomy", lambda anatomy: found)
    assert cathsim("phantom", "check", "type1")[0] == (0 if kept else 1)


@pytest.mark.parametrize(
    ("words", "shown"), [((), True), (("--no-fluoroscopy",), False)]
)
def test_a_recording_has_x_ray_images_unless_they_are_left_out(
    cathsim, tmp_path, monkeypatch, words, shown
):
    seen = []
    monkeypatch.setattr(commands, "_played", lambda *_: (make_episode(), None))
    monkeypatch.setattr(commands.recorded, "write", lambda *given: seen.append(given))
    out = tmp_path / "e.rrd"
    code, _, err = cathsim(
        "record", "push", "--task", "simple1_bca", "--out", out, *words
    )
    assert code == 0, err
    assert [given[2:] for given in seen] == [(out, shown)]


TINY = (
    *("--num-envs", 4, "--threads", 1, "--steps-per-update", 64, "--epochs", 1),
    *("--normalisation-frames", 0, "--max-steps", 8, "--quiet"),
)


def test_a_training_draws_from_several_anatomies(cathsim, tmp_path, monkeypatch):
    seen = []

    def train(config, *arguments, **options):
        seen.append(config.task_kwargs)
        raise InterruptedError("enough")

    monkeypatch.setattr(commands.agents, "train", train)
    cathsim(
        *("train", "navigate", "--out", tmp_path / "run", "--anatomy", "type1"),
        *("--anatomy", "type2", "--goal", "lcca"),
    )
    assert seen == [{"anatomy": ["type1", "type2"], "goal": "lcca"}]


def test_a_scene_of_several_anatomies_is_refused(cathsim, tmp_path):
    code, _, err = cathsim(
        *("export", "navigate", "--out", tmp_path / "scene", "--anatomy", "simple1"),
        *("--anatomy", "type1", "--goal", "bca"),
    )
    assert code == 2 and "draws from 2 anatomies; give one anatomy" in err
    assert not (tmp_path / "scene").exists()


def test_every_setting_is_a_typed_option(cathsim, tmp_path):
    code, out, err = cathsim(
        "train", "navigate", "--out", tmp_path, *TINY, "--frames", 64,
        "--phantom", "simple2", "--goal", "lcca", "--hidden", 8, 8,
        "--target-kl", 0.5, "--friction", 0.1, "--observation", "tracking", "force",
    )  # fmt: skip
    assert code == 0, err
    assert "64 frames in" in out
    config = Checkpoint.open(tmp_path).config
    assert (config.hidden, config.target_kl, config.epochs) == ((8, 8), 0.5, 1)
    assert config.observation == ("tracking", "force")
    assert config.task_kwargs == {
        "max_steps": 8, "friction": 0.1, "anatomy": "simple2", "goal": "lcca",
    }  # fmt: skip
    # A run that is resumed keeps its own settings and may go on for longer.
    code, out, err = cathsim("train", "--out", tmp_path, "--resume", "--frames", 128)
    assert code == 0, err
    assert Checkpoint.open(tmp_path).config == config.replace(total_frames=128)
    same = "--resume", "--algo", "ppo"
    code, _, err = cathsim("train", "--out", tmp_path, *same, "--frames", 64)
    assert code == 0 and "128 frames are done, of --frames 64: nothing" in err
    code, _, err = cathsim("train", "--out", tmp_path, "--resume", "--clip", 0.3)
    assert code == 2 and "clip: it has 0.1, given is 0.3" in err


@pytest.mark.parametrize("algorithm", LEARNERS)
def test_the_help_explains_every_setting(cathsim, monkeypatch, algorithm):
    monkeypatch.setenv("COLUMNS", "200")
    code, out, _ = cathsim("train", "--algo", algorithm, "--help")
    helps = task_options.field_helps(training._Run)
    assert algorithm in re.findall(r"\w+", helps["algo"])
    named = re.findall(r"\w+", helps["preset"])
    assert set(LEARNERS[algorithm].config.presets) <= set(named)
    assert code == 0
    for item in dataclasses.fields(LEARNERS[algorithm].config):
        if item.name in ("task", "task_kwargs"):
            continue
        option = "--" + {"modules": "import"}.get(item.name, item.name)
        assert option.replace("_", "-") in out
        text = task_options.field_helps(LEARNERS[algorithm].config)[item.name]
        assert text[0].isupper() and text.endswith("."), f"{option}: {text}"
        assert not text.startswith("Of "), f"{option}: {text}"


def started(*arguments):
    code = (
        "import sys; sys.argv = ['cathsim', *sys.argv[1:]]\n"
        "from cathsim_dmc import cli; cli.main()"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
def test_an_interrupted_training_says_how_to_go_on(cathsim, tmp_path):
    out = tmp_path / "my run"
    process = started(
        "train", "type1_bca", "--out", out, *TINY, "--frames", 10**6,
        "--checkpoint-frames", 64, "--keep-checkpoints", 1,
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while not checkpoints_in(out) and time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    saved = Checkpoint.open(out).frames
    (line,) = [line for line in err.splitlines() if "interrupted" in line]
    assert f"after {saved} of 1000000 frames" in line
    again = shlex.split(line.split("continue with: ")[1])
    assert again[0] == "cathsim"
    code, printed, err = cathsim(*again[1:], "--frames", saved + 64)
    assert code == 0, err
    assert f"{saved + 64} frames in" in printed


def test_a_run_that_is_refused_is_not_called_done(cathsim, tmp_path, monkeypatch):
    def refuse(*where, **how):
        raise ValueError("other settings")

    monkeypatch.setattr(training.agents, "train", refuse)
    monkeypatch.setattr(training, "checkpoints_in", lambda run: [run / "0000000320"])
    where = "--out", tmp_path / "run", "--resume"
    code, _, err = cathsim("train", "type1_bca", *where, "--frames", 300)
    assert (code, err) == (2, "cathsim: ValueError: other settings\n")


@pytest.mark.parametrize(
    "arguments",
    [("eval", "random", "--task", "type1_bca", "--episodes", 30), ("validate", "rod")],
)
@pytest.mark.slow
def test_an_interrupt_leaves_one_line(arguments):
    process = started(*arguments)
    time.sleep(6.0)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=180)
    assert (process.returncode, out) == (130, "")
    assert err.splitlines()[-1] == "cathsim: interrupted"
    assert "Traceback" not in err


@pytest.mark.slow
def test_an_arch_of_a_set_is_chosen(cathsim):
    where = ("--arches", "test", "--pool", 1, "--first", 2, "--max-steps", 3)
    code, out, err = cathsim(
        *("eval", "push", "--task", "femoral_arch_lcca", *where),
        *("--episodes", 1, "--no-baseline", "--json"),
    )
    assert code == 0, err
    task_kwargs = json.loads(out)["policy"]["settings"]["task_kwargs"]
    assert task_kwargs == {"arches": "test", "pool": 1, "first": 2, "max_steps": 3}


# Bad input: exit code 2, a message on stderr, nothing on stdout, nothing done.

TRAIN = ("train", "type1_bca", "--out", "OUT")
BAD = {
    "no such command": (["trian"], ["train", "eval"]),
    "no arguments": (["train"], ["TASK", "--out"]),
    "no such observation": (
        ["train", "type1_bca", "--out", "OUT", "--observation", "pixels"],
        ["pixels", "internal", "image", "sequential", "tracking"],
    ),
    "no such hyper-parameter": ([*TRAIN, "--gama", 0.9], ["--gama", "gamma"]),
    "text in a list": ([*TRAIN, "--hidden", 64, "x"], ["--hidden", "x"]),
    "a value out of range": ([*TRAIN, "--gamma", 2], ["gamma is 2.0", "at most 1"]),
    "an option of another algorithm": (
        [*TRAIN, "--tau", 0.1],
        ["--tau is a setting of sac, not of ppo", "--algo sac"],
    ),
    "nothing to resume": ([*TRAIN, "--resume"], ["no run in OUT to resume"]),
    "nothing to resume, no task": (
        ["train", "--out", "OUT", "--resume"],
        ["no run in OUT to resume"],
    ),
    "a goal of a task that has one": (
        ["eval", "random", "--task", "type1_bca", "--goal", "lsa"],
        ["type1_bca has no task option 'goal'", "navigate have it"],
    ),
    "settings as JSON": ([*TRAIN, "--settings", "{}"], ["--settings"]),
    "no such scan": (
        ["phantom", "import", "OUT.obj", "--out", "OUT"],
        ["OUT.obj", "no mesh file", "STL"],
    ),
    "an anatomy in place of a file": (
        ["phantom", "import", "OUT.obj", "--out", __file__],
        ["test_cli.py is a file", "directory", "--out"],
    ),
    "no such checkpoint": (["eval", "OUT"], ["no policy OUT", "expert"]),
    "no such policy to drive": (
        ["drive", "OUT", "--connect", "127.0.0.1:1"],
        ["no policy OUT", "none of pretrained:NAME"],
    ),
    "no such policy to start from": (
        [*TRAIN, "--initial-policy", "nobody", "--num-envs", 1],
        ["no policy nobody", "none of pretrained:NAME"],
    ),
    "a place of two numbers": (
        ["eval", "push", "--anatomy", "type1", "--goal", "22,15"],
        ["goal (--goal) is '22,15'", "x,y,z"],
    ),
    "a reward of the training": (
        [*TRAIN, "--training-reward", "paht", -1],
        ["training_reward is {'paht': -1.0}", "path"],
    ),
    "a picture that would be no PNG": (
        ["phantom", "check", "type1", "--figure", "OUT.jpg"],
        ["OUT.jpg does not end in .png"],
    ),
    "a seed of an arch": (
        ["phantom", "generate", "II", "--seed", -5, "--out", "OUT"],
        ["seed is -5", "from 0 to"],
    ),
    "a seed of demonstrations": (
        ["demos", "type1_bca", "--out", "OUT", "--seed", -5],
        ["seed is -5", "from 0 to"],
    ),
    "no threads": (
        ["demos", "type1_bca", "--out", "OUT", "--threads", 0],
        ["--threads", "is 0", "from 1 to"],
    ),
    "a seed of a drive": (
        ["drive", "pretrained:type1_lcca", "--connect", "127.0.0.1:1", "--seed", -5],
        ["seed is -5", "from 0 to"],
    ),
    "no spread of the published forces": (
        ["validate", "forces", "--sd", 0],
        ["sd is 0", "above 0"],
    ),
    "a film that is written twice": (
        ["record", "push", "--task", "type1_bca", "--out", "a.gif", "--gif", "a.gif"],
        ["both a.gif"],
    ),
    "no task to evaluate on": (["eval", "random"], ["needs a task"]),
    "arches where there are none": (
        ["eval", "push", "--task", "type1_bca", "--pool", 2],
        ["no task option 'pool'"],
    ),
    "a port without a page": (
        ["replay", "OUT.rrd", "--port", 9191],
        ["--port is 9191", "add --web"],
    ),
    "an option that is no JSON": (
        ["eval", "push", "--task", "type1_bca", "--randomisation", "{delay"],
        ["randomisation", "{delay", "friction"],
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


@pytest.mark.slow
def test_record_writes_the_formats_that_python_writes(tmp_path, capsys):
    arrays, film = tmp_path / "push.npz", tmp_path / "push.webp"
    for path in (arrays, film):
        options = task_options.task_kind()(max_steps=3)
        assert commands.record("push", path, task="simple1_bca", options=options) == 0
    assert str(arrays) in capsys.readouterr().out
    assert Episode.load(arrays).steps == 3 and film.stat().st_size > 1000
    assert sorted(tmp_path.iterdir()) == [arrays, film]
    recording = tmp_path / "push.rrd"  # its arrays replace those of before
    assert commands.record("push", recording, task="simple1_bca", options=options) == 0
    assert f"{recording} {arrays}" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"x.csv does not end in .rrd or .npz or .gif"):
        commands.record("push", tmp_path / "x.csv", task="simple1_bca", options=options)


def test_a_table_of_checks_has_no_markup(capsys):
    kept = Check.at_most("[x] of a file", 1.0, 2.0, "mm")
    lost = Check.at_most("other", 3.0, 2.0, "mm")
    assert options.show(Report("both", [kept, lost]), as_json=False) == 1
    shown = capsys.readouterr().out
    assert "pass" in shown and "FAIL" in shown and "[x] of a file" in shown
    assert "[/]" not in shown and "[green]" not in shown
