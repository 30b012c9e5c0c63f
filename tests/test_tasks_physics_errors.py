import contextlib
import dataclasses
import json
import logging
import types
from pathlib import Path
from unittest import mock

import mujoco
import numpy as np
import pytest
from conftest import twin

from cathsim_dmc import json_options, suite
from cathsim_dmc.agents.protocols import VARIED_RANGES
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.entities.devices import DEVICES
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.physics.flow import FlowOptions
from cathsim_dmc.physics.vessel import VesselOptions
from cathsim_dmc.simulation import batch, error_files
from cathsim_dmc.tasks import physics_errors, start


@pytest.fixture(scope="module")
def task():
    """A task that environments and batches compile, each for itself."""
    return suite.make_task("type1_bca")


@pytest.fixture
def load(task):
    """Returns a function that makes an environment of the task, with seed 3."""
    return lambda: suite.environment(twin(task, 3))


def _push(environment):
    action = np.zeros(environment.action_spec().shape)
    action[0], action[-1] = 1.0, 1.0
    return action


def test_a_device_in_lumen_and_sheath_has_not_escaped():
    anatomy = phantoms.load("simple1")
    inlet = anatomy.inlet
    way = np.linspace(-0.3, 0.1, 81)[:, None]
    straight = inlet.position + way * inlet.direction
    both = np.stack([straight, straight + [0.03, 0, 0]])
    assert physics_errors.escaped(anatomy, both, inlet.direction).tolist() == [0, 1]


def test_a_device_that_indents_a_compliant_wall_has_not_escaped():
    """A tip that snaps in a retroflexed curl indents an aorta by 2.9 mm."""
    anatomy = phantoms.load("simple1")
    inlet = anatomy.inlet
    inside = inlet.position + 0.05 * inlet.direction
    aside = np.cross(inlet.direction, [0.3, 0.5, 0.8])
    line = inside + np.linspace(0.0, 0.05, 5001)[:, None] * aside
    depths = anatomy.lumen(line)
    wanted = (-1.9e-3, -2.1e-3, -3.9e-3, -4.1e-3)
    nodes = np.stack([line[[np.abs(depths - depth).argmin()]] for depth in wanted])

    def escaped(*indentation):
        return physics_errors.escaped(
            anatomy, nodes, inlet.direction, *indentation
        ).tolist()

    assert escaped() == [False, True, True, True]
    assert escaped(3e-3) == [False, False, False, True]


def test_each_simulation_has_the_error_of_its_own(monkeypatch):
    """A warning goes before a force; a device is looked for every 50 control steps."""

    def escaped(anatomy, nodes, along, indentation):
        return nodes[:, 0, 0] > anatomy

    monkeypatch.setattr(physics_errors, "escaped", escaped)
    placement = types.SimpleNamespace(direction=None)
    # The anatomy is a limit here; a case is a key, as an object of its class is.
    scenes = [mock.Mock(anatomy=limit, placement=placement) for limit in (1.0, 3.0)]
    cases = [mock.Mock(scene=scene) for scene in scenes]
    lost, exploded, warned = (
        physics_errors.ESCAPED, physics_errors.EXPLODED, physics_errors.DIVERGED,
    )  # fmt: skip
    rows = [  # case, step, place, warned, force, error
        (1, 50, 2.0, 0, 0.0, None),
        (0, 50, 2.0, 0, 50.0, lost),
        (0, 49, 2.0, 0, 0.0, None),
        (1, 100, 4.0, 0, 0.0, lost),
        (0, 50, 2.0, 0, 50.1, exploded),
        (0, 1, 0.0, 0, np.nan, exploded),
        (0, 50, 2.0, 1, 60.0, warned),
    ]
    number, steps, nodes, warnings, force, expected = zip(*rows, strict=True)
    found = physics_errors.found(
        lambda index: cases[number[index]], np.array(steps),
        np.array(nodes)[:, None, None], np.array(warnings, bool), np.array(force),
    )  # fmt: skip
    assert found == expected


@pytest.mark.parametrize(
    "vessel, indentation",
    [("rigid", None), ({"motion": True}, None), ({"wall": True}, 3e-3)],
)
def test_what_indents_is_told_by_the_wall(monkeypatch, vessel, indentation):
    told, found = [], physics_errors.found

    def keep(*given):
        told.append(given[-1])
        return found(*given)

    monkeypatch.setattr(physics_errors, "found", keep)
    task = suite.make_task("simple1_bca", vessel=vessel)
    simulation = batch.BatchSimulation(task, 1, seeds=3)
    simulation.reset()
    simulation.step(np.zeros((1, simulation.num_actions)))
    assert {*told} == {indentation}


