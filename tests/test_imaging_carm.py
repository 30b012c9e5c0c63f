import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_imaging_thickness import unproject

from cathsim_dmc.imaging.carm import CArm

angles = st.floats(-3.0, 3.0)
tilts = st.floats(-1.4, 1.4)
coordinates = st.tuples(*[st.floats(-0.15, 0.15)] * 3)


def test_ap_image_has_the_patients_left_on_the_right_and_the_head_up():
    carm = CArm.view("AP")
    middle, _ = carm.project([0.0, 0.0, 0.0])
    np.testing.assert_allclose(middle, [63.5, 63.5])
    left, _ = carm.project([0.05, 0.0, 0.0])
    head, _ = carm.project([0.0, 0.0, 0.05])
    assert left[0] > middle[0] and left[1] == pytest.approx(middle[1])
    assert head[1] < middle[1] and head[0] == pytest.approx(middle[0])
    # The detector is in front of the chest: the front (-y) is further from the source.
    _, depth = carm.project([[0.0, -0.05, 0.0], [0.0, 0.05, 0.0]])
    np.testing.assert_allclose(depth, [0.80, 0.70])


def test_signs_of_the_angles_follow_dicom():
    # LAO: detector on the patient's left; cranial: detector towards the head.
    assert CArm.view("LAO45").axes[2] @ [1.0, 0.0, 0.0] > 0.7
    assert CArm.view("RAO30").axes[2] @ [1.0, 0.0, 0.0] == pytest.approx(-0.5)
    assert CArm(secondary=0.3).axes[2] @ [0.0, 0.0, 1.0] > 0.0
    np.testing.assert_allclose(
        CArm.view("LATERAL").axes, [[0, 1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-15
    )


@given(angles, tilts, coordinates)
def test_axes_are_a_rotation_and_the_projection_can_be_inverted(
    primary, secondary, point
):
    carm = CArm(primary, secondary, 1.3, isocentre=(0.01, -0.02, 0.03))
    np.testing.assert_allclose(carm.axes @ carm.axes.T, np.eye(3), atol=1e-12)
    right, down, beam = carm.axes
    # Not mirrored: the observer looks against the beam, as x right, y down demand.
    np.testing.assert_allclose(np.cross(right, down), -beam, atol=1e-12)
    pixel, depth = carm.project(point)
    np.testing.assert_allclose(unproject(carm, pixel, depth), point, atol=1e-12)


def test_points_behind_the_source_have_no_pixel():
    carm = CArm.view("AP")
    pixels, depth = carm.project([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    assert np.isnan(pixels[0]).all() and depth[0] < 0.0
    assert np.isfinite(pixels[1]).all()


def test_the_matrix_of_an_oblong_image_is_its_projection():
    arm = CArm(0.4, -0.2, 1.5, isocentre=(0.01, -0.02, 0.03), resolution=(40, 60))
    points = np.random.RandomState(0).uniform(-0.1, 0.1, (20, 3))
    pixels, depth = arm.project(points)
    found = np.column_stack([points, np.ones(20)]) @ arm.matrix.T
    np.testing.assert_allclose(found[:, 2], depth)
    np.testing.assert_allclose(found[:, :2] / found[:, 2:], pixels)


@pytest.mark.parametrize(
    ("pixel", "shown"),
    [((50, 20), True), ((20, 50), False), ((58.9, 38.9), True), ((59.1, 38), False),
     ((0.1, 0.1), True), ((1, -0.1), False)],
)  # fmt: skip
def test_an_oblong_image_shows_what_is_between_its_corners(pixel, shown):
    arm = CArm(resolution=(40, 60))
    place = unproject(arm, np.array(pixel), 0.75)
    assert arm.shows(place) == shown


def test_the_isocentre_is_the_middle_of_the_box_around_points():
    points = [[0.0, 0.0, 0.0], [0.01, 0.0, -0.01], [0.2, 0.1, -0.4]]
    np.testing.assert_allclose(CArm().centred_on(points).isocentre, [0.1, 0.05, -0.2])
