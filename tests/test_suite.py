"""Every task of the suite keeps the contracts of dm_env, dm_control and this domain."""

import dataclasses
import itertools

import numpy as np
import pytest
from absl.testing import absltest
from conftest import EACH_TASK, OBSERVATIONS, SHORT_EPISODE, TASKS, twin
from containment import Containment
from dm_control import suite as dm_suite
from dm_env import specs, test_utils
from scipy.stats import qmc

from cathsim_dmc import suite
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.parts import Goal
from cathsim_dmc.entities.catheter import Catheter
from cathsim_dmc.entities.devices import DEVICES
from cathsim_dmc.physics import forces
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.navigation import Navigation

# The goal does not move within an anatomy, unless it is randomised.
CONSTANT = {"tracking_goal", "tracking_goal_pixels", "goal_position"}


def all_observations(shared_environment):
    return shared_environment("type1_lcca", observation=tuple(OBSERVATIONS))


def random_actions(environment, steps, seed=0):
    spec = environment.action_spec()
    random = np.random.RandomState(seed)
    return random.uniform(spec.minimum, spec.maximum, (steps, *spec.shape))


def assert_bitwise_equal(first, second):
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        assert list(one) == list(other)
        for key in one:
            assert one[key].dtype == other[key].dtype
            assert one[key].tobytes() == other[key].tobytes(), key


# The contract of dm_env, with episodes that end within the action sequence.


class Contract(test_utils.EnvironmentTestMixin):
    task_name: str

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        options = {"max_steps": SHORT_EPISODE}
        if "pool" in suite.task_options(cls.task_name):
            options["pool"] = 2  # each takes a second to compile
        cls.loaded = suite.load("cathsim", cls.task_name, task_kwargs=options)

    @classmethod
    def tearDownClass(cls):
        cls.loaded.close()
        super().tearDownClass()

    def make_object_under_test(self):
        # As after construction, which takes a second: the next step is a reset.
        self.loaded._reset_next_step = True
        return self.loaded

    def tearDown(self):
        absltest.TestCase.tearDown(self)

    def make_action_sequence(self):
        yield from random_actions(self.loaded, 2 * SHORT_EPISODE)

    def test_episode_ends_within_the_sequence(self):
        self.loaded.reset()
        steps = [self.loaded.step(action) for action in self.make_action_sequence()]
        self.assertIn(True, [step.last() for step in steps])


# What stands for all of them in a hurry: each access, each kind of anatomy and devices.
QUICK = (
    "simple1_bca",
    "type1_lcca",
    "femoral_type2_bca",
    "arch_lcca",
    "type1_lcca_wire",
    "femoral_type1_lcca_pair",
)

# One class for every registered task, those of the future included.
for _name in suite.SUITE:
    _class = f"TestContract{_name.title().replace('_', '')}"
    _test = type(_class, (Contract, absltest.TestCase), {"task_name": _name})
    if _name not in QUICK:
        _test = pytest.mark.slow(_test)
    globals()[_class] = _test
del _test  # not to be collected once more under this name


# The sweep over tasks.


def test_the_published_tasks_are_there():
    assert set(TASKS) <= set(suite.SUITE)
    for name in TASKS:
        assert suite.SUITE[name].__doc__.count("\n") == 0, "one line for `cathsim list`"


@pytest.mark.parametrize("task_name", EACH_TASK)
def test_action_spec(shared_environment, task_name):
    spec = shared_environment(task_name).action_spec()
    assert isinstance(spec, specs.BoundedArray)
    assert spec.shape == (21,) and spec.dtype == np.float64
    assert (spec.minimum == -1).all() and (spec.maximum == 1).all()
    names = [name.removeprefix("catheter/") for name in spec.name.split("\t")]
    tip = [f"tip_{axis}_{joint}" for joint in range(10) for axis in "xy"]
    assert names == [*tip, "insertion"]


@pytest.mark.parametrize("task_name", EACH_TASK)
def test_start_is_randomised_within_a_millimetre(shared_environment, task_name):
    """Around where the device has settled, which no seed decides."""
    environment = shared_environment(task_name)
    heads = []
    for _ in range(12):
        environment.reset()
        heads.append(environment.task.readings.head)
    heads = np.array(heads)
    assert len(np.unique(heads.round(9), axis=0)) == len(heads)
    task = twin(environment.task, randomisation={"start_radius": 0.0})
    suite.environment(task).reset()
    displacement = np.linalg.norm(heads - task.readings.head, axis=-1)
    assert 0.3e-3 < displacement.max() < 1.02e-3


