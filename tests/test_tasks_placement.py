"""Where the device stands at the start, and what the task reads from the model."""

import dataclasses
import math
from unittest import mock

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cathsim_dmc import suite
from cathsim_dmc.agents.protocols import VARIED_RANGES
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.parts import Inlet
from cathsim_dmc.entities import devices
from cathsim_dmc.entities.posture import bends_of, nodes_of
from cathsim_dmc.physics.effects import Draw
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks import placement
from cathsim_dmc.tasks.config import NavigationConfig

ANGLES = st.floats(0, 2 * math.pi)


def direction(azimuth, height):
    radius = math.sqrt(1 - height**2)
    return np.array([radius * math.cos(azimuth), radius * math.sin(azimuth), height])


@given(azimuth=ANGLES, height=st.floats(-1, 1))
def test_frame_turns_z_into_any_direction(azimuth, height):
    axis = direction(azimuth, height)
    anatomy = phantoms.load("simple1")
    inlet = Inlet("aorta", [0, 0, 0], axis, 0.0138)
    turned = dataclasses.replace(anatomy, inlet=inlet)
    # Whatever stands behind it.
    with mock.patch.object(placement, "sheath_direction", lambda *_: inlet.direction):
        placed = placement.place_device(
            turned, anatomy.goal("bca"), devices.STEERABLE_5F
        )
    # MuJoCo normalises it.
    assert np.linalg.norm(placed.quaternion) == pytest.approx(1, abs=1e-7)
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, placed.quaternion)
    matrix = matrix.reshape(3, 3)
    # Of the sheath, which is tilted where the inlet's own would cross the aorta.
    axis = placed.direction
    np.testing.assert_allclose(matrix[:, 2], axis, atol=1e-7)
    assert axis @ inlet.direction > 0.5
    assert np.linalg.det(matrix) == pytest.approx(1, abs=1e-7)
    # +y, below the device on the table, stays as posterior as it can.
    if abs(axis[1]) < 0.98:
        assert matrix[1, 1] > 0


@pytest.mark.parametrize("name", [*arch.ARCHES, "type1", "type2"])
@pytest.mark.parametrize("access", ["ascending", "descending"])
def test_the_device_starts_inside_before_every_goal_and_reaches_it(name, access):
    anatomy = phantoms.load(name, access=access)
    for goal in anatomy.goals.values():
        route = anatomy.route(goal)
        placed = placement.place_device(anatomy, goal, devices.STEERABLE_5F)
        if name in arch.ARCHES:  # the others bend behind the inlet
            assert anatomy.lumen(placed.start) > devices.STEERABLE_5F.outer_radius
        assert placed.start_depth <= max(0.5 * route.length, 5e-3)
        assert placed.start_depth + placed.stroke >= route.length
        assert placed.working_length > placed.start_depth + placed.stroke
        np.testing.assert_allclose(
            np.linalg.norm(placed.robot - placed.start), placed.working_length
        )


@pytest.mark.parametrize("length", [0.0, 0.05, 0.09, -1.0, math.nan, math.inf, 5.0])
def test_working_length_is_checked(length):
    with pytest.raises(ValueError, match=r"working_length is .*more than.*at most"):
        anatomy = phantoms.load("simple1")
        placement.place_device(
            anatomy, anatomy.goal("bca"), devices.STEERABLE_5F, length
        )


# Start.

STARTS = ["simple1_bca", "type1_bca", "femoral_type1_lcca"]


def posture(environment):
    """Model, index and start posture of a task, and a function for the links' nodes."""
    environment.reset()
    rollout, model = environment.task.rollout, environment.physics.model.ptr
    data = mujoco.MjData(model)

    def nodes(displacement, roll=None):
        data.qpos[:] = model.qpos0
        episode = Draw(np.asarray(displacement), roll=roll)
        rollout.case().start.write(data.qpos, episode, environment.task.random)
        mujoco.mj_kinematics(model, data)
        return rollout.index.read(data).centreline

    return nodes


@pytest.mark.parametrize("task_name", STARTS)
def test_the_head_is_displaced_as_asked(shared_environment, task_name):
    environment = shared_environment(task_name)
    nodes = posture(environment)
    asked = np.random.RandomState(0).uniform(-0.5e-3, 0.5e-3, (6, 3))
    start = nodes(np.zeros(3))[-1]
    moved = np.array([nodes(displacement)[-1] for displacement in asked]) - start
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, environment.task.scene.placement.quaternion)
    # The tip swings on an arc: a few hundredths of a millimetre beside the tangent.
    expected = asked @ matrix.reshape(3, 3).T
    # Those that would press on the wall are reversed.
    expected *= np.sign(np.sum(moved * expected, axis=-1, keepdims=True))
    np.testing.assert_allclose(moved, expected, atol=4e-5)


