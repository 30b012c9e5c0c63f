"""Damping of the device as stated, turning in a bend, short spans."""

import mujoco
import numpy as np
import pytest
from conftest import slow

from cathsim_dmc import suite
from cathsim_dmc.physics.blood import BLOOD_VISCOSITY, StillBlood
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.validation import damping
from cathsim_dmc.validation.checks import Check
from cathsim_dmc.validation.rig import Rig


@pytest.mark.parametrize("blood", [True, False])
def test_a_released_device_swings_as_the_beam_with_stated_losses(blood):
    mine, theirs, decay, expected = damping.release(blood=blood)
    assert mine == pytest.approx(theirs, rel=damping.RELEASE_BOUND / 100)
    assert decay == pytest.approx(expected, rel=damping.RELEASE_BOUND / 100)


def test_a_swing_has_the_frequency_and_decay_of_its_curve():
    time = np.arange(0.0, 3.0, 1e-3)
    curve = np.exp(-0.7 * time) * np.cos(2 * np.pi * 1.5 * time)
    frequency, decay = damping._swing(time, curve)
    assert frequency == pytest.approx(1.5, rel=1e-3)
    assert decay == pytest.approx(0.7, rel=0.01)


def test_three_points_bend_a_device_as_a_beam():
    found = [damping.three_point(0.1, damping.SHORT_LINK, on) for on in (True, False)]
    np.testing.assert_allclose(found, 1.0, rtol=damping.SPAN_BOUND / 100)


def off(lag, expected):
    """Whether `cathsim validate rod` refuses a lag."""
    bound = damping.SPIN_BOUND
    return not Check.deviation("lag", lag, expected, bound, "rad").passed


@pytest.mark.parametrize("speed", [1.0, 3.14])
def test_a_device_turned_in_a_bend_lags_by_the_losses_of_its_material(speed):
    assert not off(*damping.spin(speed))


@pytest.mark.parametrize("loss", [1.1, *slow(0.9)])
def test_a_damper_that_is_wrong_by_a_tenth_is_found(loss):
    lag, expected = damping.spin(1.0, loss=loss)
    assert lag / expected == pytest.approx(loss, abs=0.03)
    assert off(lag, expected)


def test_drag_is_that_of_the_correlation_against_the_velocity_of_the_blood():
    rig = Rig("diagnostic_5f_j", rotation=True)
    blood = StillBlood()
    rig.compile(blood)
    model, data, rng = rig.model, rig.data, np.random.default_rng(1)
    data.qpos[:], data.qvel[:] = rng.normal(0, 0.1, (2, model.nv))
    flow = np.array([0.3, -0.2, 0.5])
    blood.world.parameters.velocity[0] = flow
    mujoco.mj_forward(model, data)
    found = data.qfrc_passive - data.qfrc_spring - data.qfrc_damper
    expected = np.zeros(model.nv)
    first = rig.tip_body + 1 - len(rig.lengths)
    for body, length in enumerate(rig.lengths, first):
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
        axis = data.xmat[body].reshape(3, 3)[:, 2]
        across = flow - jacobian @ data.qvel
        across -= (across @ axis) * axis
        speed = np.linalg.norm(across)
        force = length * damping.drag(speed, 2 * rig.device.outer_radius)
        expected += jacobian.T @ (force * across / speed)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_blood_is_still_in_every_simulation_of_a_task():
    options = {"randomisation": {"viscosity": (0.5, 2.0)}}
    batch = BatchSimulation(suite.make_task("simple1_bca", **options), 2, seeds=0)
    batch.reset()
    blood = batch.rollout.effects[0].world.parameters
    one, two = blood.viscosity / BLOOD_VISCOSITY
    assert 0.5 <= min(one, two) < max(one, two) <= 2.0
    assert not any(each.any() for each in blood[2:])
