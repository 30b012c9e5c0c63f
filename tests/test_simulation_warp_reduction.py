"""Reduction of forces and errors of MuJoCo Warp in small arrays, by hand."""

import numpy as np
import pytest

from cathsim_dmc.simulation.warp import reduction


def added(**changes):
    """`Added` of two worlds with three contacts, of which one is with a sheath."""
    beside = np.array([0, 3])
    given = reduction.Added(
        step=0,
        last=1,
        counts=np.array([1, 2]),
        starts=np.array([0, 1]),
        is_wall=np.array([True, False, True]),
        geom=np.array([[5, 0], [5, 1], [5, 2]]),
        dist=np.array([-1e-3, -9e-3, -2e-3]),
        dim=np.array([3, 3, 4]),
        efc_address=np.array([[0, 1, 2, -1], [0, 1, 2, -1], [3, -1, 4, 5]]),
        force=np.array([[3.0, 0, 4, 9, 9, 9], [7, 7, 7, 2, 1.5, 9]]),
        qpos=np.zeros((2, 3)),
        qvel=np.zeros((2, 2)),
        sensordata=np.array([[1.0, 2, 3, 4], [5, 6, 7, 8]]),
        overflow=np.zeros(2, int),
        beside=beside,
        out=np.full((9 + len(beside), 2), 77.0),
    )
    return given._replace(**changes)


def test_forces_are_reduced_over_the_physics_steps_of_a_control_step():
    given = added()
    for world in range(2):
        reduction.add(world, (), given)
    force, deepest = given.force.copy(), given.dist.copy()
    given.force[:], given.dist[:] = force / 2, deepest / 2
    given = given._replace(step=1)
    for world in range(2):
        reduction.add(world, (), given)
    # Last sum and largest, peaks of both, sums of both, and the largest depth.
    one = [2.5, 2.5, 5.0, 5.0, 7.5, 7.5, 1e-3]
    two = [1.25, 1.25, 2.5, 2.5, 3.75, 3.75, 2e-3]
    np.testing.assert_allclose(given.out[:7].T, [one, two])
    assert not given.out[7:9].any()
    assert given.out[9:].T.tolist() == [[1, 4], [5, 8]]
    # The next control step begins anew.
    given = given._replace(step=0, last=0)
    for world in range(2):
        reduction.add(world, (), given)
    one = [2.5, 2.5, 2.5, 2.5, 2.5, 2.5, 5e-4]
    np.testing.assert_allclose(given.out[:7, 0], one)


def test_two_contacts_of_a_world_are_summed_up():
    given = added(
        last=0, is_wall=np.ones(3, bool), starts=np.array([1, 0]),
        counts=np.array([2, 0]),
    )  # fmt: skip
    given.force[0] = [3.0, 0, 4, 9, 9, 9]
    for world in range(2):
        reduction.add(world, (), given)
    largest = np.sqrt(162.0)
    one = [5 + largest, largest, 5 + largest, largest, 5 + largest, largest, 9e-3]
    np.testing.assert_allclose(given.out[:7].T, [one, [0.0] * 7])


@pytest.mark.parametrize("value", [np.nan, np.inf, 2e10])
@pytest.mark.parametrize("name", ["qpos", "qvel"])
def test_a_world_that_diverges_is_told_from_the_others(name, value):
    given = added(last=0)
    getattr(given, name)[1, -1] = value
    for world in range(2):
        reduction.add(world, (), given)
    assert given.out[7].tolist() == [0, 1]
    getattr(given, name)[1, -1] = 0.0
    for world in range(2):
        reduction.add(world, (), given)
    assert given.out[7].tolist() == [0, 0]


# Bits of OverflowType: NEFC, NJMAX_NNZ, BROADPHASE, NARROWPHASE, CONTACT_MATCH.
@pytest.mark.parametrize("bit", [0, 1, 2, 3, 6])
def test_a_world_without_room_is_lost_for_one_control_step(bit):
    given = added(last=0, overflow=np.array([0, 1 << bit]))
    for expected in ([0, 1], [0, 0]):
        for world in range(2):
            reduction.add(world, (), given)
        assert given.out[8].tolist() == expected
    assert not given.overflow.any()


@pytest.mark.parametrize("bit", [9, 10])  # ITERATIONS, LS_ITERATIONS
def test_a_solver_that_ends_early_lacks_no_room(bit):
    given = added(last=0, overflow=np.array([1 << bit, 0]))
    reduction.add(0, (), given)
    assert given.out[8, 0] == 0 and not given.overflow.any()