@pytest.mark.parametrize("task_name", STARTS)
def test_the_device_waits_in_the_lumen_at_rest(shared_environment, task_name):
    environment = shared_environment(task_name)
    task = environment.task
    environment.reset()
    free = task.readings.centreline[task.readings.centreline @ [0, 0, 1] > -1.0]
    inlet = task.scene.anatomy.inlet
    inside = free[(free - inlet.position) @ inlet.direction > 2e-3]
    radius = task.scene.catheter.device.outer_radius
    # It may lean on the wall, as deep as a contact at rest.
    assert (task.scene.anatomy.lumen(inside) > radius - 0.5e-3).all()
    first = task.readings.head
    for _ in range(10):
        environment.step(np.zeros(21))
    assert np.linalg.norm(task.readings.head - first) < 1.5e-3
    assert task.wall_force.peak_max < 0.05


@pytest.mark.parametrize("roll", [0.3, -2.0, np.pi])
def test_a_rolled_device_lies_where_it_lay(shared_environment, roll):
    """Its base is turned by the model; the hinges are set so that the shape stays."""
    environment = shared_environment("type1_bca")
    nodes = posture(environment)
    base = environment.physics.model.ptr.body("catheter/link_0").id
    plain = nodes(np.zeros(3))
    quaternion = environment.physics.model.ptr.body_quat[base].copy()
    turn = np.array([np.cos(roll / 2), 0.0, 0.0, np.sin(roll / 2)])
    try:
        mujoco.mju_mulQuat(
            environment.physics.model.ptr.body_quat[base], quaternion, turn
        )
        rolled = nodes(np.zeros(3), roll)
    finally:
        environment.physics.model.ptr.body_quat[base] = quaternion
    np.testing.assert_allclose(rolled, plain, atol=1e-6)


def test_a_task_simulates_what_its_goal_needs():
    """The route, 40 mm beyond it, 20 mm in the sheath, and less than one link more."""
    for name, access in (("type1", "ascending"), ("bovine", "descending")):
        anatomy = phantoms.load(name, access=access)
        for goal in anatomy.goals.values():
            placed = placement.place_device(anatomy, goal, devices.STEERABLE_5F)
            spare = placed.working_length - anatomy.route(goal).length
            assert 0.06 <= spare < 0.06 + 0.0169 or placed.working_length < 0.0869
            # Whole links of the common chain: its joints are joints of every task.
            links = (placement.COMMON_LENGTH - placed.working_length) / 0.016875
            assert links == pytest.approx(round(links), abs=1e-6)


# Readings.


def test_readings_have_the_shapes_they_say(shared_environment):
    environment = shared_environment("type1_lcca")
    environment.reset()
    state = environment.task.readings
    links = len(environment.task.scene.catheter.links)
    joints = len(environment.task.scene.catheter.joints)
    assert state.centreline.shape == (links + 1, 3)
    assert state.joint_positions.shape == state.joint_velocities.shape == (joints,)
    assert state.com_inertia.shape == (links, 10)
    assert state.external_force.shape == (links, 6)
    np.testing.assert_array_equal(state.centreline[-1], state.head)
    lengths = np.linalg.norm(np.diff(state.centreline, axis=0), axis=-1)
    np.testing.assert_allclose(lengths, environment.task.scene.catheter.link_lengths)


def test_insertion_is_what_the_base_has_moved(shared_environment):
    environment = shared_environment("simple1_bca")
    environment.reset()
    start = environment.task.readings
    action = np.zeros(21)
    action[20] = 1.0
    for _ in range(10):
        environment.step(action)
    now = environment.task.readings
    moved = now.insertion - start.insertion
    assert 0.01 < moved <= 0.0164
    axis = environment.task.scene.placement.direction
    assert (now.head - start.head) @ axis == pytest.approx(moved, abs=3e-4)


@pytest.mark.slow
def test_an_episode_may_start_along_the_route():
    """The head lies further and further in, at rest, alike for composer and batch."""
    options = {"start_along_route": (0.0, 0.9), "random": 0}
    task = suite.make_task("type1_lcca", **options)
    environment = suite.environment(task)
    starts = []
    for _ in range(24):
        environment.reset()
        head = task.readings.head
        starts.append(head)
        assert task.scene.anatomy.lumen(head) > 0
    ways = task.objective.path_distance(np.array(starts))
    whole = task.objective.route.length - task.scene.placement.start_depth
    assert ways.min() < 0.25 * whole and ways.max() > 0.75 * whole
    batch = BatchSimulation(suite.make_task("type1_lcca", **options), 1, seeds=0)
    for start in starts[:3]:
        np.testing.assert_array_equal(batch.reset().readings.head[0], start)


