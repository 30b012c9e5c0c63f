"""An objective of one's own means the same in composer and in the batch."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from conftest import twin

import cathsim_dmc
from cathsim_dmc import suite
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.config import NavigationConfig
from cathsim_dmc.tasks.navigation import Navigation
from cathsim_dmc.tasks.objectives import Cannulation, Outcome
from cathsim_dmc.tasks.scene import Scene

EXAMPLE = Path(__file__).parents[1] / "examples" / "own_objective.py"
SEEDS = (4, 5)
STEPS = 40


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("own_objective", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def scene():
    return suite.make_task("simple1_lcca").scene


class Advance:
    """No relative of `Cannulation`: pays for insertion, done at 20 mm of it."""

    goal_radius = 1e-3
    terms = ("advance", "load")

    def __init__(self, goal):
        self.goal = goal

    def outcome(self, measurement):
        insertion = measurement.readings.insertion
        terms = {"advance": insertion, "load": -measurement.wall_force.peak_sum}
        return Outcome(sum(terms.values()), insertion > 0.02, terms)

    def path_distance(self, head):
        return np.linalg.norm(head - self.goal, axis=-1)


def advancing(**options):
    anatomy = suite.load_anatomy("simple1")
    config = NavigationConfig(**options)
    scene = Scene.build(anatomy, "lcca", config)
    return Navigation(scene, Advance(scene.goal.position), config)


def gentle(example, **options):
    return suite.make_task(example.TASK, **options)


def pushing(seed):
    """Steering and pushing on, which meets the wall."""
    random = np.random.default_rng(seed)
    rows = random.uniform(-1, 1, (STEPS, len(SEEDS), 21))
    rows[..., 20] = 1.0
    return rows


def assert_equal_rewards(task):
    """Steps composer environments and a batch alike; returns all rewards."""
    batch = BatchSimulation(task, len(SEEDS), seeds=SEEDS, num_threads=1)
    batch.reset()
    environments = [suite.environment(twin(task, seed)) for seed in SEEDS]
    for environment in environments:
        environment.reset()
    rewards = []
    running = [True] * len(SEEDS)
    for action in pushing(0):
        step = batch.step(action)
        for i, environment in enumerate(environments):
            if not running[i]:
                continue
            timestep = environment.step(action[i])
            assert timestep.reward == step.outcome.reward[i]
            assert timestep.last() == (step.terminated[i] or step.truncated[i])
            info = {name: value[i].item() for name, value in step.info().items()}
            assert environment.task.info() == info
            running[i] = not timestep.last()
            rewards.append(timestep.reward)
    return rewards, step


def test_the_subclass_of_the_example(example):
    rewards, step = assert_equal_rewards(gentle(example))
    assert {"distance", "success", "hard_contact"} == set(step.outcome.terms)
    plain = suite.make_task("type1_lcca").objective
    assert isinstance(plain, Cannulation)
    assert "hard_contact" not in plain.weights


def test_the_option_of_the_example_reaches_the_reward(example):
    heavy = gentle(example, tolerance_weight=5.0).objective
    assert heavy.weights["hard_contact"] == -5.0
    with pytest.raises(ValueError, match="tolerance_weight"):
        gentle(example, weight=5.0)


def test_an_objective_without_relatives():
    rewards, step = assert_equal_rewards(advancing())
    assert max(rewards) > 0.02
    assert step.outcome.success.all()


@dataclasses.dataclass(frozen=True)
class Limited(Cannulation):
    """Fails above a load on the wall."""

    limit: float = 0.01  # N

    def failure(self, measurement):
        return measurement.wall_force.mean_sum > self.limit

    TERMS = {**Cannulation.TERMS, "failure": failure}


def limited(**options):
    task = suite.make_task("type1_bca", **options)
    reward = {"distance": -1.0, "success": 10.0, "failure": -5.0}
    anatomy, goal = task.scene.anatomy, task.scene.goal
    return Navigation(task.scene, Limited.to(anatomy, goal, reward=reward), task.config)


def test_an_objective_ends_an_episode_as_failed_in_both_paths():
    rewards, step = assert_equal_rewards(limited())
    over = step.wall_force.mean_sum > Limited.limit
    assert over.any() and min(rewards) < -5
    assert (step.outcome.failed == over).all() and not step.outcome.success.any()
    assert (step.info()["failed"] == over).all()
    environment = suite.environment(limited())
    episode = cathsim_dmc.record(environment, "push", seed=0, max_steps=30)
    assert episode.termination == "failed" and not episode.success
    assert episode.meta["discount"] == 0.0
    loads = np.array(episode.meta["wall_force_mean_sum"])
    assert loads[-1] > Limited.limit and (loads[:-1] <= Limited.limit).all()


def test_a_failure_outweighs_the_success_of_a_cannulation():
    objective = dataclasses.replace(limited().objective, limit=-1.0, goal_radius=0.5)
    task = limited()
    batch = BatchSimulation(Navigation(task.scene, objective, task.config), 1)
    batch.reset()
    step = batch.step(pushing(0)[0][:1])
    assert step.terminated.all() and not step.outcome.success.any()
    assert "success" in step.outcome.terms and step.outcome.terms["success"] == 0
    # Failures of the objective are not those of the physics.
    for error, failed in (None, True), ("diverged", False):
        assert step._replace(errors=(error,)).failed.tolist() == [failed]


def test_what_the_batch_cannot_honour_is_refused():
    class Shaped(Navigation):
        def get_reward(self, physics):
            return 2.0 * super().get_reward(physics)

    task = suite.make_task("simple1_bca")
    shaped = Shaped(task.scene, task.objective, task.config)
    with pytest.raises(ValueError, match=r"Shaped overrides get_reward.*Objective"):
        BatchSimulation(shaped, 2, num_threads=1)


def test_what_an_objective_can_is_declared_not_found():
    class Lookalike(Advance):
        route = Scene
        shifted = Advance.path_distance

    anatomy = suite.load_anatomy("simple1")
    for config in (NavigationConfig(randomisation=True), NavigationConfig("route")):
        scene = Scene.build(anatomy, "lcca", config)
        with pytest.raises(ValueError, match=r"Lookalike has no.*derive it from"):
            suite.environment(Navigation(scene, Lookalike(np.zeros(3)), config))


def test_a_goal_that_cannot_be_shifted_is_refused():
    with pytest.raises(ValueError, match=r"goal.*Advance.*shifted"):
        advancing(randomisation=True)


NUMBERS = np.zeros(2)
GOOD = Outcome(NUMBERS, NUMBERS > 0, {"near": NUMBERS})


@pytest.fixture(scope="module")
def judged():
    """A batch of two, and a function that takes what its objective answers."""
    task = advancing()
    batch = BatchSimulation(task, 2, num_threads=1)

    task.objective.terms = ("near",)

    def answer(outcome):
        task.objective.outcome = lambda measurement: outcome
        batch.reset()

    return batch, answer


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"reward": np.array([0.0, np.nan])}, r"reward .*nan.*finite"),
        ({"terms": {"near": np.array([0.0, np.inf])}}, r"near .*inf.*finite"),
        ({"reward": np.ma.masked_array(NUMBERS, [1, 0])}, "reward masked_array"),
        ({"success": np.ma.masked_array(NUMBERS > 0, [1, 0])}, "success masked_array"),
        ({"reward": np.zeros(7)}, r"reward of shape \(7,\).*\(2,\)"),
        ({"terms": {"near": np.zeros((2, 1))}}, r"near of shape \(2, 1\).*\(2,\)"),
        ({"success": np.bool_(True)}, "success"),
        ({"failed": True}, "failed True"),
        ({"failed": NUMBERS}, "failed array"),
        ({"success": NUMBERS}, "success"),
        ({"reward": None}, "reward None"),
        ({"reward": [0.0, 0.0]}, "reward"),
        ({"reward": np.array(["a", "b"])}, "reward"),
        ({"reward": NUMBERS.astype(object)}, "reward"),
        ({"terms": None}, "terms=None"),
        ({"terms": {"near": 0.0}}, "near 0.0"),
        ({"terms": {"near": 0.5}, "reward": 0.5}, "near 0.5"),  # their sum is no array
        ({"terms": {}}, r"the terms \[\], not \['near'\]"),
        ({"terms": {"far": NUMBERS}}, r"the terms \['far'\], not \['near'\]"),
    ],
)
def test_an_outcome_that_is_none_is_refused_by_the_name_of_its_objective(
    judged, changes, words
):
    batch, answer = judged
    answer(GOOD)
    assert not batch.step(pushing(0)[0]).terminated.any()
    with pytest.raises(ValueError, match=rf"Advance returns .*{words}.*Outcome\("):
        answer(GOOD._replace(**changes))
    for other in (None, "x", tuple(GOOD)):
        with pytest.raises(ValueError, match=r"Advance returns .*Outcome\("):
            answer(other)


@pytest.mark.parametrize(
    "name", ["goal", "goal_radius", "terms", "outcome", "path_distance"]
)
def test_an_objective_that_lacks_something_is_told_what(scene, name):
    parts = {n: v for n, v in vars(Advance).items() if n != name and n[0] != "_"}
    parts |= {} if name == "goal" else {"goal": scene.goal.position}
    with pytest.raises(ValueError, match=rf"Partial lacks {name}; .*path_distance"):
        Navigation(scene, type("Partial", (), parts)(), NavigationConfig())


@pytest.mark.parametrize("goal", [None, "lcca", np.zeros(2), np.full(3, np.nan)])
def test_a_goal_that_is_no_place_is_refused(scene, goal):
    with pytest.raises(ValueError, match=r"goal of Advance is .*finite.*3\)"):
        Navigation(scene, Advance(goal), NavigationConfig())


@pytest.mark.parametrize(
    "distance",
    [
        None,
        0.1,
        [0.1, 0.1],
        np.zeros(3),
        np.zeros((2, 1)),
        np.array([0.1, np.nan]),
        np.array([0.1, -0.1]),
    ],
)
def test_a_distance_along_the_route_that_is_none_is_refused(
    judged, monkeypatch, distance
):
    batch, answer = judged
    answer(GOOD)
    monkeypatch.setattr(batch.task.objective, "path_distance", lambda head: distance)
    words = r"path_distance\(\) of Advance returns .*finite.*\(2,\)"
    with pytest.raises(ValueError, match=words):
        batch.reset()


@pytest.mark.filterwarnings("error")
def test_a_path_ratio_is_finite_where_the_route_has_no_length(judged, monkeypatch):
    batch, answer = judged
    answer(GOOD)
    own = batch.task.objective
    monkeypatch.setattr(own, "path_distance", lambda head: np.zeros(2))
    assert batch.reset().path_ratio.tolist() == [0.0, 0.0]
    step = batch.step(np.ones((2, batch.num_actions)))
    assert np.isfinite(step.path_ratio).all() and (step.path_ratio > 0).all()


@pytest.mark.parametrize("hook", ["task_observables", "action_spec"])
def test_what_an_agent_sees_and_does_is_the_rollouts(hook):
    task = suite.make_task("simple1_bca")
    kind = type("Shaped", (Navigation,), {hook: getattr(Navigation, hook)})
    setattr(kind, hook, property(lambda self: {}))
    with pytest.raises(ValueError, match=f"Shaped overrides {hook}"):
        BatchSimulation(kind(task.scene, task.objective, task.config), 1)


def test_a_route_that_ends_at_a_goal_which_moves_on_is_refused(example, monkeypatch):
    def plain(anatomy, goal):
        return Cannulation.to(anatomy, goal)

    shifts = {"goal_shift": (0.0, 5e-3)}
    for objective, allowed in ((plain, False), (example.gentle, True)):
        name = f"goes_on_{allowed}"
        definition = suite.TaskDefinition("", "simple1", "bca", objective=objective)
        monkeypatch.setitem(suite.TASKS, name, definition)
        if allowed:
            task = suite.make_task(name, randomisation=shifts)
            assert task.objective.goal_arc_length is not None
        else:
            with pytest.raises(ValueError, match="ends at the goal.*farthest_sh"):
                suite.make_task(name, randomisation=shifts)


@pytest.mark.parametrize("name", ["own short", "my/short", "a,b"])
def test_a_name_that_no_environment_may_have_is_refused(name):
    with pytest.raises(ValueError, match="name is .*letters, digits"):
        suite.register(name, suite.TaskDefinition("", "simple1", "bca"))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"description": None}, "description is None"),
        ({"options": [("max_steps", 3)]}, "options is .*a mapping of names"),
        ({"objective": "Cannulation"}, "objective is 'Cannulation'.*Cannulation.to"),
        ({"objective": Cannulation}, "objective is .*a function.*Cannulation.to"),
        ({"random_arch": "yes"}, "random_arch is 'yes'"),
        ({"random_arch": True}, "anatomy is 'simple1', but random_arch draws it"),
    ],
)
def test_a_wrong_definition_is_refused(given, words):
    right = suite.TaskDefinition("", "simple1", "bca")
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(right, **given)


def test_a_function_that_makes_no_objective_is_refused(monkeypatch):
    definition = suite.TaskDefinition("", "simple1", "bca", objective=lambda a, g: None)
    monkeypatch.setitem(suite.TASKS, "makes_none", definition)
    with pytest.raises(ValueError, match="the objective NoneType lacks goal, goal_rad"):
        suite.make_task("makes_none")


def test_an_objective_or_a_goal_of_another_anatomy_is_refused():
    own, other = suite.load_anatomy("simple1"), suite.load_anatomy("type2")
    config = NavigationConfig()
    scene = Scene.build(own, "bca", config)
    right = Cannulation.to(own, scene.goal)
    away = dataclasses.replace(right, goal=right.goal + 0.1)
    elsewhere = Cannulation.to(own, own.goals["lcca"])
    for wrong in (Cannulation.to(other, other.goals["bca"]), elsewhere, away):
        with pytest.raises(ValueError, match="but the scene has the goal 'bca' of"):
            Navigation(scene, wrong, config)
    Navigation(scene, right, config)
    moved = dataclasses.replace(scene.goal, arc_length=scene.goal.arc_length + 3e-3)
    for make in (Cannulation.to, lambda a, g: Scene.build(a, g, config)):
        with pytest.raises(ValueError, match="has an arc_length of .*goal_at"):
            make(own, moved)
    with pytest.raises(ValueError, match="anatomy is 'simple1'; it must be an Anatomy"):
        Cannulation.to("simple1", scene.goal)
    for shift in (5, -1e-3, None):
        with pytest.raises(ValueError, match="farthest_shift is"):
            Cannulation.to(own, scene.goal, farthest_shift=shift)
