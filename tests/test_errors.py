"""Bad input: each error says what was given and lists what is allowed."""

import copy
import dataclasses
import os
import pickle
import signal

import numpy as np
import pytest
from conftest import OBSERVATIONS, TASKS
from dm_control.composer.variation import distributions
from recording_samples import make_episode

from cathsim_dmc import suite
from cathsim_dmc.agents import evaluate, record_demonstrations
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.export import wall_pieces
from cathsim_dmc.anatomy.parts import Goal
from cathsim_dmc.entities import devices
from cathsim_dmc.physics.randomisation import Randomisation
from cathsim_dmc.pictures.animation import animate
from cathsim_dmc.play import play
from cathsim_dmc.recording.rerun_log import write_rrd
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.simulation.mjcf import write_mjcf
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.validation.force_sensors import compare_forces

STIFF = dataclasses.replace(
    devices.get("steerable_5f"), name="stiff", shaft=devices.Section(6e-3, 5e-3)
)
OPTIONS = [field.name for field in dataclasses.fields(NavigationConfig)]
TYPE1 = {"task_name": "navigate", "anatomy": "type1"}
BESIDE = Goal("beside", "bca", [0.1, 0.0, 0.0], 0.01)
BESIDE_WORDS = ["beside", "outside the lumen", "mm", "point inside", "bca", "lcca"]
ELSEWHERE = ["directory", "cathsim phantom", *arch.ARCHES]


def test_wrong_domain_name():
    with pytest.raises(ValueError) as caught:
        suite.load("cathsin", "type1_bca")
    for word in ("cathsin", "cathsim", "cartpole", "walker"):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"task_name": "type3_bcb"}, ["type3_bcb", "`cathsim list`", *TASKS]),
        ({"observation": "pixels"}, ["pixels", *OBSERVATIONS]),
        ({"frictoin": 0.1}, ["frictoin", *OPTIONS]),
        ({**TYPE1, "goal": "carotid"}, ["carotid", *phantoms.load("simple1").goals]),
        ({**TYPE1, "goal": BESIDE}, BESIDE_WORDS),
        ({**TYPE1, "anatomy": "type9"}, ["type9", *ELSEWHERE]),
        ({**TYPE1, "anatomy": "no/such"}, ["no/such", *ELSEWHERE]),
        ({"max_steps": 10**400}, ["max_steps", "an integer from 1"]),
        ({"physics_timestep": 0.003}, ["physics_timestep", "divided by a whole"]),
        ({"physics_timestep": 0.02}, ["physics_timestep", "0.005", "outside_range"]),
        ({"device": STIFF}, ["'stiff'", "0.005 N·m²", "outside_range"]),
        ({"friction": -0.1}, ["friction", "-0.1", "from 0 to 2"]),
        ({"working_length": 0.05}, ["working_length", "0.05", "steerable_5f", "more"]),
        ({"fluoroscopy": {"zoom": 2}}, ["fluoroscopy", "zoom", "magnification"]),
        ({"randomisation": {"gravity": 1}}, ["gravity", "friction"]),
        ({"randomisation": 1}, ["randomisation", "1", "True", "friction"]),
        (
            {"randomisation": {"view": (0, 80)}, "fluoroscopy": {"view": (0, 20)}},
            ["randomisation", "view", "80", "fluoroscopy"],
        ),
        ({"fluoroscopy": {"size": (128, 0)}}, ["size", "(128, 0)", "columns"]),
        ({"fluoroscopy": {"biplane": "TOP"}}, ["biplane", "TOP", "LATERAL"]),
    ],
)
def test_wrong_values(options, words):
    options = {"task_name": "type1_bca", **options}
    with pytest.raises(ValueError) as caught:
        suite.load("cathsim", options.pop("task_name"), task_kwargs=options)
    missing = [word for word in words if str(word) not in str(caught.value)]
    assert not missing, f"{missing} not in: {caught.value}"


# Actions.

LAYOUT = ["21", "[-1, 1]", "tip motors", "translation"]