def test_a_device_beside_the_sheath_may_neither_escape_nor_settle(task):
    """Both once counted nodes by rules of their own."""
    scene = task.scene
    line = scene.placement.inlet - 0.02 * scene.placement.direction + [[0, 0, 0]] * 2
    aside = line + [0.05, 0.0, 0.0]
    index = types.SimpleNamespace(links=slice(0, 1), head_site=0, walls=np.zeros(0))
    for nodes, outside in ((line, False), (aside, True)):
        data = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
        data = types.SimpleNamespace(
            xpos=nodes, site_xpos=nodes, contact=data.contact, warning=data.warning
        )
        along = scene.placement.direction
        assert physics_errors.escaped(scene.anatomy, nodes, along) == outside
        expected = pytest.raises(ValueError, match="mm outside the lumen")
        with expected if outside else contextlib.nullcontext():
            start._refuse_outside(scene, index, data)


def test_exploding_force_ends_the_episode_in_both_paths(
    task, load, monkeypatch, caplog
):
    monkeypatch.setattr(physics_errors, "MAX_FORCE", 1e-5)
    environment = load()
    timestep, steps = environment.reset(), 0
    with caplog.at_level(logging.ERROR):
        while not timestep.last():
            timestep, steps = environment.step(_push(environment)), steps + 1
    own = environment.task
    assert (own.termination, own.error) == ("physics_error", physics_errors.EXPLODED)
    assert timestep.reward == 0.0
    assert timestep.discount == 0.0
    (logged,) = caplog.messages
    assert logged.startswith(physics_errors.EXPLODED)
    assert environment.reset().first()
    assert own.error is None
    simulation = batch.BatchSimulation(task, 2, seeds=[3, 3])
    simulation.reset()
    for count in range(1, steps + 1):
        step = simulation.step(np.tile(_push(environment), (2, 1)))
        assert step.physics_error.all() == (count == steps)
    assert step.terminated.all()
    assert not step.truncated.any()
    assert (step.outcome.reward == 0).all()


def test_a_diverging_simulation_is_a_physics_error(task):
    simulation = batch.BatchSimulation(task, 2, num_threads=1, seeds=3)
    simulation.reset()
    simulation.batch.qvel[1] = 1e12
    step = simulation.step(np.zeros((2, simulation.num_actions)))
    assert step.physics_error.tolist() == [False, True]
    assert step.errors == (None, physics_errors.DIVERGED)


# Factor of the springs of all joints: they push away from rest, so nothing is stable.
_WILD = -1e3


def _unstable(task, wild, steps=12):
    """States (T, N, nq) and errors (N,) of three simulations, one of them wild."""
    simulation = batch.BatchSimulation(task, 3, num_threads=1, seeds=3)
    simulation.reset()
    simulation.batch.expand("jnt_stiffness")[wild] *= _WILD
    action = np.tile(np.linspace(-1, 1, simulation.num_actions), (3, 1))
    states, errors = [], [None] * 3
    for _ in range(steps):
        step = simulation.step(action)
        states.append(simulation.batch.qpos.copy())
        errors = [old or new for old, new in zip(errors, step.errors, strict=True)]
    return np.array(states), errors


def test_an_unstable_model_ends_with_a_reason_and_disturbs_nobody(task):
    disturbed, errors = _unstable(task, wild=[1])
    assert errors[1] in (physics_errors.DIVERGED, physics_errors.EXPLODED)
    assert errors[0] is errors[2] is None
    alone, none = _unstable(task, wild=[])
    assert none == [None] * 3
    np.testing.assert_array_equal(disturbed[:, [0, 2]], alone[:, [0, 2]])
    assert (disturbed[0, 1] != alone[0, 1]).any()


# Files of physics errors.


def _failing(task_name, folder, monkeypatch, num_envs=2, **options):
    """An environment whose episodes fail at the first contact, and their errors."""
    from cathsim_dmc.simulation.torchrl import BatchedEnv

    monkeypatch.setattr(physics_errors, "MAX_FORCE", 1e-5)
    env = BatchedEnv(
        task_name, num_envs, num_threads=1, seed=3, task_kwargs={**options}
    )
    env.record_errors(folder)
    simulation = env.simulation
    simulation.reset()
    action = np.zeros((num_envs, simulation.num_actions))
    action[:, 0] = action[:, -1] = 1.0
    for _ in range(200):
        step = simulation.step(action)
        if step.physics_error.all():
            return simulation, step
    raise AssertionError("nothing was touched")


@pytest.mark.slow
def test_an_error_leaves_a_file_that_a_command_plays_again(
    tmp_path, monkeypatch, cathsim, caplog
):
    simulation, step = _failing(
        "simple1_bca",
        tmp_path / "errors",
        monkeypatch,
        # As evaluations pass them on.
        randomisation=VARIED_RANGES,
        vessel=VesselOptions.make("living"),
    )
    paths = sorted((tmp_path / "errors").glob("*.npz"))
    assert len(paths) == 2
    assert all(str(path) in caplog.text for path in paths)
    again = [error_files.PhysicsError.load(path).replay() for path in paths]
    forces = [one.wall_force.peak_max[0] for one in again]
    assert all(one.errors == (physics_errors.EXPLODED,) for one in again)
    assert set(step.wall_force.peak_max) & set(forces)
    code, out, err = cathsim("replay-error", paths[0], "--json")
    assert code == 0, err
    check = json.loads(out)["checks"][0]
    assert check["value"] == check["bound"] == physics_errors.EXPLODED
    monkeypatch.undo()  # where nothing fails
    code, out, err = cathsim("replay-error", paths[0])
    assert code == 1 and "now: no error" in out
    (tmp_path / "other.npz").write_bytes(paths[0].read_bytes()[:-100])
    code, _, err = cathsim("replay-error", tmp_path / "other.npz")
    assert code == 2 and "no file of a physics error" in err