def test_no_memory_is_shared_between_any_observations(shared_environment):
    environment = all_observations(shared_environment)
    first = environment.reset().observation
    kept = {key: value.copy() for key, value in first.items()}
    second, third = (
        environment.step(action).observation
        for action in random_actions(environment, 2)
    )
    arrays = [
        (f"{name} of step {step}", value)
        for step, observation in enumerate((first, second, third))
        for name, value in observation.items()
    ]
    for index, (name, value) in enumerate(arrays):
        for other_name, other in arrays[:index]:
            assert not np.shares_memory(value, other), f"{name} and {other_name}"
    for key, value in kept.items():
        np.testing.assert_array_equal(first[key], value)


def test_none_of_all_observations_is_constant(shared_environment):
    environment = all_observations(shared_environment)
    seen = [environment.reset().observation]
    actions = random_actions(environment, 25)
    # Forward and to one side, so that the device touches the wall.
    actions[5:] = 1.0
    seen += [environment.step(action).observation for action in actions]
    for key in seen[0]:
        if key not in CONSTANT:
            assert any((one[key] != seen[0][key]).any() for one in seen), key


def test_dm_control_loads_the_task(shared_environment, reseed):
    """Neither who loads an environment nor its past changes an episode."""
    task, seed = "type1_lcca", 7
    used = shared_environment(task)
    reseed(used, seed)
    new = dm_suite.load(
        "cathsim", task, task_kwargs={"random": seed}, visualize_reward=True
    )
    timesteps = [[reseed(used, seed)], [new.reset()]]
    for rows, environment in zip(timesteps, (used, new), strict=True):
        rows += [environment.step(action) for action in random_actions(used, 20)]
    assert_bitwise_equal(*([t.observation for t in rows] for rows in timesteps))
    new.close()


def test_a_model_is_compiled_once_unless_a_hook_may_have_changed_it(shared_environment):
    task = shared_environment("type1_lcca").task
    environment, hooked = (suite.environment(twin(task)) for _ in range(2))
    called = []
    hooked.add_extra_hook("initialize_episode_mjcf", called.append)
    for env, times in ((environment, 0), (hooked, 1)):
        model = env.physics.model.ptr
        env.reset()
        env.reset()
        assert (env.physics.model.ptr is model) == (times == 0)
        assert len(called) == times
        env.close()


def test_steps_in_one_loop_are_those_of_composer(shared_environment):
    task = shared_environment("type1_lcca").task
    alone, watched, buffered = (suite.environment(twin(task, 5)) for _ in range(3))
    times = []
    watched.add_extra_hook("after_substep", lambda physics, _: times.append(1))
    buffered.task.task_observables["position"].buffer_size = 2
    environments = alone, watched, buffered
    rows = [[environment.reset()] for environment in environments]
    for action in random_actions(alone, 8):
        for row, environment in zip(rows, environments, strict=True):
            row.append(environment.step(action))
    assert len(times) == 8 * task.substeps
    seen = [[timestep.observation for timestep in row] for row in rows]
    assert_bitwise_equal(seen[0], seen[1])
    assert [row.reward for row in rows[0]] == [row.reward for row in rows[1]]
    old, new = seen[2][-1]["position"]
    np.testing.assert_array_equal(new, seen[0][-1]["position"])
    assert (old != new).any()
    for environment in environments:
        environment.close()


@pytest.mark.parametrize("settings", [{}, {"raise_exception_on_physics_error": True}])
@pytest.mark.parametrize("calls_super", [True, False])
def test_a_subclass_of_the_task_gets_its_after_substep(
    shared_environment, calls_super, settings
):
    task = shared_environment("type1_lcca").task
    times = []

    class Sampled(Navigation):
        def after_substep(self, physics, random_state):
            if calls_super:
                super().after_substep(physics, random_state)
            times.append(physics.time())

    own = Sampled(task.scene, task.objective, task.config, 0)
    own = suite.environment(own, **settings)
    alone = suite.environment(twin(task))
    for environment in (own, alone):
        environment.reset()
    seen = [env.step(np.ones(21)).observation for env in (own, alone)]
    assert len(times) == task.substeps
    assert_bitwise_equal(seen[:1], seen[1:])
    rows = [env.task.stepper.contact_rows for env in (own, alone)]
    assert rows[1][:, 1:].any()
    np.testing.assert_array_equal(*rows)
    for environment in (own, alone):
        environment.close()


def test_an_episode_that_a_subclass_does_not_begin_is_refused(shared_environment):
    task = shared_environment("type1_lcca").task

    class Own(Navigation):
        def initialize_episode(self, physics, random_state):
            pass

    env = suite.environment(Own(task.scene, task.objective, task.config, 0))
    env.reset()
    with pytest.raises(RuntimeError, match="no episode has begun.*super"):
        env.step(np.zeros(21))
    env.close()


