"""The scripted expert of coaxial devices."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from test_policies import assert_same_in_composer

from cathsim_dmc import policies, suite
from cathsim_dmc.agents import evaluate
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.entities.chain import MAX_ROTATION_SPEED
from cathsim_dmc.policies import coaxial_pursuit
from cathsim_dmc.policies.coaxial_pursuit import CoaxialPlan
from cathsim_dmc.policies.expert import Teacher
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks import coaxial_ends, retry, take_offs
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.tasks.objectives import Cannulation
from cathsim_dmc.tasks.progress import Progress
from cathsim_dmc.tasks.retry import Memory
from cathsim_dmc.tasks.route import SIDE_AHEAD, Place, locate

TASK = "simple1_bca_pair"


@pytest.fixture(scope="module")
def environment():
    seen = ["tracking", "route_coaxial", "route_retry", "route_turns"]
    env = suite.load("cathsim", TASK, {"random": 3, "observation": seen})
    yield env
    env.close()


def test_frames_of_the_links_are_those_of_the_simulator(environment):
    environment.reset()
    for _ in range(5):
        environment.step(np.array([1.0, 1.0, 1.0, -1.0]))
    # Without moving on, so that joints and frames are of the same moment.
    physics, view = environment.physics, policies.View(environment)
    physics.forward()
    model, data = physics.model.ptr, physics.data.ptr
    links = [i for i in range(model.nbody) if "catheter/link_" in model.body(i).name]
    rotations = data.xmat[links].reshape(-1, 3, 3)
    joints = environment.task.rollout.index.read(data).joint_positions[None]
    assert np.abs(joints[0, 2:]).max() > 0.02
    frame = rotations[-1:]
    for number in range(1, 9):
        frame = coaxial_ends.before(frame, joints, number)
        np.testing.assert_allclose(frame[0], rotations[-1 - number], atol=1e-12)
    assert view.rollout.devices.insertion.shape == (1, 2)


def test_a_policy_sees_the_route_from_each_shaped_end(environment):
    """The error of direction and the bend, by which the expert turns."""
    environment.reset()
    for _ in range(5):
        timestep = environment.step(np.array([1.0, 1.0, 1.0, -1.0]))
    rollout, ahead = environment.task.rollout, np.full(1, SIDE_AHEAD)
    plan, readings = CoaxialPlan.for_case(rollout.case()), rollout.readings
    place = locate(plan, readings.head)
    given = plan, readings, rollout.devices, place, ahead
    error, away = coaxial_pursuit._directions(*given)
    sides = timestep.observation["route_sides"].reshape(2, 5)
    cosine, sine, x, y, z = sides.T
    rotation = rollout.devices.tip_rotation[0]
    np.testing.assert_allclose(
        np.arctan2(sine, cosine), np.angle(np.exp(1j * rotation))
    )
    wrapped = np.angle(np.exp(1j * error[0]))
    np.testing.assert_allclose(np.arctan2(y, x), wrapped, atol=1e-9)
    np.testing.assert_allclose(np.arctan2(np.hypot(x, y), z), away[0], atol=1e-9)
    lines = timestep.observation["route_lines"].reshape(2, -1, 3)
    gaps = timestep.observation["route_gaps"]
    # The first device ends at the head, the other that much behind it.
    assert np.linalg.norm(lines[0, -1]) < 1e-9 and gaps[0] == 0.0
    assert np.linalg.norm(lines[1, -1]) == pytest.approx(gaps[1], rel=0.1)


def test_a_policy_sees_by_what_the_expert_turns(environment):
    """At the look-ahead and the offset of every attempt."""
    environment.reset()
    rollout = environment.task.rollout
    progress, plan = rollout.progress, CoaxialPlan.for_case(rollout.case())
    settings, case_of = plan.settings, np.zeros(1, int)
    gain = settings.turning / (MAX_ROTATION_SPEED * CONTROL_TIMESTEP)
    turned = 0
    for attempt in range(12):
        timestep = environment.step(np.array([1.0, 0.5, 1.0, -0.5]))
        if timestep.last():
            break
        ahead = progress.ahead(case_of, rollout.readings, rollout.devices)
        shown = timestep.observation["route_turns"]
        np.testing.assert_array_equal(shown, ahead.turns.ravel())
        memory = rollout.memory._replace(attempts=np.full(1, attempt))
        progress.memory = memory
        readings, devices = rollout.readings, rollout.devices
        seen = progress.ahead(case_of, readings, devices).turns
        state = plan.fresh((1,))._replace(arc_length=memory.arc_length)
        given = readings, rollout.wall_force, devices
        action, _ = plan.decide(settings, state, memory, *given)
        wanted = np.clip(gain * seen[0, :, 0], -1.0, 1.0)
        wanted[seen[0, :, 1] <= settings.aside] = 0.0
        np.testing.assert_allclose(action[0, 1::2], wanted, atol=1e-12)
        turned += np.abs(wanted) > 0.0
    assert turned.any()


def test_turning_by_the_error_turns_the_side_to_the_route(environment):
    environment.reset()
    plan = CoaxialPlan.for_case(environment.task.rollout.case())
    rollout = environment.task.rollout

    def directions():
        readings, ahead = rollout.readings, np.full(1, 0.02)
        place, devices = locate(plan, readings.head), rollout.devices
        return coaxial_pursuit._directions(plan, readings, devices, place, ahead)

    before, away = directions()
    wrong = float(np.angle(np.exp(1j * before[0, 0])))
    assert away[0, 0] > 0.2 and abs(wrong) > 0.5
    # Little by little, and until the twist has come through.
    steps = 26
    rate = wrong / (steps * 3.14 * 0.04)
    assert abs(rate) < 1.0
    for number in range(steps + 12):
        environment.step(np.array([0.0, rate if number < steps else 0.0, 0.0, 0.0]))
    after, _ = directions()
    # Friction keeps some of it.
    assert np.cos(after[0, 0]) > 0.9


def test_a_lead_comes_about_without_a_push():
    """In withdrawals nothing is pushed; else nothing goes faster than the first."""
    settings, leads = CoaxialPlan.settings, CoaxialPlan.settings.retry.pattern.leads
    place = Place(np.full(2 * len(leads), 0.1), np.full(2 * len(leads), -0.5))
    retracting = np.repeat([True, False], len(leads))
    insertion = np.tile([0.1, 0.08], (len(retracting), 1))
    memory = Memory.at(place, insertion[:, 0])._replace(
        retracting=retracting, attempts=np.tile(np.arange(len(leads)), 2)
    )
    speed = np.where(retracting, -settings.withdrawal, 0.3)
    reached, zero = insertion.copy(), np.zeros(len(speed))
    for _ in range(400):
        moves = coaxial_pursuit._led(settings, memory, reached, speed, zero)
        assert (moves.max(axis=1) <= speed + 1e-9).all()
        assert (moves >= -1.0).all()
        reached = reached + coaxial_pursuit._MOVE * moves
    gaps = (reached[:, 0] - reached[:, 1]).reshape(2, -1)
    np.testing.assert_allclose(gaps, [leads, leads], atol=1e-3)


def test_a_catheter_that_holds_a_branch_stays_while_the_wire_goes_on():
    settings = coaxial_pursuit.CLOSE
    deep = settings.retry.held + np.array([-1e-3, 1e-3, 1e-3])
    insertion = np.array([[0.14, 0.16], [0.14, 0.16], [0.19, 0.16]])
    place = Place(0.22 + deep, np.full(3, -0.9))
    memory = Memory.at(place, insertion[:, 0])._replace(ostium=np.full(3, 0.22))
    moves = coaxial_pursuit._led(settings, memory, insertion, np.full(3, 0.3), deep)
    np.testing.assert_allclose(moves[0], [0.3, 0.3])
    np.testing.assert_allclose(moves[1:], [[0.3, 0.0], [0.3, 0.0]])
    # A policy sees it.
    push = np.zeros(3)
    seen = retry.shown(settings.retry, memory, insertion[:, 0], push, True)[:, 12]
    np.testing.assert_allclose(seen, [-1.0, 1.75, 1.75])


def test_a_hard_push_slows_the_pair(environment):
    environment.reset()
    rollout = environment.task.rollout
    plan, memory = CoaxialPlan.for_case(rollout.case()), rollout.memory
    settings, speeds = dataclasses.replace(plan.settings, aside=np.pi), []  # no turns
    for push in (0.0, 0.2, 1.0):
        readings = rollout.readings._replace(push_force=np.full(1, push))
        given = plan.fresh((1,)), memory, readings, rollout.wall_force, rollout.devices
        speeds.append(plan.decide(settings, *given)[0][0, ::2].max())
    assert speeds[0] == pytest.approx(settings.speed)
    assert speeds[2] == pytest.approx(settings.speed * settings.creep)
    assert speeds[2] < speeds[1] < speeds[0]


@pytest.mark.parametrize(
    ("name", "goal", "ways"),
    [
        ("type1", "lcca", [40e-3]),  # narrows once more, without a bend
        ("type2", "lcca", [36e-3]),  # and bends once more, where it is narrow already
        ("type3", "bca", [41e-3]),
        ("bovine", "bca", [41e-3]),
        ("bovine", "lcca", [53e-3, 35e-3]),
    ],
)
def test_the_catheter_follows_to_a_take_off_close_to_the_first(
    environment, monkeypatch, name, goal, ways
):
    """Where the one before is close, the pair looks farther ahead and goes slowly."""
    anatomy = phantoms.load(name, access="descending")
    objective = Cannulation.to(anatomy, anatomy.goal(goal))
    case = SimpleNamespace(scene=environment.task.scene, objective=objective)
    plan = CoaxialPlan.for_case(case)  # pyright: ignore[reportArgumentType]
    left = plan.arc_length[-1] - np.array(take_offs.take_offs(plan))
    np.testing.assert_allclose(left, ways, atol=1e-3)
    assert plan.arc_length[-1] - plan.ostium == pytest.approx(left[-1])
    close = len(ways) == 2
    assert plan.settings is (coaxial_pursuit.CLOSE if close else CoaxialPlan.settings)
    progress = Progress(["route_retry"], [case], 1, False)  # pyright: ignore[reportArgumentType]
    rows, readings = np.zeros(1, int), environment.task.rollout.readings
    progress.see(rows, True, rows, readings, {})
    assert progress.memory is not None
    assert progress.memory.ostium[0] == (plan.ostium if close else np.inf)
    assert close or plan.ostium == plan.arc_length[np.diff(plan.radii).argmin()]
    assert progress.memory.last[0] == take_offs.last_apart(plan) == np.inf
    if close:  # no longer, where the way between them is longer
        monkeypatch.setattr(take_offs, "CLOSE", 0.9 * (ways[0] - ways[1]))
        plan = CoaxialPlan.for_case(case)  # pyright: ignore[reportArgumentType]
        assert plan.arc_length[-1] - plan.ostium == pytest.approx(left[0])
        last = take_offs.last_apart(plan)
        assert plan.arc_length[-1] - last == pytest.approx(left[-1])
        progress = Progress(["route_retry"], [case], 1, False)  # pyright: ignore[reportArgumentType]
        progress.see(rows, True, rows, readings, {})
        assert progress.memory is not None and progress.memory.last[0] == last
        assert plan.settings is CoaxialPlan.settings


@pytest.mark.slow
@pytest.mark.parametrize("name", ["simple1_bca_pair", "simple1_bca_wire"])
def test_the_expert_reaches_the_goal(name):
    result = evaluate("expert", name, 2, 7, task_kwargs={"max_steps": 200})
    assert result.successes == 2


@pytest.mark.slow
def test_it_plays_the_same_in_composer():
    short = {"max_steps": 12}
    batched = evaluate("expert", TASK, 2, 7, task_kwargs=short)
    for seed, episode in enumerate(batched.episodes, 7):
        assert_same_in_composer(episode, "expert", TASK, seed, short)
    assert batched.episodes[0].reward != batched.episodes[1].reward


def test_a_new_episode_forgets_the_last():
    task = suite.make_task(TASK, random=0, observation="tracking")
    simulation = BatchSimulation(task, 2, seeds=3)
    simulation.reset()
    expert, view = policies.make_policy("expert"), policies.View(simulation)
    expert.reset(view, np.ones(2, bool))
    first = expert.act(None)
    simulation.rollout.memory.attempts[:] = 4  # which has another direction
    simulation.reset(np.array([0]))
    expert.reset(view, np.array([True, False]))
    np.testing.assert_array_equal(simulation.rollout.memory.attempts, [0, 4])
    again = expert.act(None)
    assert not np.array_equal(again[1], first[1])


@pytest.mark.parametrize(
    ("task", "lead"),
    [
        ("femoral_type1_lcca_pair", 0.02),
        pytest.param("femoral_type2_bca_pair", -0.02, marks=pytest.mark.slow),
    ],
)
def test_the_teacher_reaches_the_goal_without_memory(task, lead):
    """It is told the last action and asked in every state as in the first."""
    simulation = BatchSimulation(
        suite.make_task(task, random=0, observation="tracking"), 1
    )
    simulation.reset()
    view, everyone = policies.View(simulation), np.ones(1, dtype=bool)
    teacher, action = Teacher(view, lead), np.zeros((1, 4))
    teacher.reset(everyone)
    for _ in range(200):
        action = teacher.act(action)
        step = simulation.step(action)
        if step.terminated[0]:
            break
    assert step.info()["success"][0]


@pytest.mark.slow
def test_it_drives_through_random_arches():
    """Each simulation has an anatomy, and so an expert, of its own."""
    result = evaluate(
        "expert", "arch_bca_pair", 3, 7, task_kwargs={"pool": 2, "max_steps": 60}
    )
    assert len(result.episodes) == 3
