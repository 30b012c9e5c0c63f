"""The scripted expert: its geometry against MuJoCo, its retries, and its success."""

import numpy as np
import pytest
from conftest import twin
from hypothesis import given, settings
from hypothesis import strategies as st

from cathsim_dmc import agents, policies, suite
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.physics.readings import part
from cathsim_dmc.policies import attempts, pursuit
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.retry import Memory
from cathsim_dmc.tasks.route import Place, locate

TASKS = (
    "type1_bca",
    "type1_lcca",
    "type2_bca",
    "type2_lcca",
    "femoral_type1_lcca",
    "femoral_type2_lcca",
    "femoral_type3_bca",
    "femoral_bovine_lcca",
)
GENTLE = 0.2  # N, below which most published forces lie


def make_task(name="type1_lcca", **options):
    return suite.make_task(name, **{"observation": "tracking", **options})


@pytest.fixture(scope="module")
def task():
    """The harder published task, which the tests' simulations run one at a time."""
    return make_task()


@pytest.fixture(scope="module")
def to_bca():
    return make_task("type1_bca")


@pytest.fixture(scope="module")
def plan(task):
    """Plan of the same."""
    return plan_of(task)


def plan_of(task):
    return pursuit.Plan.for_case(BatchSimulation(task, 1).rollout.case())


def jiggled(task, count, steps, seed=0):
    """Simulations after random actions that push forwards."""
    simulation = BatchSimulation(task, count, num_threads=1, seeds=seed)
    simulation.reset()
    random = np.random.default_rng(seed)
    for step in range(steps):
        if step % 10 == 0:
            action = random.uniform(-1, 1, (count, simulation.num_actions))
            action[:, 20] = np.abs(action[:, 20])
        simulation.step(action)
    return simulation


@pytest.mark.parametrize("rotation, roll", [(False, 0.0), (True, 0.0), (False, 2.0)])
def test_tip_frames_are_mujocos(rotation, roll):
    """Of a device that is rolled before it enters, too."""
    options = {"rotation": rotation, "random": 0}
    options["randomisation"] = {"roll": (roll, roll)} if roll else False
    env = suite.load(suite.DOMAIN, "simple1_lcca", task_kwargs=options)
    task, random = env.task, np.random.default_rng(0)
    env.reset()
    for _ in range(10):
        env.step(random.uniform(-1, 1, env.action_spec().shape))
    physics = env.physics
    physics.forward()
    joints = [motor.joint for motor in task.scene.catheter.tip_motors]
    expected = physics.bind(joints).xaxis.reshape(-1, 2, 3)
    head = physics.bind(task.scene.catheter.head).xmat.reshape(3, 3)[:, 2]
    state = task.rollout.index.read(physics.data.ptr)
    plan = pursuit.Plan.for_case(task.rollout.case())
    axes, direction = pursuit.tip_frames(plan, state)
    # The y hinge sits on the frame that the x hinge has turned.
    np.testing.assert_allclose(axes, expected, atol=1e-9)
    np.testing.assert_allclose(direction, head, atol=1e-9)


@pytest.mark.parametrize(
    "hinge, towards", [(0, (0, -1)), (1, (1, 0))], ids=["bend_x", "bend_y"]
)
def test_a_positive_bend_turns_the_head_as_documented(hinge, towards):
    # Here the head stands amid the aorta; in a narrower one it leans on the wall.
    simulation = BatchSimulation(make_task("simple1_bca"), 1, num_threads=1)
    simulation.reset()
    before = simulation.rollout.readings.head[0]
    action = np.zeros((1, simulation.num_actions))
    action[0, hinge:20:2] = 0.3
    for _ in range(15):
        simulation.step(action)
    moved = (simulation.rollout.readings.head[0] - before)[:2]
    assert moved @ towards > 0.9 * np.linalg.norm(moved) > 5e-3