def test_a_warning_beside_a_hook_repeats_the_control_step(shared_environment):
    env = suite.environment(twin(shared_environment("type1_lcca").task))
    times = []

    def disturb(physics, random_state):
        times.append(physics.time())
        if len(times) == 3:  # not in the repetition
            physics.data.qvel[:] = 1e6

    env.add_extra_hook("after_substep", disturb)
    env.reset()
    timestep = env.step(np.zeros(21))
    assert timestep.mid() and timestep.reward < 0 and env.task.stepper.repeated[0] == 1
    assert len(times) == 3 and env.task.error is None
    assert env.step(np.zeros(21)).mid()
    assert len(times) == 3 + env.task.substeps
    env.close()


@pytest.mark.parametrize(
    "options", [{"random": -1}, {"observation": "pixels"}, {"friction": -1.0}]
)
def test_wrong_options_are_refused_before_an_anatomy_is_made(monkeypatch, options):
    for name in ("load_anatomy", "load_arches"):
        monkeypatch.setattr(suite, name, lambda *_, **__: pytest.fail("work is lost"))
    for task in ("type1_bca", "arch_bca"):
        with pytest.raises(ValueError, match=next(iter(options))):
            suite.make_task(task, **options)
    # Also where it is the default of a single device.
    for option in {"device": "steerable_5f"}, {"rotation": False}:
        with pytest.raises(ValueError, match="replaces it; leave one of the two out"):
            suite.make_task("type1_bca_pair", **option)


def test_the_number_of_actions_is_known_without_a_task():
    for device, rotation in itertools.product(DEVICES, (False, True)):
        options = {"device": device, "rotation": rotation}
        made = Catheter(device, rotation=rotation).action_names
        assert suite.num_actions("type1_bca", **options) == len(made), device
    for task, count in {"type1_lcca_wire": 2, "arch_any_pair": 4}.items():
        assert suite.num_actions(task) == count


def test_only_a_phantom_has_an_access():
    own = suite.load_anatomy("simple1")
    with pytest.raises(ValueError, match="access 'descending' is given, but only"):
        suite.make_task("navigate", anatomy=own, access="descending")


def test_a_task_has_one_environment_with_known_settings(shared_environment):
    task = shared_environment("type1_lcca").task
    with pytest.raises(ValueError, match="has an environment already"):
        suite.environment(task)
    with pytest.raises(ValueError, match="environment_kwargs.*time_limit"):
        suite.environment(twin(task), flat_observation=True)
    with pytest.raises(ValueError, match="n_sub_steps.*a mapping with some of"):
        suite.environment(twin(task), n_sub_steps=5)
    with pytest.raises(ValueError, match="lead is 0.2, which only several"):
        suite.make_task("type1_lcca", lead=0.2)
    with pytest.raises(ValueError, match="task is 'type1_bca'"):
        BatchSimulation("type1_bca", 2)


def test_time_steps_that_are_set_on_a_task_are_refused():
    task = suite.make_task("simple1_bca")
    for steps in (0.02, 4e-3), (0.04, 2e-3):
        task.set_timesteps(*steps)
        for make in suite.environment, lambda task: BatchSimulation(task, 1):
            with pytest.raises(ValueError, match="option physics_timestep"):
                make(task)


def test_a_closed_environment_says_so(shared_environment):
    environment = suite.environment(twin(shared_environment("type1_lcca").task))
    environment.reset()
    snapshot = environment.snapshot()
    environment.close()
    environment.close()
    for call, *arguments in (
        (environment.reset,),
        (environment.step, np.zeros(21)),
        (environment.restore, snapshot),
    ):
        with pytest.raises(RuntimeError, match="is closed; make another one"):
            call(*arguments)


def test_a_step_keeps_the_axis_of_the_buffer(shared_environment):
    task = shared_environment("type1_lcca").task
    environment = suite.environment(twin(task), strip_singleton_obs_buffer_dim=False)
    spec = environment.observation_spec()
    for timestep in (environment.reset(), environment.step(np.zeros(21))):
        for name, value in timestep.observation.items():
            assert value.shape == spec[name].shape


def test_the_solver_has_the_tolerance_of_the_task_in_both_paths():
    task = suite.make_task("type1_bca", solver_tolerance=3e-8)
    batch = BatchSimulation(task, 1)
    environment = suite.environment(twin(task, 0))
    assert batch.batch.model.opt.tolerance == 3e-8
    assert environment.physics.model.opt.tolerance == 3e-8


def test_environment_kwargs_reach_composer():
    environment = suite.load(
        "cathsim", "simple1_bca", environment_kwargs={"time_limit": 0.1}
    )
    environment.reset()
    last = [environment.step(np.zeros(21)).last() for _ in range(3)]
    assert last == [False, False, True]
    environment.close()


# Reward, discount and end of the episode.


