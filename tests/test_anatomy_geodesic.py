"""Shortest ways through a lumen."""

import numpy as np
import pytest

from cathsim_dmc.anatomy.geodesic import LumenDistance

RADIUS = 5e-3


def hook(points):
    """Depth in a U of two parallel tubes, 14 mm apart, joined at the bottom."""
    x, y, z = np.asarray(points).T
    legs = np.where(z > 0, np.hypot(np.abs(x) - 7e-3, y), np.inf)
    bow = np.hypot(np.hypot(x, z) - 7e-3, y)
    return RADIUS - np.minimum(legs, np.where(z > 0, np.inf, bow))


BOUNDS = np.array([[-12e-3, -5e-3, -12e-3], [12e-3, 5e-3, 40e-3]])


@pytest.fixture(scope="module")
def ways():
    return LumenDistance(hook, BOUNDS, np.array([7e-3, 0, 38e-3]), [-7e-3, 0, 38e-3])


@pytest.mark.parametrize("height", [5e-3, 20e-3, 35e-3])
def test_the_other_leg_is_as_far_as_the_way_round(ways, height):
    """Through the wall it is 14 mm; the shortest way hugs the inside of the bend."""
    point = np.array([-7e-3, 0, height])
    inner = 2 * np.hypot(0, height) + np.pi * 2e-3
    outer = 2 * height + np.pi * 7e-3 + 0.038 - height
    assert ways(point) > 0.038 + inner - height - 2e-3
    assert ways(point) < 1.1 * outer


def test_straight_ways_along_the_lattice_are_exact(ways):
    z = np.array([10e-3, 20e-3, 30e-3])
    points = np.stack([np.full(3, 7e-3), np.zeros(3), z], -1)
    np.testing.assert_allclose(ways(points), 38e-3 - z, atol=1.5e-3)
    assert ways(points.reshape(3, 1, 3)).shape == (3, 1)


def test_many_points_are_many_single_ones(ways):
    points = np.random.RandomState(0).uniform(*BOUNDS, (50, 3))
    assert (ways(points) == [ways(point) for point in points]).all()


def test_a_narrow_lumen_refines_the_lattice():
    def narrow(points):
        return 0.6e-3 - np.hypot(*np.asarray(points).T[:2])

    bounds = np.array([[-1e-3, -1e-3, 0], [1e-3, 1e-3, 30e-3]])
    ways = LumenDistance(narrow, bounds, np.array([0, 0, 30e-3]), np.zeros(3))
    assert ways(np.zeros(3)) == pytest.approx(30e-3, rel=0.1)


def test_a_closed_lumen_is_refused():
    def two(points):
        x, y, z = np.asarray(points).T
        return np.minimum(3e-3 - np.hypot(x, y), np.abs(z - 15e-3) - 3e-3)

    bounds = np.array([[-3e-3, -3e-3, 0], [3e-3, 3e-3, 30e-3]])
    with pytest.raises(ValueError, match="no way inside the lumen"):
        LumenDistance(two, bounds, np.array([0, 0, 30e-3]), np.zeros(3))
