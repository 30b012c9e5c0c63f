"""Wall, sensors and arena of a compiled task."""

import mujoco
import numpy as np
import pytest
from dm_control import mjcf

from cathsim_dmc.entities import contact
from cathsim_dmc.entities.arena import BLOOD_DENSITY, GRAVITY, AngiographyArena
from cathsim_dmc.laws import sheath
from cathsim_dmc.physics import held


@pytest.fixture(scope="module")
def environment(shared_environment):
    return shared_environment("type1_bca")


@pytest.fixture(scope="module")
def model(environment):
    return environment.physics.model.ptr


@pytest.fixture(scope="module")
def pressed(environment, reseed):
    """Data of every substep that has wall contacts while the device is pushed in.

    Yields a list of (sensordata, contacts of the wall as mj_contactForce gives them).
    Built by stepping MuJoCo alone, so that nothing of the task stands in between.
    """
    reseed(environment, 0)
    model, task = environment.physics.model.ptr, environment.task
    data = mujoco.MjData(model)
    data.qpos[:] = environment.physics.data.qpos
    mujoco.mj_forward(model, data)
    # A tip that shakes soon gets stuck on the wall, and is pushed on at full force.
    shake = np.random.RandomState(0).choice([-1.0, 1.0], 21)
    data.ctrl[20] = 1.0
    device, steps = environment.task.rollout._devices, []
    hinges = held.fields_of(lambda name: getattr(model, name))
    for control in range(130):
        # The links that leave the sheath are free.
        insertion = data.qpos[environment.task.rollout.index.insertion_qpos]
        one, free = device._sheathed, sheath.Hinges._make(device._free[0])
        out = np.empty_like(one.out[0])
        sheath.hold(one.joints, one.depths[0], insertion, free, hinges, out)
        data.ctrl[:20] = shake[:20] * (-1) ** control
        for _ in range(task.substeps):
            mujoco.mj_step(model, data)
            contacts = wall_contacts(model, data)
            if contacts:
                steps.append((data.sensordata.copy(), contacts))
    forces = [np.linalg.norm(force) for _, each in steps for force, _, _ in each]
    assert len(steps) > 80 and max(forces) > 0.05
    assert max(len(each) for _, each in steps) > 5
    return steps


def wall_contacts(model, data):
    """(force on the wall in the world frame, position, depth) of each wall contact."""
    result = []
    for index in range(data.ncon):
        contact = data.contact[index]
        names = [model.geom(geom).name for geom in contact.geom]
        if not any(name == "wall" for name in names):
            continue
        local = np.zeros(6)
        mujoco.mj_contactForce(model, data, index, local)
        # The frame's normal points from geom 0 to geom 1: force on geom 1.
        force = contact.frame.reshape(3, 3).T @ local[:3]
        if names[0] == "wall":
            force = -force
        result.append((force, contact.pos.copy(), -contact.dist))
    return result


def sorted_by_position(positions, *others):
    order = np.lexsort(np.asarray(positions).round(9).T)
    return [np.asarray(values)[order] for values in (positions, *others)]


# Sensors.


def test_wall_sensor_equals_the_contact_forces_of_the_same_substep(
    environment, pressed
):
    """Fresh: the readings are those of this substep's solution, not of the last."""
    layout = environment.task.rollout.index
    for sensordata, expected in pressed:
        contacts = layout.contacts(sensordata)
        here = contacts.present
        # A contact without a constraint row, just in touch, may miss in either list.
        assert here.sum() == len(expected)
        positions, forces, depths = sorted_by_position(
            contacts.position[here], contacts.force[here], contacts.penetration[here]
        )
        true_positions, true_forces, true_depths = sorted_by_position(
            [each[1] for each in expected],
            [each[0] for each in expected],
            [each[2] for each in expected],
        )
        np.testing.assert_allclose(positions, true_positions, atol=1e-9)
        np.testing.assert_allclose(depths, true_depths, atol=1e-9)
        np.testing.assert_allclose(forces, true_forces, atol=1e-9, rtol=1e-6)
        total = np.linalg.norm(true_forces, axis=1).sum()
        assert contacts.magnitude.sum() == pytest.approx(total, rel=1e-6, abs=1e-9)
        assert contacts.found == len(expected)