def test_episodes_may_start_farther_in_and_off_the_line():
    """No start presses on the wall, and composer and batch start alike."""
    ranges = {
        "start_insertion": (0, 0.06), "start_radius": 0.01, "roll": (-3, 3),
        "tracking_noise": 5e-4,
    }  # fmt: skip
    options = {"randomisation": ranges, "observation": "tracking"}
    batch = BatchSimulation(suite.make_task("type1_lcca", **options), 24, seeds=0)
    start = batch.reset()
    heads, anatomy = start.readings.head, batch.task.scene.anatomy
    radius = batch.task.scene.catheter.device.outer_radius
    assert anatomy.lumen(heads).min() > 0.8 * radius
    way = batch.task.objective.path_distance(heads)
    assert np.ptp(way) > 0.03
    spread = [np.ptp(heads[abs(way - place) < 4e-3], axis=0).max() for place in way]
    assert max(spread) > 6e-3
    for _ in range(3):
        step = batch.step(np.zeros((24, batch.num_actions)))
        assert not any(step.errors) and step.wall_force.peak_max.max() < 0.5
    seen = step.observation["tracking_points"][:, -3:] - step.readings.head
    assert 3e-4 < seen.std() < 7e-4
    environment = suite.environment(suite.make_task("type1_lcca", random=5, **options))
    first = environment.reset().observation["tracking_points"]
    np.testing.assert_array_equal(first, start.observation["tracking_points"][5])


def test_nodes_follow_from_bends():
    bends = 0.3 * np.random.RandomState(0).normal(size=(30, 2))
    lengths = np.linspace(3e-3, 9e-3, 31)
    nodes = nodes_of(lengths, bends)
    np.testing.assert_allclose(
        bends_of(np.diff(nodes, axis=0) / lengths[:, None]), bends
    )


# Seeds whose first displacement lays the device into the vessel's wall or past it, and
# seeds whose displacement fits.
FAULTY, GOOD = (9027, 9035, 9166, 9276, 9290, 9342), (9000, 9001, 9002, 9003)


def test_a_displaced_device_stands_in_no_wall():
    """Without an action nothing presses on the wall; good draws stay what they are."""
    plain = dataclasses.replace(VARIED_RANGES, tracking_noise=0.0)
    task = suite.make_task("type1_lcca", randomisation=plain)
    seeds = (*FAULTY, *GOOD)
    batch = BatchSimulation(task, len(seeds), num_threads=1, seeds=seeds)
    start = batch.reset()
    assert start.wall_force.peak_sum.max() < 0.1
    places = start.readings.centreline
    depth = task.scene.anatomy.lumen(places[:, -5:])
    assert depth.min() > task.scene.catheter.device.outer_radius - 0.3e-3
    drawn = []
    for index, seed in enumerate(seeds):
        expected = np.random.RandomState(seed)
        episode = plain.draw(expected)
        used = batch._random_states[index]
        # Whatever is drawn next, such as a second displacement.
        drawn.append(expected.uniform() != used.uniform())
        assert np.linalg.norm(episode.displacement) <= 0.01
    assert drawn == [True] * len(FAULTY) + [False] * len(GOOD)
    for _ in range(6):
        step = batch.step(np.zeros((len(seeds), batch.num_actions)))
        assert not any(step.errors) and step.wall_force.peak_sum.max() < 0.3
    environment = suite.environment(
        suite.make_task("type1_lcca", randomisation=plain, random=FAULTY[0])
    )
    environment.reset()
    np.testing.assert_array_equal(environment.task.readings.centreline, places[0])


@pytest.mark.parametrize(
    ("task", "roll", "farther", "largest"),
    [
        ("femoral_type1_lcca_wire", 3.1, 0.0, 0.1e-3),
        ("type1_lcca_pair", -2.4, 0.0, 0.5e-3),
        ("type1_lcca_pair", 0.8, 0.04, 2e-3),
    ],
)
def test_a_rolled_device_starts_at_rest(task, roll, farther, largest):
    """A bent tip that points elsewhere is laid on the wall before the episode.

    What is left is its twist.
    """
    ranges = {"roll": (roll, roll), "start_radius": 0.0}
    if farther:
        ranges["start_insertion"] = (farther, farther)
    environment = suite.load("cathsim", task, task_kwargs={"randomisation": ranges})
    environment.reset()
    found = environment.task
    heads, frame = [found.readings.head], found.readings.head_frame
    for _ in range(10):
        environment.step(np.zeros(environment.action_spec().shape))
        heads.append(found.readings.head)
    assert found.conditions.roll == roll
    assert np.linalg.norm(np.array(heads) - heads[0], axis=1).max() < largest
    without = {"randomisation": ranges | {"roll": None}}
    level = suite.load("cathsim", task, task_kwargs=without)
    level.reset()
    turned = level.task.readings.head_frame.T @ frame
    assert np.arccos((np.trace(turned) - 1.0) / 2.0) > 0.3


