"""The meaning of a task: success, reward, start and actions, as functions of arrays."""

import copy
import dataclasses
import json
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import stats

from cathsim_dmc import suite
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.physics import forces, readings
from cathsim_dmc.physics.randomisation import start_displacement
from cathsim_dmc.tasks import judging, objectives
from cathsim_dmc.tasks.objectives import PUBLISHED_REWARD, Cannulation

PATH_REWARD = {"path": -1.0, "success": 10.0}


@pytest.fixture(scope="module")
def anatomy():
    return phantoms.load("simple1")


def pickled(value):
    return pickle.loads(pickle.dumps(value))


def cannulation(anatomy, goal="bca", **options):
    return Cannulation.to(anatomy, anatomy.goal(goal), **options)


@pytest.fixture(scope="module", params=[PUBLISHED_REWARD, PATH_REWARD])
def task(request, anatomy):
    return cannulation(anatomy, reward=request.param)


def measurement(task, head, **changes):
    """What a task judges with the heads (..., 3): no force, no motion."""
    head = np.asarray(head)
    shape = head.shape[:-1]
    nothing = np.zeros(shape)
    fields = dict.fromkeys(readings.Readings._fields)
    fields |= {"head": head, "insertion": nothing}
    force = forces.WallForce(
        *(changes.pop(n, nothing) for n in forces.WallForce._fields)
    )
    still = np.zeros((*shape, 21))
    return objectives.Measurement(
        readings.Readings(**fields),
        force,
        changes.pop("action", still),
        changes.pop("previous_action", still),
        task.distance(head),
    )


def judge(task, head, **changes):
    return task.outcome(measurement(task, head, **changes))


def towards(task, way):
    """A point on the centreline of the branch, `way` m before the goal."""
    place = task.branch.project(task.goal).arc_length
    return task.branch.at(place - way).position