@pytest.fixture
def environment(shared_environment):
    environment = shared_environment("type1_bca")
    environment.reset()
    return environment


@pytest.mark.parametrize("shape", [(20,), (22,), (), (21, 1)])
def test_action_of_wrong_shape(environment, shape):
    with pytest.raises(ValueError) as caught:
        environment.step(np.zeros(shape))
    for word in (str(shape), *LAYOUT):
        assert word in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_action_that_is_not_finite(environment, value):
    action = np.zeros(21)
    action[[3, 20]] = value
    before = environment.physics.data.qpos.copy()
    with pytest.raises(ValueError, match=r"finite numbers.*\[-1, 1\]"):
        environment.step(action)
    np.testing.assert_array_equal(environment.physics.data.qpos, before)


def composer_face(environment):
    def reset():
        environment.task.random.set_state(np.random.RandomState(3).get_state())
        environment.reset()

    return reset, lambda action: environment.step(action).reward


def batch_face(environment):
    batch = BatchSimulation(environment.task, 1, num_threads=1)

    def reset():
        batch.seed(3)
        batch.reset()

    return reset, lambda action: batch.step(action[None]).outcome.reward[0]


@pytest.mark.parametrize("face", [composer_face, batch_face])
def test_actions_out_of_range_are_clipped_in_both_paths(environment, face):
    """As the drives would: three times the range is the range, bit for bit."""
    reset, step = face(environment)
    action = np.where(np.arange(21) % 2, 1.0, -1.0)
    action[20] = 1.0
    rewards = []
    for scale in (1.0, 3.0, 0.5):
        reset()
        rewards.append([step(scale * action) for _ in range(3)])
    assert rewards[0] == rewards[1]
    assert rewards[0] != rewards[2]


@pytest.fixture(scope="module")
def three(shared_environment):
    return BatchSimulation(shared_environment("type1_bca").task, 3, num_threads=1)


def test_a_step_before_the_reset_is_refused(three):
    action = np.zeros((3, 21))
    with pytest.raises(RuntimeError, match=r"\[0, 1, 2\] have no episode.*reset\(\)"):
        three.step(action)
    three.reset(np.array([2, 0]))
    with pytest.raises(RuntimeError, match=r"\[1\] have no episode"):
        three.step(action)
    three.reset([1])
    three.step(action)


@pytest.mark.parametrize(
    "indices",
    [-1, 1, 0.5, "1", {0}, [], [-1], [3], [0.0], [None], [[0, 1]], [True, False, True]]
    + [
        np.array(1),
        np.array([0], "m8[s]"),
        np.eye(3, dtype=int),
        np.array([True, False, True]),
    ],
)
def test_indices_that_are_none_are_refused(three, indices):
    with pytest.raises(ValueError, match=r"indices is .*from 0 to 2.*flatnonzero"):
        three.reset(indices)


@pytest.mark.parametrize(
    "seeds",
    [[None] * 3, [True] * 3, None, True, 0.5, "123", -1, 2**32 - 2, [0, 1, -1]]
    + [[0, 1, [2**32]], [[], 1, 2], {0, 1, 2}, [[0, [1]], 1, 2], np.zeros(3)],
)
def test_seeds_that_are_none_are_refused(three, seeds):
    with pytest.raises(ValueError, match=r"seeds is .*must be"):
        three.seed(seeds)
    last = 2**32 - 1
    for good in (0, np.int64(last - 2), range(3), np.arange(3), [1, 0, last]):
        three.seed(good)


NO_MAPPINGS = [0, 1, False, "", "random", [], ["random"], [("random", 0)], {1: 0}]


