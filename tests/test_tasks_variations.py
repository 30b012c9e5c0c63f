"""Domain randomisation: what is drawn, and what it does to the model."""

import types
from dataclasses import replace

import numpy as np
import pytest
from conftest import twin
from dm_control.composer.variation import deterministic, distributions
from hypothesis import given
from hypothesis import strategies as st

from cathsim_dmc import compiled_cache, suite
from cathsim_dmc.entities.devices import get
from cathsim_dmc.physics.randomisation import (
    DEFAULT_RANGES,
    ActionDelay,
    Draw,
    Randomisation,
    start_displacement,
)
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks import objectives


@pytest.fixture(scope="module")
def make():
    """Returns a function that makes a randomised environment, all of one scene."""
    task = suite.make_task("simple1_bca")

    def environment(randomisation, seed=0, **changes):
        return suite.environment(
            twin(task, seed, randomisation=randomisation, **changes)
        )

    return environment


def elements(environment):
    """Indices of hinges, tip motors, device and wall geoms, and the base."""
    model = environment.physics.model.ptr

    def named(kind, count, prefix):
        names = [getattr(model, kind)(i).name for i in range(count)]
        return [i for i, name in enumerate(names) if name.startswith(prefix)]

    return {
        "hinges": named("joint", model.njnt, "catheter/bend"),
        "motors": named("actuator", model.nu, "catheter/tip"),
        "device": named("geom", model.ngeom, "catheter/link"),
        "wall": named("geom", model.ngeom, "wall_"),
        "base": model.body("catheter/link_0").id,
    }


def snapshot(environment):
    model = environment.physics.model.ptr
    hinges = ("jnt_stiffness", "dof_damping", "actuator_gainprm")
    fields = ("geom_friction", "body_quat", *hinges)
    return {field: getattr(model, field).copy() for field in fields}


def usual_snapshot(make):
    """Of an episode with nothing drawn: the sheath holds the same hinges."""
    plain = make({"start_radius": 0.0})
    plain.reset()
    return snapshot(plain)


def test_nothing_is_drawn_but_the_displacement_by_default():
    drawn, plain = np.random.RandomState(3), np.random.RandomState(3)
    episode = Randomisation().draw(drawn)
    displacement = start_displacement(plain)
    np.testing.assert_array_equal(episode.displacement, displacement)
    assert {**vars(episode), "displacement": None} == vars(Draw(None))
    assert drawn.randint(2**31) == plain.randint(2**31)


@given(seed=st.integers(0, 2**32 - 1))
def test_draws_lie_in_their_ranges(seed):
    episode = DEFAULT_RANGES.draw(np.random.RandomState(seed))
    assert np.linalg.norm(episode.displacement) <= DEFAULT_RANGES.start_radius
    drawn = ("friction", "stiffness", "loss", "viscosity", "goal_shift", "roll")
    for name in (*drawn, "delay"):
        low, high = getattr(DEFAULT_RANGES, name)
        assert low <= getattr(episode, name) <= high
    low, high = DEFAULT_RANGES.view
    for angle in episode.view:
        assert low <= angle <= high and angle == int(angle)
    for name in ("gain", "kerma"):
        low, high = getattr(DEFAULT_RANGES, name)
        assert low <= getattr(episode, name) <= high


def test_a_composer_variation_is_a_range_too():
    friction = distributions.Normal(loc=0.05, scale=1e-9)
    draws = [
        Randomisation(friction=friction).draw(np.random.RandomState(i)).friction
        for i in range(5)
    ]
    np.testing.assert_allclose(draws, 0.05, atol=1e-7)
    assert len(set(draws)) == 5


@pytest.mark.parametrize("compiled", [False, True])
def test_a_sequence_gives_each_simulation_its_own_value(monkeypatch, compiled):
    """Also in a process that has compiled loops, where loading rehearses an episode."""
    monkeypatch.setattr(compiled_cache, "has_compiled", lambda: compiled)
    factors = np.array([0.8, 1.0, 1.3])
    given = {"stiffness": deterministic.Sequence(factors)}
    task = suite.make_task("simple1_bca", randomisation=given)
    simulation = BatchSimulation(task, len(factors), num_threads=1)
    simulation.reset()
    stiffness = simulation.batch.expand("jnt_stiffness")
    joint = stiffness[0].argmax()
    found = stiffness[:, joint] / stiffness[0, joint] * factors[0]
    np.testing.assert_allclose(found, factors)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"delay": (0, 1.5)}, "control steps"),
        ({"delay": distributions.Uniform()}, "bounds must be known"),
        ({"colour": (0, 1)}, "friction, stiffness"),
    ],
)
def test_impossible_ranges_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Randomisation.make(options)