@pytest.mark.parametrize("task_name", EACH_TASK)
def test_time_out_comes_at_max_steps_with_discount_one(shared_environment, task_name):
    task = twin(shared_environment(task_name).task, max_steps=SHORT_EPISODE)
    environment = suite.environment(task)
    environment.reset()
    steps = [environment.step(np.zeros(21)) for _ in range(SHORT_EPISODE)]
    assert [step.last() for step in steps] == [False] * (SHORT_EPISODE - 1) + [True]
    assert [step.discount for step in steps] == [1.0] * SHORT_EPISODE
    assert environment.task.termination == "truncated"
    assert environment.step(np.zeros(21)).first()
    assert environment.step(np.zeros(21)).mid()


@pytest.fixture(scope="module")
def near_goal():
    """An environment whose goal lies 3 cm ahead of the tip."""
    anatomy = phantoms.load("simple1")
    line = anatomy.tree.vessel("aorta").centreline
    place = line.at(0.105)
    goal = Goal("near", "aorta", place.position, 0.105)
    environment = suite.load(
        "cathsim",
        "navigate",
        task_kwargs={"anatomy": anatomy, "goal": goal, "random": 3},
    )
    yield environment
    environment.close()


def push(size=21):
    action = np.zeros(size)
    action[20] = 1.0
    return action


def test_success_pays_ten_and_ends_with_discount_zero(near_goal):
    timestep = near_goal.reset()
    steps = 0
    while not timestep.last():
        timestep = near_goal.step(push())
        steps += 1
        assert steps < 60, "the goal was never reached"
    assert near_goal.task.info()["distance"] < near_goal.task.objective.goal_radius
    assert timestep.reward == 10.0
    assert timestep.discount == 0.0
    assert near_goal.task.termination == "success"
    assert near_goal.task.info()["success"]
    # 2.2 cm at 40 mm/s, less at first.
    assert 12 <= steps
    assert near_goal.step(push()).first()
    assert near_goal.task.termination is None


def test_success_at_the_last_step_is_success(near_goal, reseed, monkeypatch):
    reseed(near_goal, 3)
    steps = 1
    while not near_goal.step(push()).last():
        steps += 1
    limited = dataclasses.replace(near_goal.task.config, max_steps=steps)
    monkeypatch.setattr(near_goal.task.rollout, "_config", limited)
    reseed(near_goal, 3)
    timesteps = [near_goal.step(push()) for _ in range(steps)]
    assert [step.last() for step in timesteps] == [False] * (steps - 1) + [True]
    assert timesteps[-1].discount == 0.0 and timesteps[-1].reward == 10.0
    assert near_goal.task.termination == "success"


# Noise.


# m, what the device may sink into the wall: the bound of the soak (benchmarks/soak.py).
PENETRATION = 1e-3
# m, what the wall pieces may stay behind the true lumen; see anatomy/fidelity.py.
RECESSION = 0.6e-3
WALL_FORCE = 10.0  # N


@pytest.mark.parametrize("task_name", EACH_TASK)
@pytest.mark.parametrize(
    "steps",
    [
        pytest.param(100, id="100"),
        pytest.param(2000, id="2000", marks=pytest.mark.slow),
    ],
)
def test_halton_noise_breaks_nothing(
    task_name, steps, shared_environment, reseed, record_property
):
    """Low-discrepancy noise on every motor: the device stays in lumen and sheath.

    Every link is measured at points 1 mm apart, in the *true* lumen.
    """
    environment = shared_environment(task_name)
    task = environment.task
    reseed(environment, 0)
    containment = Containment.of(task)
    excess, force, depth = [], [], []
    actions = 2 * qmc.Halton(task.num_actions, seed=0).random(steps) - 1
    environment.reset()
    for count, action in enumerate(actions, start=1):
        timestep = environment.step(action)
        assert timestep.last() == (count == 2000)  # noise finds no branch
        excess.append(containment.largest_excess(task.readings.centreline))
        force.append(task.wall_force.peak_max)
        contacts = forces.Contacts.from_sensor(task.stepper.contact_rows[0])
        depth.append(contacts.penetration.max(initial=0.0))
    warnings = [warning.number for warning in environment.physics.data.ptr.warning]
    assert not any(warnings), warnings
    figures = {
        "largest_wall_force_N": float(max(force)),
        "largest_excess_mm": 1e3 * float(max(excess)),
        "largest_penetration_mm": 1e3 * float(max(depth)),
    }
    for name, value in figures.items():
        record_property(name, value)
    print(task_name, steps, {name: round(v, 3) for name, v in figures.items()})
    assert max(force) <= WALL_FORCE
    assert max(depth) <= PENETRATION
    assert max(excess) <= PENETRATION + RECESSION