@pytest.mark.parametrize("value", NO_MAPPINGS)
def test_options_that_are_no_mapping_are_refused(value):
    for name in ("task_kwargs", "environment_kwargs"):
        with pytest.raises(ValueError, match=f"{name} is .*None, or a mapping"):
            suite.load("cathsim", "type1_bca", **{name: value})


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_a_fork_of_a_batch_is_refused_and_ends(three):
    """A fork that waits for the threads of the batch never ends."""
    three.reset()
    three.step(np.zeros((3, 21)))
    child = os.fork()
    if not child:
        signal.alarm(20)  # ends the fork, not the test, where it waits
        status = 1
        try:
            three.step(np.zeros((3, 21)))
        except RuntimeError as error:
            status = 0 if "spawn" in str(error) else 2
        finally:
            os._exit(status)
    assert os.waitpid(child, 0)[1] == 0


def test_a_distribution_of_ones_own_is_held_to_the_bounds_when_it_is_drawn():
    ranges = Randomisation(friction=distributions.Uniform(3.0, 4.0))
    with pytest.raises(ValueError, match="friction, as drawn, is 3.*from 0 to 2"):
        ranges.draw(np.random.RandomState(0))


def test_what_lies_outside_the_range_is_taken_with_a_warning():
    with pytest.warns(UserWarning, match=r"0.02 s, but the physics holds up to 0.005"):
        NavigationConfig(physics_timestep=0.02, outside_range=True)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda e, p: animate(3, None, p), "episode is 3; it must be an Episode"),
        (lambda e, p: animate(e, None, p, frames=0), "frames is 0.*from 1"),
        (lambda e, p: animate(e, None, p, width=True), "width is True"),
        (lambda e, p: animate(e, None, p, quality=1e9), "quality is 1000000000.0"),
        (lambda e, p: write_rrd("x", None, p), "episode is 'x'"),
        (lambda e, p: write_rrd(e, (1, 2), p), "surface is"),
        (lambda e, p: animate(e, (1, 2), p), "surface is"),
        (lambda e, p: write_rrd(e, None, p, fluoroscopy=[1]), "fluoroscopy is int64"),
        (lambda e, p: compare_forces(e.task), "episode is 'type1_bca'"),
        (lambda e, p: wall_pieces("type1"), "anatomy is 'type1'"),
        (lambda e, p: suite.register("own", None), "definition is None"),
        (lambda e, p: suite.register(7, suite.TASKS["type1_bca"]), "name is 7"),
        (lambda e, p: write_mjcf("type1_bca", p, task_kwargs=[1]), "task_kwargs is "),
        (lambda e, p: play("type1_bca", task_kwargs="x"), "task_kwargs is 'x'"),
        (lambda e, p: record_demonstrations("type1_bca", p, task_kwargs=1), "task_kw"),
        (lambda e, p: evaluate("push", "type1_bca", task_kwargs=[[1]]), "task_kwargs"),
    ],
)
def test_arguments_of_another_kind_are_named_before_any_work(call, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        call(make_episode(), tmp_path / "new.gif")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("way", [pickle.dumps, copy.copy, copy.deepcopy])
def test_what_simulates_is_neither_pickled_nor_copied(environment, three, way):
    for one in (environment, environment.task, three):
        with pytest.raises(
            TypeError, match=f"{type(one).__name__} cannot be .*restore"
        ):
            way(one)
    assert len(pickle.loads(pickle.dumps(environment.snapshot()))) == 1


def test_a_spec_has_bounds_for_each_action(environment):
    """As those of dm_control: `uniform(spec.minimum, spec.maximum)` is an action."""
    spec = environment.action_spec()
    action = np.random.default_rng(0).uniform(spec.minimum, spec.maximum)
    assert action.shape == spec.shape
    environment.step(action)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("outer_radius", 0.889 / 2, "outer_radius of device 'own'.*at most 0.01 m"),
        ("linear_density", 4.0, "linear_density of device 'own'.*1e-3 kg/m"),
        ("tip_length", 2.0, "tip_length of device 'own' is 2.0.*at most 1 m"),
    ],
)
def test_a_device_in_other_units_is_refused(field, value, words):
    wire = devices.get("wire_035_glide")
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(wire, name="own", **{field: value})


def test_an_arc_in_degrees_is_refused():
    with pytest.raises(ValueError, match="angle is 45.*12.5664 rad"):
        devices.Arc(3e-3, 45.0)
