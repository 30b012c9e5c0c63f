"""Containment: known places in and out of an arch's lumen and of the sheath."""

import numpy as np
import pytest
from containment import Containment, points_along
from hypothesis import given
from hypothesis import strategies as st

from cathsim_dmc.anatomy import phantoms

RADIUS, BORE = 0.8e-3, 1.15e-3


@pytest.fixture(scope="module")
def containment():
    anatomy = phantoms.load("simple1")
    assert np.allclose(anatomy.inlet.direction, [0, 0, 1])
    return Containment(anatomy, RADIUS, BORE, np.array([0.0, 0.0, 1.0]))


def test_points_along_are_no_further_apart_than_asked():
    line = np.array([[0, 0, 0], [0, 0, 10e-3], [3e-3, 0, 10e-3]])
    points = points_along(np.stack([line, line + 1]), 1e-3)
    gaps = np.linalg.norm(np.diff(points, axis=-2), axis=-1)
    assert points.shape == (2, 14, 3)
    assert gaps.max() <= 1e-3 + 1e-12
    np.testing.assert_allclose(points[0, [0, 10, -1]], line, atol=1e-15)


def test_excess_in_the_lumen_is_measured_from_its_surface(containment):
    inlet = containment.anatomy.inlet
    for gap in (3e-3, 0.0, -0.5e-3, -3e-3):
        point = [inlet.radius - RADIUS - gap, 0, 20e-3]
        assert containment.excess(point) == pytest.approx(-gap, abs=2e-4)


@given(x=st.floats(-2e-3, 2e-3), y=st.floats(-2e-3, 2e-3), z=st.floats(-0.2, -4e-3))
def test_excess_in_the_sheath_is_that_of_a_round_bore(containment, x, y, z):
    beyond = np.hypot(x, y) + RADIUS - BORE
    assert containment.excess([x, y, z]) == pytest.approx(beyond, abs=1e-12)


def test_what_is_in_neither_stands_out(containment):
    bent = np.array([[0, 0, -50e-3], [0, 0, 5e-3], [0, 40e-3, 25e-3]])
    assert containment.largest_excess(bent) > 10e-3
    assert containment.excess([0, 5e-3, -10e-3]) > 4e-3
