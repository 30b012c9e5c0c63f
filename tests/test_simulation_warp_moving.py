"""Walls that move in MuJoCo Warp in small arrays, against MuJoCo and by hand."""

import numpy as np
import pytest
import warp_arrays

from cathsim_dmc.laws import motion
from cathsim_dmc.simulation.warp import moving_kernels


def breathing(shift, growth=0.0):
    """`Vessels` at 3 s, 4 s and 5 s, and a lattice that breathing shifts as a whole."""
    parameters = motion.MotionParameters(
        heart=np.zeros(warp_arrays.WORLDS),
        breathing=np.array([0.5, 0.8, 0.7]),
        distensibility=np.array([0.02, 0.01, 0.03]),
        rate=np.ones(warp_arrays.WORLDS),
        phase=np.zeros(warp_arrays.WORLDS),
        wave_speed=np.ones(warp_arrays.WORLDS),
        breath_rate=np.array([0.3, 0.2, 0.1]),
        breath_phase=np.array([0.1, 0.0, 0.2]),
    )
    node = np.array([0.0, 0, 0, *shift, growth, 0])
    lattice = np.concatenate([(-20, -20, -20, 40, 2, 2, 2), np.tile(node, 8)])
    boxes = moving_kernels.Boxes(
        places=np.zeros((warp_arrays.WORLDS, 1, 3)),
        turns=np.tile(np.eye(3), (warp_arrays.WORLDS, 1, 1, 1)),
        sizes=np.zeros((warp_arrays.WORLDS, 3)),
    )
    return moving_kernels.Vessels(np.array([3.0, 4.0, 5.0]), parameters, boxes), lattice


def test_impedance_of_a_contact_is_that_of_mujoco():
    model, worlds = warp_arrays.scene()
    seen = 0
    for data in worlds:
        for contact in data.contact:
            impedance = data.efc_KBIP[contact.efc_address, 2]
            found = moving_kernels._impedance(contact.solimp, contact.dist)
            assert found == pytest.approx(impedance, rel=1e-9)
            seen += 1
    solimp = np.array([0.1, 0.9, 0.01, 0.3, 2.0])
    half = [moving_kernels._impedance(solimp, depth) for depth in (2e-3, -6e-3, 0.02)]
    expected = [0.1 + 0.8 * 0.2**2 / 0.3, 0.1 + 0.8 * (1 - 0.4**2 / 0.7), 0.9]
    np.testing.assert_allclose(half, expected)
    assert seen


def test_a_box_around_a_sheath_is_that_of_its_world():
    boxes = moving_kernels.Boxes(
        places=np.array([[[0.0, 0, 0]], [[1.0, 0, 0]]]),
        turns=np.array([[np.eye(3)], [[[0, 0, 1], [1, 0, 0], [0, 1, 0]]]], float),
        sizes=np.array([[1.0, 2, 3], [1.0, 2, 3]]),
    )
    inside = moving_kernels._is_inside
    assert inside(boxes, 0, (0.9, 1.9, 2.9)) and not inside(boxes, 0, (1.1, 0.0, 0.0))
    assert not inside(boxes, 0, (0.0, 2.1, 0.0))
    assert not inside(boxes, 0, (0.0, 0.0, -3.1))
    # The axes of the second box point along y, z and x.
    assert inside(boxes, 1, (3.9, 0.9, 1.9)) and not inside(boxes, 1, (0.0, 1.1, 0.0))


