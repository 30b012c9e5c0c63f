import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from recording_samples import make_tube

from cathsim_dmc.analysis.heatmap import force_map, heatmap


@given(seed=st.integers(0, 2**31), count=st.integers(0, 60))
def test_the_map_keeps_the_sum_of_force_and_the_number_of_contacts(seed, count):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1.2, 1.2, (count, 3))
    force = rng.uniform(0, 2, count)
    field = force_map(position, force, np.array([-1, -1]), np.array([1, 1]), 0.3)
    inside = (position[:, [0, 2]] >= -1).all(1) & (position[:, [0, 2]] < 1.1).all(1)
    assert field.count.sum() == inside.sum()
    assert field.outside == count - inside.sum()
    total = np.nansum(field.mean * field.count)
    np.testing.assert_allclose(total, force[inside].sum())
    assert (np.isnan(field.mean) == (field.count == 0)).all()


def test_a_contact_lies_in_the_cell_that_its_edges_say():
    position = np.array([[0.25, 9.0, -0.75], [0.25, -9.0, -0.75], [-0.9, 0, 0.9]])
    field = force_map(
        position, np.array([1.0, 3.0, 5.0]), np.array([-1, -1]), np.array([1, 1]), 0.5
    )
    assert field.mean.shape == (4, 4)
    column = np.searchsorted(field.x_edges, 0.25) - 1
    row = np.searchsorted(field.z_edges, -0.75, side="right") - 1
    assert field.mean[row, column] == 2.0 and field.count[row, column] == 2
    assert field.mean[3, 0] == 5.0


def test_the_picture_shows_contacts_where_they_are(tmp_path):
    from matplotlib.image import imread

    tube, path = make_tube(), tmp_path / "map.png"
    assert heatmap(np.zeros((0, 3)), np.zeros(0), tube, path).count.sum() == 0
    pictures = []
    # The second in the wall, half a millimetre beyond the lumen.
    for place in ([0.01, 0.0, 0.02], [-0.0205, 0.0, 0.01]):
        field = heatmap(np.array([place] * 6), np.full(6, 0.4), tube, path)
        assert np.nanmax(field.mean) == pytest.approx(0.4) and not field.outside
        np.testing.assert_allclose(np.diff(field.x_edges), 2e-3)
        pictures.append(imread(path)[..., :3].sum(axis=-1))
    darker = pictures[0] - pictures[1]
    one, other = np.argwhere(darker < -0.3), np.argwhere(darker > 0.3)
    for cell in (one, other):  # the only change is one square cell
        height, width = np.ptp(cell, axis=0)
        assert len(cell) > 20 and abs(int(height) - int(width)) <= 2
    assert one[:, 0].mean() < other[:, 0].mean()  # higher up
    assert one[:, 1].mean() > other[:, 1].mean()  # to the right
    with pytest.raises(ValueError, match=r"\.png"):
        heatmap(np.zeros((1, 3)), np.ones(1), tube, tmp_path / "map.pdf")


def test_the_scales_are_in_mm_and_mn_and_unknown_sides_of_a_patient_are_not_named(
    tmp_path, monkeypatch
):
    drawn, tube, path = [], make_tube(), tmp_path / "map.png"
    ends = 1e3 * np.array([tube.vertices.min(0), tube.vertices.max(0)])[:, [0, 2]]
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: drawn.append(self))
    for upright in (True, False):
        place, force = np.zeros((1, 3)), np.full(1, 0.5)
        with contextlib.suppress(RuntimeError):  # nothing is written
            heatmap(place, force, tube, path, title="A map", upright=upright)
        axes, bar = drawn[-1].axes
        assert bar.get_ylim() == (0.0, 500.0) and "mN" in bar.get_ylabel()
        vessel, *_, cells = axes.collections
        outline = np.concatenate([one.vertices for one in vessel.get_paths()])
        np.testing.assert_allclose([outline.min(0), outline.max(0)], ends)
        assert np.nanmax(cells.get_array()) == 500.0 and axes.get_title() == "A map"
        assert ("left" in axes.get_xlabel()) == upright
        assert ("head" in axes.get_ylabel()) == upright


@pytest.mark.parametrize(
    ("position", "force", "said"),
    [
        (np.zeros((2, 3)), np.ones(3), r"force is float64 of shape \(3,\)"),
        (np.zeros((2, 3)), np.ones((2, 3)), r"force is .* it must be .* shape \(2\)"),
        (np.zeros(3), np.ones(1), r"position is float64 of shape \(3,\)"),
        (np.full((1, 3), np.nan), np.ones(1), "position is .* finite"),
        (np.array([[28.0, 8.0, 103.0]]), np.ones(1), "position is 103.0; .* 10 m"),
    ],
)
def test_contacts_of_another_shape_or_unit_are_refused(position, force, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        heatmap(position, force, make_tube(), tmp_path / "map.png")


def test_a_map_is_a_picture_of_a_surface(tmp_path):
    position, force = np.zeros((1, 3)), np.ones(1)
    with pytest.raises(ValueError, match="surface is None; it must be a Surface"):
        heatmap(position, force, None, tmp_path / "map.png")
    with pytest.raises(ValueError, match="map.jpg; give a .png file"):
        heatmap(position, force, make_tube(), tmp_path / "map.jpg")
