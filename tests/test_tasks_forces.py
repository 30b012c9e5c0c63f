"""Readings of the contact sensor, turned into forces on the wall."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from cathsim_dmc.physics import forces


def sensor_row(contacts, places):
    """Row of the sensor: found, force, dist, pos, normal, tangent for each place."""
    rows = np.zeros((places, 14))
    for index, (force, depth, position, normal, tangent) in enumerate(contacts):
        rows[index] = [len(contacts), *force, -depth, *position, *normal, *tangent]
    return rows.ravel()


X, Y, Z = np.eye(3)


def test_one_contact():
    """The sensor's force acts on the device along the normal out of the wall."""
    row = sensor_row([((3.0, 0.5, -0.2), 1e-4, (0.1, 0.2, 0.3), Z, X)], 4)
    contacts = forces.Contacts.from_sensor(row)
    assert contacts.present.tolist() == [True, False, False, False]
    # z × x = y is the second tangent; the wall feels the opposite of the device.
    np.testing.assert_allclose(contacts.force[0], -(3.0 * Z + 0.5 * X - 0.2 * Y))
    assert contacts.magnitude[0] == pytest.approx(np.sqrt(9 + 0.25 + 0.04))
    np.testing.assert_allclose(contacts.position[0], (0.1, 0.2, 0.3))
    assert contacts.penetration[0] == pytest.approx(1e-4)
    assert contacts.found == 1


def test_empty_places_hold_zeros():
    contacts = forces.Contacts.from_sensor(np.zeros(5 * 14))
    assert not contacts.present.any() and contacts.found == 0
    for values in (contacts.force, contacts.magnitude, contacts.penetration):
        assert not values.any()


def test_overflow_is_told():
    row = sensor_row([((1.0, 0, 0), 0, (0, 0, 0), Z, X)] * 2, 2)
    row.reshape(2, 14)[:, 0] = 7
    assert forces.Contacts.from_sensor(row).found == 7


NUMBERS = st.floats(-5, 5, allow_subnormal=False)


@given(arrays.arrays(float, (6, 3), elements=NUMBERS))
def test_magnitude_is_the_norm_of_the_force(local):
    row = sensor_row([(force, 0.0, (0, 0, 0), Y, Z) for force in local], 6)
    contacts = forces.Contacts.from_sensor(row)
    np.testing.assert_allclose(
        np.linalg.norm(contacts.force, axis=-1), contacts.magnitude, atol=1e-12
    )


@given(arrays.arrays(float, (3, 5, 4), elements=st.floats(1e-9, 5)))
def test_sum_and_peaks(magnitude):
    rows = np.zeros((*magnitude.shape, forces.CONTACT_SIZE))
    rows[..., 0], rows[..., 1], rows[1, 2, 3, 4] = 4, magnitude, -2e-4
    wall, depth = forces.wall_force(rows.reshape(3, 5, -1))
    assert wall.sum.shape == (3,) and depth.tolist() == [0.0, 2e-4, 0.0]
    np.testing.assert_allclose(wall.sum, magnitude[:, -1].sum(-1))
    np.testing.assert_array_equal(wall.max, magnitude[:, -1].max(-1))
    np.testing.assert_allclose(wall.peak_sum, magnitude.sum(-1).max(-1))
    np.testing.assert_array_equal(wall.peak_max, magnitude.max((-1, -2)))
    assert (wall.peak_sum >= wall.sum).all()
    assert (wall.peak_max >= wall.max).all() and (wall.sum >= wall.max - 1e-12).all()


@pytest.mark.parametrize("step", [0, 4])
def test_a_force_that_is_no_number_is_not_lost(step):
    rows = np.zeros((1, 5, 3 * forces.CONTACT_SIZE))
    rows.reshape(1, 5, 3, -1)[..., :2] = 3, 1.0
    rows[0, step, 1] = np.nan
    wall, _ = forces.wall_force(rows)
    assert np.isnan(wall.peak_max) and np.isnan(wall.peak_sum)
    assert np.isnan([wall.max, wall.sum]).all() == (step == 4)