def test_a_single_device_has_its_own_coating_and_absorption():
    device = replace(get("wire_035_glide"), attenuation=500.0)
    options = {"device": device, "friction": 0.06, "random": 0}
    for drawn, coulomb in ((False, 0.02), ({"friction": (0.3, 0.3)}, 0.1)):
        options |= {"randomisation": drawn, "observation": "image"}
        env = suite.load("cathsim", "simple1_bca", options)
        env.reset()
        at = elements(env)
        friction = env.physics.model.ptr.geom_friction
        for places in (at["device"], at["wall"]):
            np.testing.assert_allclose(friction[places, 0], coulomb)
        (shadow,) = env.task.rollout.shadows
        assert (shadow.mu, shadow.marker_length) == (500.0, device.marker_length)


def test_the_model_takes_what_was_drawn_and_gives_it_back(make):
    drawn = {"friction": (0.1, 0.12), "stiffness": (2.0, 3.0), "roll": (0.5, 1.0)}
    env = make({**drawn, "start_radius": 0.0})
    usual, at = usual_snapshot(make), elements(env)
    env.reset()
    model = env.physics.model.ptr
    ratios = []
    for _ in range(3):
        env.reset()
        assert env.physics.model.ptr is model  # not compiled again
        friction = model.geom_friction[[*at["device"], *at["wall"]], 0]
        assert len(set(friction)) == 1 and 0.1 <= friction[0] <= 0.12
        ratio = model.jnt_stiffness[at["hinges"]] / usual["jnt_stiffness"][at["hinges"]]
        ratios.append(ratio[0])
        np.testing.assert_allclose(ratio, ratio[0])
        dofs = model.jnt_dofadr[at["hinges"]]
        damping = model.dof_damping[dofs] / usual["dof_damping"][dofs]
        gains = model.actuator_gainprm, usual["actuator_gainprm"]
        torque = np.divide(*(gain[at["motors"], 0] for gain in gains))
        np.testing.assert_allclose(damping, ratio[0])
        np.testing.assert_allclose(torque, ratio[0])
        angle = 2 * np.arctan2(
            model.body_quat[at["base"], 3], model.body_quat[at["base"], 0]
        )
        assert 0.5 <= angle <= 1.0
    # Factors act on the model's own values, not on those of the episode before.
    assert len(set(ratios)) == 3 and max(ratios) <= 3.0
    # What is not named stays as it is: the push, the insertion joint, other bodies.
    others = np.setdiff1d(np.arange(model.nu), at["motors"])
    np.testing.assert_array_equal(
        model.actuator_gainprm[others], usual["actuator_gainprm"][others]
    )
    bodies = np.setdiff1d(np.arange(model.nbody), [at["base"]])
    np.testing.assert_array_equal(model.body_quat[bodies], usual["body_quat"][bodies])


def test_the_loss_of_the_material_is_randomised_and_follows_stiffness(make):
    drawn = {"loss": (2.0, 2.0), "stiffness": (3.0, 3.0), "start_radius": 0.0}
    env = make(drawn)
    usual, at = usual_snapshot(make), elements(env)
    env.reset()
    model = env.physics.model.ptr
    dofs, stiffness = model.jnt_dofadr[at["hinges"]], usual["jnt_stiffness"]
    material = env.task.scene.catheter.device.relaxation_time
    expected = usual["dof_damping"][dofs] + material * stiffness[at["hinges"]]
    np.testing.assert_allclose(model.dof_damping[dofs], 3.0 * expected)