def test_an_ill_conditioned_displacement_is_not_written(shared_environment):
    """Joints that miss the place of the head by far leave the device at rest."""
    environment = shared_environment("type1_lcca")
    environment.reset()
    task, data = environment.task, environment.physics.data
    start = task.rollout.case().start
    (posture,) = start._starts

    def written(steps, displacement=(8e-4, 0.0, 0.0)):
        with mock.patch.object(posture, "_steps", steps):
            qpos = data.qpos.copy()
            start.write(qpos, Draw(np.array(displacement)), np.random.RandomState(0))
        return qpos

    rest, steps = written(posture._steps, (0.0, 0.0, 0.0)), posture._steps
    assert np.abs(written(steps) - rest).max() > 5e-3
    # As of a Jacobian that is nearly singular, or is.
    for wrong in (10.0 * steps, 500.0 * steps, np.zeros((3, 3))):
        np.testing.assert_array_equal(written(wrong), rest)
    tilted = steps.copy()
    tilted[0] += 30.0  # a base that moves 24 mm for 0.8 mm of the head
    moved = written(tilted) - rest
    assert abs(moved[task.rollout.index.insertion_qpos]) < 4e-3


def test_the_depth_of_a_posture_is_that_of_its_contacts():
    """The check before an episode and MuJoCo's collision see the same walls."""
    ranges = {"start_radius": 0.01, "start_insertion": (0.0, 0.06)}
    # With play, the bore of the sheath touches the device, too.
    options = {"randomisation": ranges, "random": 0, "sheath_clearance": 0.35e-3}
    task = suite.make_task("femoral_type1_lcca", **options)
    environment = suite.environment(task)
    model = environment.physics.model.ptr
    data, index = mujoco.MjData(model), task.rollout.index
    deep = []
    for posture in task.rollout.case().start._starts[1::2]:
        for displacement in np.random.RandomState(1).uniform(-8e-3, 8e-3, (40, 3)):
            joints = posture.joints(displacement, None)
            data.qpos[:] = model.qpos0
            posture.write(data.qpos, joints)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            points = posture._shape.points(joints)
            np.testing.assert_allclose(
                points[-1], data.site_xpos[index.head_site], atol=1e-9
            )
            walls = np.isin(data.contact.geom, index.walls).any(axis=-1)
            seen = [
                -data.contact.dist[chosen].min(initial=0.0)
                for chosen in (walls, ~walls)
            ]
            found = posture._shape.depths(points).clip(min=0.0)
            if max(seen) < 1.0e-3:  # of deeper ones MuJoCo sees the nearest wall
                np.testing.assert_allclose(found, seen, atol=1.5e-4)
            deep.append(seen)
    assert (np.max(deep, axis=0) > 5e-4).all() and len(deep) > 200


def test_a_device_with_more_play_in_the_sheath_stays_as_far_from_other_vessels():
    """The sheath of `type3` passes its descending aorta, whose wall is 5 mm thick."""
    anatomy = phantoms.load("type3")
    behind = np.arange(0.015, placement.COMMON_LENGTH, 1e-3)[:, None]
    for play in (0.0, 0.35e-3, 1e-3, 2e-3):
        way = placement.sheath_direction(anatomy, play)
        away = -anatomy.lumen(anatomy.inlet.position - behind * way).max()
        assert away - play > 5.1e-3, play
    narrow = placement.sheath_direction(anatomy, 0.35e-3)
    np.testing.assert_array_equal(narrow, anatomy.inlet.direction)
    place = anatomy, anatomy.goal("bca"), devices.STEERABLE_5F
    with (
        mock.patch.object(placement, "_LARGEST_TILT", 0.0),
        pytest.raises(ValueError, match="sheath_clearance is 0.002 m.*give 0.00035 m"),
    ):
        placement.place_device(*place, play=2e-3)


@pytest.mark.parametrize("given", [0.5, (0.5,), (0.5, 0.2), (0, 2), ("0", 1), (-1, 0)])
def test_bad_shares_of_the_route_are_refused(given):
    with pytest.raises(ValueError, match=r"start_along_route.*low <= high.*0 to 0.95"):
        NavigationConfig(start_along_route=given)