def test_a_link_meets_the_wall_where_it_has_moved():
    """The bore of the second world is shifted along its axis, over the link."""
    model, worlds = warp_arrays.scene()
    shift = np.array([0.0, 0.03, 6.0])
    vessels, lattice = breathing(shift)
    given = warp_arrays.scene_of(model, worlds)._replace(
        walls=warp_arrays.walls_of(lattice)
    )
    given.walls.turns[1, 0] = np.eye(3)
    course = motion.nth_course(vessels.parameters, 1, 4.0)
    samples, planes, rows = moving_kernels.SCRATCH
    scratch = np.empty(samples), np.empty(planes), np.empty(rows)
    geom = int(given.links.geoms[0])
    radius = given.fields.geom_size[1, geom, 0]
    # At rest the bore ends 1 m before the link.
    local = np.array([0.6 - radius + 0.01, 0.0, 6.0]) + (
        0.0,
        0.03 * course.breathing,
        0,
    )
    given.motion.geom_xpos[1, geom] = given.walls.places[1, 0] + local - (0, 0, 2.5)
    given.motion.geom_xmat[1, geom] = np.eye(3)
    assert course.breathing * shift[2] > 1.5
    moving = moving_kernels.MovingScene(given, vessels)

    def found():
        given.found.number[2] = 9
        moving_kernels.find_moving(2, scratch, moving)
        return given.found.rows[2, : given.found.number[2]]

    for row in found():
        assert row[0] == pytest.approx(-0.01, abs=1e-6)
        np.testing.assert_allclose(row[4:7], [1, 0, 0], atol=1e-6)
    assert len(found()) >= 1
    # In the sheath, only the wall at rest counts.
    vessels.boxes.places[1, 0] = given.motion.geom_xpos[1, geom]
    vessels.boxes.sizes[1] = 0.1
    assert len(found()) == 0
    vessels.boxes.sizes[:] = np.array([[0.1], [0.0], [0.1]])
    assert len(found()) >= 1
    given.motion.geom_xmat[1, geom] = np.nan
    assert len(found()) == 0
    # The wall of the first world is at rest.
    radius = given.fields.geom_size[0, geom, 0]
    local = np.array([0.5 - radius + 0.01, 0.0, 0.0])
    given.motion.geom_xpos[0, geom] = given.walls.places[0, 0] + local
    given.motion.geom_xmat[0, geom] = np.eye(3)
    moving_kernels.find_moving(0, scratch, moving)
    assert given.found.number[0] >= 1
    assert given.found.rows[0, 0, 0] == pytest.approx(-0.01, abs=1e-6)


def test_contacts_are_carried_by_the_wall_of_their_world():
    """One contact of the first world, whose wall is at rest, and three of the second.

    The last of these is with a geom that carries no wall.
    """
    model, worlds = warp_arrays.scene()
    shift = np.array([0.02, -0.01, 0.03])
    vessels, lattice = breathing(shift, growth=0.5)
    given = warp_arrays.scene_of(model, worlds)
    links, step = given.links, 0.004
    carrier = int(links.carriers[0])
    out = warp_arrays.written(links, given.fields, None, None, room=4).out
    axes, _ = np.linalg.qr(np.random.RandomState(0).normal(size=(3, 3)))
    out.frame[:], out.dist[:] = axes, -4e-3
    out.dim[:], out.geom[:] = [3, 3, 4, 3], [[5, carrier]] * 3 + [[5, carrier + 1]]
    out.solref[:], out.solimp[:] = [-900.0, -70.0], [0.5, 0.8, 0.01, 0.5, 2]
    out.efc_address[:] = [[0, 1, 2, -1], [1, 2, 3, -1], [5, -1, 9, 4], [6, 7, 0, -1]]
    velocity, reference = np.ones((3, 8)), np.ones((3, 8))
    samples, planes, rows = moving_kernels.SCRATCH
    carried = moving_kernels.Carried(
        links=links,
        walls=warp_arrays.walls_of(lattice),
        vessels=vessels,
        contacts=out,
        counts=np.array([1, 3, 0]),
        starts=np.array([0, 1, 4]),
        timestep=np.array([step]),
        velocity=velocity,
        reference=reference,
    )
    for world in range(warp_arrays.WORLDS):
        scratch = np.empty(samples), np.empty(planes), np.empty(rows)
        moving_kernels.carry(world, scratch, carried)
    assert (velocity[0] == 1).all() and (reference[0] == 1).all()
    course = motion.nth_course(vessels.parameters, 1, 4.0 + step / 2)
    there = np.empty(motion.WARP)
    motion.warp(lattice, course, out.pos[1], np.empty((motion.VALUES, 4)), there)
    # A wall that widens moves along the normal from the device into the wall.
    assert there[19] != 0
    speeds = axes @ (course.breathing_rate * shift + there[19] * axes[0])
    impedance = 0.5 + 0.3 * 0.4**2 / 0.5
    damping, spring = 70 / 0.8, 900 / 0.8**2 * impedance
    normal = (damping + step * spring) / (1 + step * (damping + step * spring))
    rates = np.array([normal, *[damping / (1 + step * damping)] * 2])
    expected = np.zeros((2, 8))
    expected[0, 1:4], expected[1, 1:4] = speeds, -speeds * rates
    expected[0, 5], expected[1, 5] = speeds[0], -speeds[0] * rates[0]
    np.testing.assert_allclose(velocity[1] - 1, expected[0], atol=1e-12)
    np.testing.assert_allclose(reference[1] - 1, expected[1], atol=1e-12)