@pytest.mark.slow
def test_roll_turns_the_plane_in_which_the_tip_bends(make):
    def bent(roll):
        env = make({"roll": (roll, roll), "start_radius": 0.0})
        env.reset()
        straight = env.task.scene.placement.direction
        action = np.zeros(21)
        action[0:20:2] = 0.4
        for _ in range(10):
            env.step(action)
        sideways = env.task.readings.head - env.task.scene.placement.inlet
        sideways = sideways - (sideways @ straight) * straight
        return sideways / np.linalg.norm(sideways)

    # Gravity sags the tip by far less than the motors bend it.
    assert bent(0.0) @ bent(np.pi / 2) == pytest.approx(0.0, abs=0.1)
    assert bent(0.0) @ bent(np.pi) == pytest.approx(-1.0, abs=0.02)


def test_a_shifted_goal_moves_along_its_branch():
    plain = suite.make_task("simple1_bca").objective
    options = {"random": 0, "randomisation": {"goal_shift": (-0.01, 0.01)}}
    for reward in ({"path": -1.0, "success": 10.0}, objectives.PUBLISHED_REWARD):
        task = suite.make_task("simple1_bca", reward=reward, **options)
        env, wide = suite.environment(task), task.objective
        goals = []
        for _ in range(6):
            env.reset()
            objective = env.task.objective
            (place,) = objective.branch.project(objective.goal).arc_length
            assert objective.ostium <= place
            assert objective.branch.project(objective.goal).distance < 1e-9
            assert objective.in_branch(objective.goal)
            assert objective.path_distance(objective.goal) < 1e-9
            goals.append(float(place))
            np.testing.assert_array_equal([env.task.goal_position], objective.goal)
        usual = float(plain.branch.project(plain.goal).arc_length)
        assert len(set(goals)) == 6 and max(np.abs(np.array(goals) - usual)) <= 0.0101
    # Without a shift the objective is that of the task without randomisation.
    heads = plain.goal + np.random.default_rng(0).normal(size=(20, 3)) * 0.02
    for figure in ("distance", "in_branch"):
        one, other = (getattr(o, figure)(heads) for o in (plain, wide.shifted(0.0)))
        np.testing.assert_allclose(one, other, atol=1e-12)
    assert wide.route.length > plain.route.length


@given(
    delays=st.lists(st.integers(0, 4), min_size=1, max_size=4),
    actions=st.lists(st.floats(-1, 1), min_size=1, max_size=12),
)
def test_actions_arrive_as_late_as_drawn(delays, actions):
    count = len(delays)
    way = ActionDelay(longest=4)
    chain = types.SimpleNamespace(action_names=("push",))
    way.bind(types.SimpleNamespace(chain=chain, num_simulations=count))

    def restart(index, delay):
        way.restart(index, Draw(np.zeros(3), delay=delay), np.random.RandomState())

    for index, delay in enumerate(delays):
        restart(index, delay)
    sent = [np.full((count, 1), a) for a in actions]
    arrived = [way.act(a, None).copy() for a in sent]
    for index, delay in enumerate(delays):
        expected = ([0.0] * delay + actions)[: len(actions)]
        assert [float(a[index, 0]) for a in arrived] == expected
    restart(0, 1)
    assert way.act(np.ones((count, 1)), None)[0, 0] == 0.0


def test_delayed_device_does_later_what_it_does_at_once(make):
    def insertions(delay):
        env = make({"delay": (delay, delay), "start_radius": 0.0})
        env.reset()
        push = np.zeros(21)
        push[-1] = 1.0
        return [float(env.step(push) and env.task.readings.insertion) for _ in range(8)]

    at_once, late = insertions(0), insertions(3)
    assert max(np.abs(np.diff(late[:3]))) < 1e-5 < at_once[1] - at_once[0]
    assert late[-1] - late[2] == pytest.approx(at_once[4] - 1e-3, abs=2e-4)


def test_view_and_gain_change_the_image_and_are_seeded(make):
    def images(seed, **ranges):
        env = make(ranges, seed, observation="image", fluoroscopy={"size": 64})
        return [env.reset().observation["image"].astype(float) for _ in range(3)]

    bright = images(0, gain=(0.9, 1.1))
    corners = [image[0, 0, 0] for image in bright]
    assert len(set(corners)) > 1
    turned = images(0, view=(-20, 20))
    assert np.abs(turned[0] - turned[1]).max() > 20
    for one, other in zip(turned, images(0, view=(-20, 20)), strict=True):
        np.testing.assert_array_equal(one, other)
