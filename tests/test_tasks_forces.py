"""Readings of the contact sensor, turned into forces on the wall."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from cathsim_dmc.physics import forces, forces_loops


def test_overflow_is_told():
    rows = np.zeros((2, 14))
    rows[:, 0] = 7
    assert forces.Contacts.from_sensor(rows.ravel()).found == 7


@given(arrays.arrays(float, (3, 5, 4), elements=st.floats(1e-9, 5)))
def test_sums_peaks_and_means(magnitude):
    rows = np.zeros((*magnitude.shape, forces.CONTACT_SIZE))
    rows[..., 0], rows[..., 1], rows[1, 2, 3, 4] = 4, magnitude, -2e-4
    wall, depth = forces.wall_force(rows.reshape(3, 5, -1))
    assert wall.sum.shape == (3,) and depth.tolist() == [0.0, 2e-4, 0.0]
    np.testing.assert_allclose(wall.sum, magnitude[:, -1].sum(-1))
    np.testing.assert_array_equal(wall.max, magnitude[:, -1].max(-1))
    np.testing.assert_allclose(wall.peak_sum, magnitude.sum(-1).max(-1))
    np.testing.assert_array_equal(wall.peak_max, magnitude.max((-1, -2)))
    np.testing.assert_allclose(wall.mean_sum, magnitude.sum(-1).mean(-1))
    np.testing.assert_allclose(wall.mean_max, magnitude.max(-1).mean(-1))
    assert (wall.peak_sum >= wall.sum).all()
    assert (wall.peak_max >= wall.max).all() and (wall.sum >= wall.max - 1e-12).all()


@given(arrays.arrays(float, (3, 4, 2), elements=st.floats(0.0, 1.0)))
def test_the_work_on_the_wall_is_that_of_springs(drawn):
    """½ f r of each contact; one that only keeps a link near the wall does none."""
    force, way = drawn[..., 0], 1e-3 * (drawn[..., 1] - 0.2)
    rows = np.zeros((*force.shape, forces.CONTACT_SIZE))
    rows[..., 0], rows[..., 1], rows[..., 4] = 4, force, -way
    deepest, work = forces_loops.pressed(rows.reshape(3, -1), forces.CONTACT_SIZE)
    depth = np.maximum(way, 0.0)
    np.testing.assert_allclose(work, 0.5 * (force * depth).sum(axis=1), atol=1e-15)
    np.testing.assert_array_equal(deepest, depth.max(axis=1))


@pytest.mark.parametrize("step", [0, 4])
def test_a_force_that_is_no_number_is_not_lost(step):
    rows = np.zeros((1, 5, 3 * forces.CONTACT_SIZE))
    rows.reshape(1, 5, 3, -1)[..., :2] = 3, 1.0
    rows[0, step, 1] = np.nan
    wall, _ = forces.wall_force(rows)
    lasting = wall.peak_max, wall.peak_sum, wall.mean_max, wall.mean_sum
    assert np.isnan(lasting).all()
    assert np.isnan([wall.max, wall.sum]).all() == (step == 4)