def test_success_through_a_wall_does_not_count(task):
    """Within 8 mm of the goal, and outside the lumen of the branch."""
    place = task.branch.project(task.goal)
    tangent = task.branch.at(place.arc_length).tangent
    side = np.cross(tangent, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    for gap, inside in ((-0.5e-3, True), (0.5e-3, False)):
        head = task.goal + (place.radius + gap) * side
        outcome = judge(task, head)
        assert task.distance(head) < objectives.GOAL_RADIUS
        assert task.in_branch(head) == outcome.success == inside
        assert (outcome.reward == 10.0) == inside


def test_the_stump_in_the_parent_is_not_the_branch(task):
    """A branch's centreline starts on its parent's; the branch starts at the ostium."""
    around = task.branch.at(task.ostium + np.array([-1e-3, 1e-3])).position
    assert task.in_branch(around).tolist() == [False, True]


def test_reward_is_minus_the_distance_in_metres(anatomy):
    task = cannulation(anatomy, "lcca")
    head = anatomy.inlet.position + [0, 0, 0.07]
    expected = -np.linalg.norm(head - task.goal)
    assert judge(task, head).reward == pytest.approx(expected, rel=1e-12)
    assert judge(task, head).terms.keys() == {"distance", "success"}


def test_path_reward_counts_the_way_that_is_left(anatomy):
    """To a seventh: ways cut corners, and follow the directions of a lattice."""
    task = cannulation(anatomy, "lcca", reward=PATH_REWARD)
    for way in (0.02, 0.06, 0.12):
        head = task.route.at(task.route.length - way).position
        assert judge(task, head).reward == pytest.approx(-way, rel=0.15)
    # Straight through the wall it is nearer than along the vessel.
    start = task.route.at(0.0).position
    assert task.lumen_distance(start) > np.linalg.norm(start - task.goal)


def test_the_path_through_the_lumen_needs_its_term(anatomy):
    with pytest.raises(ValueError, match="path"):
        cannulation(anatomy).lumen_distance(np.zeros(3))


@pytest.fixture(scope="module", params=["type1", "type2"])
def measured(request):
    """A measured phantom and its objective of reaching the LCCA by the path reward."""
    anatomy = suite.load_anatomy(request.param)
    return anatomy, cannulation(anatomy, "lcca", reward=PATH_REWARD)


def test_path_falls_along_the_route(measured):
    _, task = measured
    places = np.linspace(0, task.route.length, 200)
    heads = task.route.at(places).position
    ways = task.lumen_distance(heads)
    assert np.diff(ways).max() < 0.3e-3
    assert (ways >= task.distance(heads)).all()
    assert ways[-1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("wrong", ["bca", "lsa"])
def test_path_rises_into_every_wrong_branch(measured, wrong):
    anatomy, task = measured
    vessel = anatomy.tree.vessel(wrong)
    end = vessel.centreline.length
    # Its mouth is wide: the first millimetres may lead towards the goal.
    first = vessel.ostium + 10e-3
    inside = vessel.centreline.at(np.linspace(first, end, 50)).position
    ways = task.lumen_distance(inside)
    assert (np.diff(ways) > 0).all()
    assert ways[-1] - ways[0] == pytest.approx(end - first, rel=0.1)
    mouth = vessel.centreline.at(vessel.ostium).position
    assert task.lumen_distance(mouth) - ways[0] < 0


def test_a_shifted_goal_shifts_the_path(anatomy):
    task = cannulation(anatomy, "lcca", reward=PATH_REWARD, farthest_shift=5e-3)
    start = task.route.at(0.05).position
    before = task.lumen_distance(start)
    for shift in (-5e-3, 5e-3):
        moved = task.shifted(np.array(shift))
        assert moved.lumen_distance(start) - before == pytest.approx(shift, abs=2e-3)
        assert moved.lumen_distance(moved.goal) == pytest.approx(0.0, abs=1e-9)


def test_a_head_beside_the_route_has_the_way_to_it_before_itself(anatomy):
    task = cannulation(anatomy, "lcca")
    place = task.route.at(0.05)
    side = np.cross(place.tangent, [0.0, 1.0, 0.0])
    head = place.position + 1e-3 * side / np.linalg.norm(side)
    left = task.route.length - 0.05
    assert task.path_distance(head) == pytest.approx(left + 1e-3, abs=1e-5)


@given(
    heads=arrays.arrays(
        float, (4, 2, 3), elements=st.floats(-0.05, 0.25, allow_subnormal=False)
    )
)
def test_a_batch_is_many_single_ones(task, heads):
    """Up to rounding: sums may be added in another order in a batch."""
    together = judge(task, heads)
    assert together.reward.shape == together.success.shape == (4, 2)
    for index in np.ndindex(4, 2):
        alone = judge(task, heads[index])
        assert alone.success == together.success[index]
        np.testing.assert_allclose(alone.reward, together.reward[index], atol=1e-9)
        for name, term in together.terms.items():
            np.testing.assert_allclose(alone.terms[name], term[index], atol=1e-9)


@given(
    heads=arrays.arrays(
        float, (16, 3), elements=st.floats(-0.3, 0.3, allow_subnormal=False)
    )
)
def test_success_is_near_and_inside(task, anatomy, heads):
    outcome = judge(task, heads)
    assert (task.distance(heads)[outcome.success] < task.goal_radius).all()
    assert (anatomy.lumen(heads[outcome.success]) >= 0).all()
    assert (outcome.reward[~outcome.success] < 0).all()


# Terms.


def test_the_reward_is_the_sum_of_its_terms(anatomy):
    random = np.random.default_rng(0)
    names = (*Cannulation.TERMS, "success")
    weights = dict(zip(names, random.uniform(-2, 2, len(names)), strict=True))
    task = cannulation(anatomy, reward=weights)
    heads = task.goal + random.normal(scale=8e-3, size=(50, 3))
    outcome = judge(
        task,
        heads,
        mean_sum=random.uniform(size=50),
        mean_max=random.uniform(size=50),
        peak_max=random.uniform(size=50),
        action=random.uniform(-1, 1, (50, 21)),
    )
    assert 0 < outcome.success.sum() < 50
    assert set(outcome.terms) == set(names)
    np.testing.assert_allclose(sum(outcome.terms.values()), outcome.reward, rtol=1e-12)
    for name in ("distance", "path"):
        assert (outcome.terms[name][outcome.success] == 0).all()
        assert (outcome.terms[name][~outcome.success] != 0).all()


def test_terms_are_what_their_names_say(anatomy):
    weights = {"force": -2.0, "contact_force": -1.0, "excess_force": -1.0}
    weights |= {"peak_force": -3.0, "time": -0.5, "smoothness": -1.0}
    task = cannulation(anatomy, reward=weights)
    outcome = judge(
        task,
        np.zeros((1, 3)),
        mean_sum=np.array([0.3]),
        mean_max=np.array([0.2]),
        peak_sum=np.array([0.9]),
        peak_max=np.array([0.7]),
        action=np.full((1, 21), 0.5),
        previous_action=np.full((1, 21), -0.5),
    )
    terms = {name: float(value[0]) for name, value in outcome.terms.items()}
    expected = {"force": -0.6, "contact_force": -0.2, "excess_force": -0.2}
    expected |= {"peak_force": -2.1, "time": -0.5, "smoothness": -1.0}
    assert terms == pytest.approx(expected)


def test_a_shifted_goal_stays_in_its_branch_and_may_be_passed(anatomy):
    task = cannulation(anatomy, "lcca", farthest_shift=8e-3)
    moved = task.shifted(np.array([-1.0, 0.0, 1.0]))
    places = task.branch.project(moved.goal).arc_length
    middle = task.branch.project(task.goal).arc_length
    np.testing.assert_allclose(places, [task.ostium, middle, task.branch.length])
    beside = dataclasses.replace(task, goal=task.goal + [0.0, 1e-3, 0.0])
    np.testing.assert_allclose(beside.shifted(np.array(0.0)).goal, beside.goal)
    for past in (-5e-3, 5e-3):
        head = task.route.at(task.goal_arc_length + past).position
        assert task.path_distance(head) == pytest.approx(5e-3)


def test_the_path_ratio_is_the_way_of_the_head_over_that_to_the_goal(
    shared_environment,
):
    """In every episode anew."""
    environment = shared_environment("simple1_bca")
    task, push = environment.task, np.zeros(21)
    push[-1] = 1.0
    for _ in range(2):
        environment.reset()
        heads = [task.readings.head]
        for _ in range(10):
            environment.step(push)
            heads.append(task.readings.head)
        way = np.linalg.norm(np.diff(heads, axis=0), axis=-1).sum()
        shortest = task.objective.path_distance(heads[0])
        assert task.info()["path_ratio"] == pytest.approx(way / shortest)


# Start.


def test_start_is_uniform_in_a_ball_of_a_millimetre():
    random = np.random.RandomState(0)
    points = np.array([start_displacement(random) for _ in range(2000)])
    radius = np.linalg.norm(points, axis=-1) / 1e-3
    assert radius.max() <= 1
    # Uniform in the ball: r³ and each z/r are uniform.
    assert stats.kstest(radius**3, "uniform").pvalue > 1e-3
    for axis in range(3):
        cosine = points[:, axis] / (radius * 1e-3)
        assert stats.kstest(cosine, stats.uniform(-1, 2).cdf).pvalue > 1e-3


# Actions and options.


@pytest.mark.parametrize("value", ["sparse", {}, {"sparse": 1.0}])
def test_an_unknown_reward_lists_the_terms(task, value):
    with pytest.raises(ValueError, match="reward is.*some of distance, path"):
        dataclasses.replace(task, weights=value)


def test_a_success_rule_of_ones_own_sees_the_forces(anatomy):
    @dataclasses.dataclass(frozen=True)
    class Gentle(Cannulation):
        def success(self, measurement):
            gentle = measurement.wall_force.mean_max < 0.1
            return super().success(measurement) & gentle

    task = Gentle.to(anatomy, anatomy.goal("bca"))
    heads = np.stack([task.goal, task.goal, towards(task, 0.03)])
    outcome = judge(task, heads, mean_max=np.array([0.05, 0.2, 0.05]))
    assert outcome.success.tolist() == [True, False, False]
    assert outcome.reward[0] == 10.0 and (outcome.reward[1:] <= 0.0).all()


@pytest.mark.parametrize("way", [copy.copy, copy.deepcopy, pickled])
def test_an_objective_is_copied_and_pickled(anatomy, way):
    objective = cannulation(anatomy, reward=PATH_REWARD)
    other = way(objective)
    assert other.weights == objective.weights
    with pytest.raises(TypeError):
        other.weights["force"] = 1.0
    head = objective.route.points[::40]
    np.testing.assert_array_equal(
        other.lumen_distance(head), objective.lumen_distance(head)
    )


@pytest.mark.parametrize("way", [copy.copy, copy.deepcopy, pickled])
def test_the_published_reward_reaches_other_processes_and_files(way):
    """As an option of a task, `reward=PUBLISHED_REWARD`."""
    other = way(PUBLISHED_REWARD)
    assert other == json.loads(json.dumps(PUBLISHED_REWARD)) == dict(PUBLISHED_REWARD)
    for change in (other.clear, other.popitem, lambda: other.update(force=1.0)):
        with pytest.raises(TypeError, match="cannot be changed"):
            change()
    with pytest.raises(TypeError, match="cannot be changed"):
        other |= {"force": 1.0}


def test_a_simulation_that_has_diverged_does_not_keep_others_from_beginning():
    class Far:
        def path_distance(self, head):
            return np.linalg.norm(head, axis=-1)

    head = np.array([[3.0, 4.0, 0.0], [np.nan, 0.0, 0.0]])
    groups = [(Far(), slice(None))]
    assert judging.path_distances(groups, head, np.array([0]))[0] == 5.0
    with pytest.raises(ValueError, match="finite"):
        judging.path_distances(groups, head, np.array([1]))


@pytest.mark.parametrize("given", [False, [False] * 3, np.zeros(3), np.zeros(2, bool)])
def test_a_failure_is_a_truth_value_of_each_simulation(anatomy, given):
    class Limited(Cannulation):
        def failure(self, measurement):
            return given

    task = Limited.to(anatomy, anatomy.goal("bca"))
    measured = measurement(task, np.tile(task.goal, (3, 1)), mean_sum=np.zeros(3))
    with pytest.raises(ValueError, match="Limited returns .*failed"):
        judging.judge([(task, slice(None))], measured)


def test_an_episode_ends_by_its_objective_or_its_physics(anatomy):
    class Limited(Cannulation):
        def failure(self, measurement):
            return measurement.wall_force.mean_sum > 1.0

    task = Limited.to(anatomy, anatomy.goal("bca"))
    given = measurement(
        task, np.tile(task.goal, (3, 1)), mean_sum=np.array([2.0, 0, 0])
    )
    diverged = np.array([False, True, False])
    judged = judging.judge([(task, slice(None))], given, diverged)
    assert judged.failed.tolist() == [True, True, False]
    assert judged.success.tolist() == [False, False, True]
    assert judged.reward[1:].tolist() == [0.0, 10.0]
    assert judged.terms["success"].tolist() == [0.0, 0.0, 10.0]
