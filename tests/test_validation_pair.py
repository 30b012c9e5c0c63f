"""Coaxial devices against theory; `cathsim validate pair` runs all of it."""

import numpy as np
import pytest

from cathsim_dmc.entities.devices import Discretisation, get
from cathsim_dmc.validation import pair, pressed, rod, two_rods
from cathsim_dmc.validation.rig import Rig


def test_a_protruding_wire_bends_as_two_sections():
    options = {"gaps": (0.0, 0.05)}
    bent = rod.cantilevers(pair.PAIR, pair.END_ANGLES, **options)
    assert max(one.deviation for one in bent) < 0.01
    lengths, bending, _ = Rig(pair.PAIR, straight=True, **options).sections
    assert lengths[-2:] == pytest.approx([0.02, 0.03])
    wire = get(pair.PAIR[0])
    assert bending[-1] == wire.tip.bending_stiffness
    assert bending[-2] == wire.shaft.bending_stiffness
    assert bending[0] == pytest.approx(197.3e-6, rel=1e-3)


def test_the_free_end_moves_as_smoothly_as_the_curve():
    check = pair.smoothness()
    assert check.passed and check.value > 0.5


def test_what_is_pressed_on_the_wall_lies_still():
    """At any load; under a law that rises to an edge, it rattles."""
    edge = (-1 / 0.003**2, -2 / 0.003), (0.7, 0.999, 0.0003, 0.5, 1)
    depth = 0.0
    for load in pressed.LOADS:
        deeper, ripple = pressed.pressed(load)
        assert ripple < 1e-6 and deeper > depth
        depth = deeper
        rattles = pressed.pressed(load, *edge)[1] > 1e-4
        assert rattles == (load >= 1.0)
    assert 0.1e-3 < depth < 0.2e-3


def test_a_turned_shape_is_the_shape_turned():
    """Hinges in one order, with components for angles, were off by 19 % and 31°."""
    end, curve, direction = pair.turned(
        ("wire_035_amplatz", "diagnostic_5f_simmons"), (0.012, 0.0)
    )
    assert end < 0.001 and direction < 0.001
    assert 0.001 < curve < 0.01


def test_two_rods_in_half_a_circle_are_those_of_the_reference():
    case = two_rods.CASES[2]
    found, expected, _ = two_rods.in_half_circle(*case)
    assert np.linalg.norm(found.end - expected.end) < 0.01 * 0.35
    # The bend turns the catheter's end by 42°.
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=0.05)
    assert np.abs(expected.rotation - case[2]).max() > 0.7


def test_a_wire_in_a_bend_is_pushed_with_the_derivative_of_the_energy():
    """A moment M does the work M²/2 (1/EI - 1/EI') where a stiffer piece comes."""
    names, gaps = two_rods.SLIDES[2]
    wire, catheter = (get(name) for name in names)
    alone = catheter.tip.bending_stiffness
    both = alone + wire.tip.bending_stiffness
    # The end lies in the arc of 6 mm, the wire's shaft in the one of 20 mm.
    expected = (alone / 6e-3) ** 2 / 2 * (1 / alone - 1 / both)
    shaft = alone + wire.shaft.bending_stiffness
    expected += (alone / 20e-3) ** 2 / 2 * (1 / both - 1 / shaft)
    found = two_rods.simulate(names, gaps, (0.0, 0.0), duration=6.0)
    assert found.force is not None
    np.testing.assert_allclose(found.force, [expected, -expected], rtol=0.01)


def test_a_bend_turns_neither_motors_nor_shapes():
    """The frames of the links are turned by up to 1.4°."""
    lengths = Discretisation().link_lengths(get("steerable_5f"))
    for plane in np.radians([30, 45, 60]):
        motors, shapes = pair.twists(lengths, 0.06, plane)
        assert abs(motors) < 1e-6 and abs(shapes) < 1e-6


def test_readings_list_hinges_about_x_before_those_about_y():
    rig = Rig()
    rig.compile()
    for number, bend in enumerate(rig.catheter.bends):
        rig.data.joint(bend.full_identifier).qpos = number + 1.0
    order = [rig.qpos(joint.name) for joint in rig.catheter.joints]
    assert order[2:] == list(range(1, len(rig.catheter.bends) + 1))