def test_load_cell_equals_the_sum_of_the_contact_forces(environment, pressed):
    """Newton's third law: the wall passes on what the device does to it."""
    layout = environment.task.rollout.index
    for sensordata, expected in pressed:
        total = sum(force for force, _, _ in expected)
        cell = -sensordata[layout.load_cell]
        error = np.linalg.norm(cell - total)
        assert error <= 1e-6 + 0.01 * np.linalg.norm(total)


def test_readings_of_the_task_are_those_sensors(environment, reseed):
    reseed(environment, 0)
    action = np.ones(21)
    for _ in range(40):
        environment.step(action)
        task = environment.task
        contacts = task.contacts(environment.physics)
        assert task.wall_force.sum == pytest.approx(contacts.magnitude.sum())
        assert task.wall_force.max == pytest.approx(contacts.magnitude.max())
        assert task.wall_force.peak_sum >= task.wall_force.sum
        assert task.wall_force.peak_max >= task.wall_force.max
    assert task.wall_force.sum > 0


# Wall.


def test_the_wall_is_one_geom_that_touches_the_device_only(model):
    wall = model.geom("wall")
    assert wall.contype[0] == 1 and wall.conaffinity[0] == 0
    assert wall.condim[0] == 3
    # The contact surface is the wall itself.
    assert wall.margin[0] == 0 and wall.gap[0] == 0
    lumen = model.geom("phantom/lumen")
    assert lumen.contype[0] == 0 and lumen.conaffinity[0] == 0
    for geom in (wall, model.geom("catheter/link_3")):
        np.testing.assert_array_equal(geom.solref, contact.CONTACT_SOLREF)
        np.testing.assert_array_equal(geom.solimp, contact.CONTACT_SOLIMP)
        assert geom.friction[0] == contact.FRICTION


def test_contacts_lie_on_the_wall_of_the_anatomy(environment, pressed):
    """MuJoCo puts a contact halfway into the overlap of link and wall."""
    anatomy = environment.task.scene.anatomy
    contacts = [each for _, found in pressed for each in found]
    depths = anatomy.lumen([position for _, position, _ in contacts])
    error = np.abs(depths + [depth / 2 for *_, depth in contacts])
    # In a narrow dead end the planes that stand for the wall meet it at an angle.
    assert np.median(error) < 0.02e-3 and error.max() < 0.4e-3


@pytest.mark.parametrize("rotation", [False, True])
def test_every_element_has_a_name(shared_environment, rotation):
    environment = shared_environment("type1_bca", rotation=rotation)
    # PyMJCF calls what has no name "//unnamed_geom_3".
    assert b"unnamed" not in environment.physics.model.ptr.names


@pytest.mark.parametrize("density", [900.0, BLOOD_DENSITY, 1500.0, 6450.0])
def test_gravity_pulls_to_the_back_less_the_buoyancy(density):
    gravity = AngiographyArena(device_density=density).mjcf_model.option.gravity
    # What is lighter than blood is taken to float.
    expected = GRAVITY * max(0.0, 1 - BLOOD_DENSITY / density)
    np.testing.assert_allclose(gravity, [0, expected, 0])


def test_camera_looks_at_its_target():
    arena = AngiographyArena()
    target = np.array([0.1, 0.2, 0.3])
    arena.add_camera("view", target, 0.5, (1, 0, 0, 0, 0, 1))
    model = mjcf.Physics.from_mjcf_model(arena.mjcf_model).model.ptr
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = model.camera("view").id
    # A camera looks along its -z axis.
    axis = -data.cam_xmat[camera].reshape(3, 3)[:, 2]
    np.testing.assert_allclose(data.cam_xpos[camera] + 0.5 * axis, target, atol=1e-9)
