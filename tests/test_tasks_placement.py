"""Where the device stands at the start, and what the task reads from the model."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cathsim_dmc.anatomy.anatomy import Inlet
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.entities import devices
from cathsim_dmc.tasks import placement, readings

ANGLES = st.floats(0, 2 * math.pi)


def direction(azimuth, height):
    radius = math.sqrt(1 - height**2)
    return np.array([radius * math.cos(azimuth), radius * math.sin(azimuth), height])


@given(azimuth=ANGLES, height=st.floats(-1, 1))
def test_frame_turns_z_into_any_direction(azimuth, height):
    axis = direction(azimuth, height)
    anatomy = arch.load("simple1")
    inlet = Inlet("aorta", [0, 0, 0], axis, 0.0138)
    placed = placement.place_device(
        dataclasses.replace(anatomy, inlet=inlet), 0.2, devices.PUBLISHED, 0.3
    )
    assert np.linalg.norm(placed.quaternion) == pytest.approx(1, abs=1e-9)
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, placed.quaternion)
    matrix = matrix.reshape(3, 3)
    np.testing.assert_allclose(matrix[:, 2], inlet.direction, atol=1e-7)
    assert np.linalg.det(matrix) == pytest.approx(1, abs=1e-7)
    # +y, below the device on the table, stays as posterior as it can.
    if abs(axis[1]) < 0.98:
        assert matrix[1, 1] > 0


@pytest.mark.parametrize("name", arch.ARCHES)
def test_the_device_starts_inside_and_reaches_every_goal(name):
    anatomy = arch.load(name)
    for goal in anatomy.goals.values():
        route = anatomy.route(goal)
        placed = placement.place_device(anatomy, route.length, devices.PUBLISHED)
        assert anatomy.depth(placed.start) > devices.PUBLISHED.outer_radius
        assert placed.start_depth + placed.stroke >= route.length
        assert placed.working_length > placed.start_depth + placed.stroke
        np.testing.assert_allclose(
            np.linalg.norm(placed.robot - placed.start), placed.working_length
        )


@pytest.mark.parametrize("length", [0.0, 0.05, 0.09, -1.0, math.nan, math.inf, 5.0])
def test_working_length_is_checked(length):
    with pytest.raises(ValueError, match=r"working_length is .*more than.*at most"):
        placement.place_device(arch.load("simple1"), 0.2, devices.PUBLISHED, length)


@pytest.mark.parametrize("task_name", ["type1_bca", "type2_lcca"])
def test_the_head_is_displaced_as_asked(shared_environment, task_name):
    environment = shared_environment(task_name)
    environment.reset()
    task = environment.task
    model = environment.physics.model.ptr
    data = mujoco.MjData(model)
    site = model.site("catheter/head").id
    random = np.random.RandomState(0)
    heads, asked = [], random.uniform(-0.5e-3, 0.5e-3, (6, 3))
    for displacement in [np.zeros(3), *asked]:
        start = task.rollout.start_qpos(model.qpos0[None].copy(), displacement[None])
        data.qpos[:] = start[0]
        mujoco.mj_kinematics(model, data)
        heads.append(data.site_xpos[site].copy())
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, task.scene.placement.quaternion)
    expected = asked @ matrix.reshape(3, 3).T
    # Bent by an angle below 0.02 rad, the tip falls back by a part in ten thousand.
    np.testing.assert_allclose(np.array(heads[1:]) - heads[0], expected, atol=1e-5)


def test_start_takes_a_batch(shared_environment):
    environment = shared_environment("type1_bca")
    environment.reset()
    task, model = environment.task, environment.physics.model.ptr
    displacement = np.random.RandomState(1).uniform(-1e-3, 1e-3, (3, 3))
    rollout = task.rollout
    together = rollout.start_qpos(np.tile(model.qpos0, (3, 1)), displacement)
    for index in range(3):
        alone = rollout.start_qpos(model.qpos0[None].copy(), displacement[[index]])
        np.testing.assert_array_equal(together[[index]], alone)


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


def test_readings_are_copies(shared_environment):
    environment = shared_environment("type1_bca")
    environment.reset()
    state = environment.task.readings
    kept = state._asdict()
    kept = {name: np.array(value) for name, value in kept.items()}
    for _ in range(3):
        environment.step(np.ones(21))
    for name, value in kept.items():
        np.testing.assert_array_equal(getattr(state, name), value, err_msg=name)


def test_insertion_is_what_the_base_has_moved(shared_environment):
    environment = shared_environment("type1_bca")
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


@pytest.mark.parametrize(
    ("scopes", "message"),
    [
        (("guidewire", "robot"), "guidewire/link_0"),
        (("catheter", "arm"), "joint named 'arm/"),
    ],
)
def test_a_model_without_the_names(shared_environment, scopes, message):
    model = shared_environment("type1_bca").physics.model.ptr
    with pytest.raises(ValueError, match=message):
        readings.ModelIndex(model, *scopes)
