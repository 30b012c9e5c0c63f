import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cathsim_dmc.recording.geometry import FORCE_COLOUR_MAX, force_colours
from cathsim_dmc.recording.rerun_scene import z_to

directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(
    lambda d: np.linalg.norm(d) > 1e-3
)


@given(directions)
def test_z_to_turns_z_into_the_direction(direction):
    direction = np.array(direction)
    quaternion = z_to(direction)
    assert np.linalg.norm(quaternion) == pytest.approx(1)
    unit = direction / np.linalg.norm(direction)
    turned = Rotation.from_quat(quaternion).apply([0, 0, 1])
    np.testing.assert_allclose(turned, unit, atol=1e-6)


def test_colours_darken_with_force_and_saturate():
    force = np.linspace(0, FORCE_COLOUR_MAX, 30)
    colours = force_colours(force).astype(int)
    assert colours.shape == (30, 3)
    lightness = colours @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) < 0).all()
    np.testing.assert_array_equal(force_colours(10.0), colours[-1])