@given(s=st.floats(0.0, 1.0), fraction=st.floats(0.0, 0.95), angle=st.floats(0, 6.28))
@settings(max_examples=50)
def test_a_head_in_the_tube_is_not_outside(plan, s, fraction, angle):
    index = int(s * (len(plan.points) - 1))
    across = np.linalg.svd(np.gradient(plan.points, axis=0)[index][None])[2][1:]
    offset = np.cos(angle) * across[0] + np.sin(angle) * across[1]
    head = plan.points[index] + fraction * plan.radii[index] * offset
    place = locate(plan, head)
    assert place.excess <= 0
    distance = np.linalg.norm(plan.at(place.arc_length) - head)
    assert distance <= fraction * plan.radii[index] + 1e-9


def test_beside_the_ostium_the_head_is_still_in_the_parent(task, plan):
    origin = task.scene.anatomy.tree.origin("lcca")
    # Off the aorta's axis, nearer to the axis of the branch, but out of its tube.
    aorta = task.scene.anatomy.tree.vessel("aorta").centreline.at(origin)
    branch = task.objective.branch.at(task.objective.ostium * 0.75)
    across = np.cross(branch.tangent, aorta.tangent)
    away = branch.radius * 1.3 * across / np.linalg.norm(across)
    head = branch.position + away
    assert task.scene.anatomy.lumen(head) > 0
    assert task.objective.route.project(head).arc_length > origin + 5e-3
    place = locate(plan, head)
    assert place.excess <= 0
    assert place.arc_length <= origin + 1e-3


def test_many_act_as_each_alone(task, plan):
    simulation = jiggled(task, 3, 20)
    readings, wall_force = simulation.rollout.readings, simulation.rollout.wall_force
    memory = simulation.rollout.memory
    memory = memory._replace(retracting=np.array([False, True, False]))
    together, alone = plan.fresh((3,)), [plan.fresh(()) for _ in range(3)]
    for _ in range(3):
        action, together = plan.decide(
            plan.settings, together, memory, readings, wall_force
        )
        assert action.shape == (3, plan.num_actions)
        assert np.abs(action).max() <= 1.0
        for index in range(3):
            own, alone[index] = plan.decide(
                plan.settings,
                alone[index],
                part(memory, index),
                part(readings, index),
                part(wall_force, index),
            )
            np.testing.assert_allclose(action[index], own, rtol=0, atol=1e-12)


def test_bends_follow_the_leader(plan):
    bend = np.random.default_rng(0).uniform(-0.3, 0.3, (1, len(plan.tip), 2))
    state = plan.fresh((1,))._replace(bend=bend, insertion=np.array([0.05]))
    link = plan.link_length
    pushed = pursuit._follow_the_leader(plan, state, state.insertion + link)
    np.testing.assert_allclose(pushed[:, :-1], bend[:, 1:])
    pulled = pursuit._follow_the_leader(plan, state, state.insertion - link)
    np.testing.assert_allclose(pulled[:, 1:], bend[:, :-1])
    half = pursuit._follow_the_leader(plan, state, state.insertion + link / 2)
    np.testing.assert_allclose(half[:, :-1], (bend[:, :-1] + bend[:, 1:]) / 2)


def driven(settings, **values):
    """Translation with a memory of two heads that stand on the route."""
    place = Place(np.full(2, 0.1), np.full(2, -0.5))
    memory = Memory.at(place, np.full(2, 0.08))
    memory = memory._replace(**{k: np.array(v) for k, v in values.items()})
    force = np.array([0.0, 1.0])
    return attempts.translation(settings, memory, force, force, np.array([1.0, 1.0]))


def test_a_device_is_pressed_on_withdrawn_or_left_where_it_is():
    settings = pursuit.Settings()
    forward = driven(settings)
    np.testing.assert_allclose(forward, [0.6, 0.6 * settings.creep])
    # Stuck and misaligned it presses on, as long as wall and base feel little.
    place = Place(np.full(2, 0.1), np.full(2, -0.5))
    memory = Memory.at(place, np.zeros(2))._replace(stale=np.array([30, 30]))
    pushes, none = np.array([0.0, 0.2]), np.zeros(2)
    pressed = attempts.translation(settings, memory, none, pushes, none)
    creep = settings.speed * settings.creep
    np.testing.assert_allclose(pressed, [settings.speed * settings.press, creep])
    # The tip is straightened before it is withdrawn.
    back = driven(settings, retracting=[True] * 2, stale=[0, settings.straightening])
    np.testing.assert_allclose(back, [0.0, -settings.withdrawal])
    assert settings.withdrawal <= 0.25
    assert not driven(settings, given_up=[True] * 2).any()