def test_a_file_holds_the_action_and_the_state_of_the_simulation_that_failed(tmp_path):
    task = suite.make_task("simple1_bca")
    simulation = batch.BatchSimulation(task, 3, num_threads=1, seeds=3)
    simulation.error_files = error_files.ErrorFiles(tmp_path, "simple1_bca")
    simulation.reset()
    simulation.batch.qvel[1] = 1e12
    before = simulation.snapshot()[1].arrays
    action = np.linspace(-1.0, 1.0, 3 * simulation.num_actions).reshape(3, -1)
    assert simulation.step(action).physics_error.tolist() == [False, True, False]
    (path,) = tmp_path.glob("*.npz")
    failed = error_files.PhysicsError.load(path)
    np.testing.assert_array_equal(failed.action, action[1])
    for name in ("rollout._errors", "rollout.steps"):
        np.testing.assert_array_equal(failed.snapshot.arrays[name], before[name])
    (_, words, *_) = simulation.random_states[1].get_state()
    drawn = failed.snapshot.arrays["rollout._random_states.words"]
    np.testing.assert_array_equal(drawn, [words])
    assert failed.replay().errors == (physics_errors.DIVERGED,)
    with pytest.raises(ValueError, match="objects as options.*make the task in Pyth"):
        dataclasses.replace(failed, whole=False).replay()


def test_a_folder_keeps_the_last_few_errors_one_of_an_episode(
    tmp_path, monkeypatch, small_disk, caplog
):
    simulation, _ = _failing("simple1_bca", tmp_path, monkeypatch, 1)
    written = list(tmp_path.glob("*.npz"))
    monkeypatch.setattr(physics_errors, "MAX_FORCE", -1.0)  # every step fails
    for _ in range(error_files.KEPT + 1):
        simulation.reset()
        for _ in range(2):  # stepping on adds none
            step = simulation.step(np.zeros((1, simulation.num_actions)))
            assert step.errors == (physics_errors.EXPLODED,)
        (new,) = set(tmp_path.glob("*.npz")) - set(written)
        written.append(new)
    assert set(tmp_path.iterdir()) == set(written[-error_files.KEPT :])
    held = set(tmp_path.iterdir())
    simulation.reset()
    with small_disk(100):
        step = simulation.step(np.zeros((1, simulation.num_actions)))
    assert step.physics_error.all() and "is lost" in caplog.text
    assert set(tmp_path.iterdir()) == held


def test_objects_among_the_options_are_named(tmp_path):
    anatomy = phantoms.load("simple1")
    files = error_files.ErrorFiles(tmp_path, "navigate", {"anatomy": anatomy})
    assert not files._whole
    # No mapping makes a device.
    given = {"device": DEVICES["steerable_4f"], "vessel": VesselOptions(FlowOptions())}
    files = error_files.ErrorFiles(tmp_path, "simple1_bca", given)
    assert not files._whole and "steerable_4f" in files._options["device"]
    assert files._options["vessel"]["flow"]["rate"] == 60.0
    files = error_files.ErrorFiles(tmp_path, "simple1_bca", {"effects": [object()]})
    assert not files._whole and "object" in files._options["effects"][0]
    files = error_files.ErrorFiles(tmp_path, "simple1_bca", {"rotation": True})
    assert files._whole and files._options == {"rotation": True}


def test_objects_of_a_user_are_texts_without_addresses():
    @dataclasses.dataclass
    class Lag(Effect):
        steps: int = 3

    class Wind(Effect):
        pass

    given = {"effects": [Lag()], "max_steps": 3}
    assert json_options.split(given) == (
        {"max_steps": 3},
        {"effects": given["effects"]},
    )
    given["effects"].append(Wind())
    lag, wind = json_options.as_texts(given)["effects"]
    assert lag.endswith("Lag(steps=3)") and wind.endswith("Wind object>")


def test_numbers_of_numpy_are_options():
    given = {"max_steps": np.int64(3), "goal": np.array([1.0, 2.0, 3.0])}
    assert json_options.split(given) == ({"max_steps": 3, "goal": [1.0, 2.0, 3.0]}, {})
    given = {"fluoroscopy": {"size": np.array([32, 48])}, "anatomy": Path("scans/a")}
    read = {"fluoroscopy": {"size": [32, 48]}, "anatomy": str(Path("scans/a"))}
    assert json_options.split(given) == (read, {})