def test_a_tip_is_straightened_before_it_is_withdrawn(task, plan):
    simulation = jiggled(task, 1, 20)
    rollout, state = simulation.rollout, plan.fresh((1,))
    state = state._replace(bend=np.full((1, len(plan.tip), 2), 0.1))
    memory = rollout.memory._replace(retracting=np.ones(1, bool))
    seen = rollout.readings, rollout.wall_force
    for _ in range(plan.settings.straightening):
        action, state = plan.decide(plan.settings, state, memory, *seen)
    assert np.abs(state.bend).max() < 0.1 * 0.1 and action[0, 20] == 0.0


def test_reset_forgets_only_those_named(task):
    simulation = jiggled(task, 3, 20)
    view, pilot = policies.View(simulation), policies.make_policy("expert")
    pilot.reset(view, np.ones(3, bool))
    pilot.act(None)
    kept = pilot.state.bend.copy()
    assert (np.abs(kept).max((1, 2)) > 0).all()
    pilot.reset(view, np.array([False, True, False]))
    assert not pilot.state.bend[1].any() and np.isnan(pilot.state.insertion[1])
    np.testing.assert_array_equal(pilot.state.bend[[0, 2]], kept[[0, 2]])


def test_a_device_without_motors_is_refused():
    with pytest.raises(ValueError, match="has no motors.*steerable_5f"):
        plan_of(make_task(device="diagnostic_5f_j"))


def test_policy_reaches_the_goal_in_a_composer_environment(task):
    env = suite.environment(twin(task, 5))
    act = policies.in_environment(policies.make_policy("expert"), env)
    lengths = []
    for _ in range(2):
        timestep, steps, largest = env.reset(), 0, 0.0
        while not timestep.last():
            timestep = env.step(act(timestep))
            largest = max(largest, float(env.task.wall_force.peak_max))
            steps += 1
        assert env.task.termination == "success"
        assert largest < GENTLE
        lengths.append(steps)
    # The second episode begins without memory of the first.
    assert max(lengths) < 300


def test_it_recovers_from_a_wrong_branch(task, to_bca):
    # A straight push ends in the BCA of this phantom.
    simulation = BatchSimulation(task, 1, num_threads=1, seeds=3)
    simulation.reset()
    push = np.zeros((1, simulation.num_actions))
    push[0, 20] = 1.0
    bca = to_bca.objective
    for _ in range(150):
        simulation.step(push)
        if bca.in_branch(simulation.rollout.readings.head)[0]:
            break
    else:
        pytest.fail("the push did not end in the BCA")
    for _ in range(10):
        simulation.step(push)
    pilot, view = policies.make_policy("expert"), policies.View(simulation)
    pilot.reset(view, np.ones(1, bool))
    for _ in range(600):
        step = simulation.step(pilot.act(None))
        if step.terminated[0]:
            break
    assert step.outcome.success[0]
    assert simulation.rollout.memory.attempts[0] >= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_it_masters_the_tasks_gently(name):
    result = agents.evaluate("expert", name, episodes=10)
    assert result.successes == 10
    assert result.values("forces.peak_max.maximum").max() < GENTLE
    assert result.values("length").max() < 300


@pytest.mark.slow
@pytest.mark.parametrize("number, access", [(3, "ascending"), (8, "descending")])
def test_it_solves_arches_that_nobody_tuned_it_on(number, access):
    anatomy = arch.build_seed(arch.arch_set("test")[number], access=access)
    for goal in ("bca", "lcca", "lsa"):
        result = agents.evaluate(
            "expert", "navigate", 2, 5, task_kwargs={"anatomy": anatomy, "goal": goal}
        )
        assert result.successes == 2
        assert result.values("forces.peak_max.maximum").max() < GENTLE
