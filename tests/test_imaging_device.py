import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from cathsim_dmc.imaging.carm import CArm
from cathsim_dmc.imaging.device import Shadow, _bends, add_disc, device_attenuation

RADIUS = 0.84e-3
SCRATCH = np.empty((3, 20))


def device_thickness(carm, points, radius):
    return device_attenuation(carm, Shadow(points, radius, 1.0, None))


def curve(links=36, phase=0.0):
    """A catheter round an arch, (links + 1, 3)."""
    s = np.linspace(0, 1, links + 1)[:, None]
    angle = np.pi * s + phase
    return np.concatenate(
        [
            0.035 * np.cos(angle),
            0.02 * (s - 0.5) + 0.005 * np.sin(3 * angle),
            0.05 * np.sin(angle) - 0.02,
        ],
        axis=1,
    )


def volume(points, radius):
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return (np.pi * radius**2 * length).sum() + 4 / 3 * np.pi * np.mean(radius) ** 3


def seen_volume(carm, image, depth):
    """Volume that an image of thickness shows of an object at one depth."""
    area = (depth / carm.focal_length) ** 2 / carm.slant()
    return (image * area).sum(axis=(-2, -1))


def brute_shares(image_size, row, column, radius, fine=100):
    """Share of a disc in each pixel, by counting points of a grid."""
    grid = (np.arange(image_size * fine) + 0.5) / fine - 0.5
    inside = (grid[:, None] - row) ** 2 + (grid - column) ** 2 < radius**2
    counts = inside.reshape(image_size, fine, image_size, fine).sum(axis=(1, 3))
    return counts / (np.pi * (radius * fine) ** 2)


@settings(max_examples=40)
@given(st.floats(0.2, 4.0), st.floats(4.5, 6.5), st.floats(4.5, 6.5))
def test_a_disc_is_shared_by_the_area_in_each_pixel(radius, row, column):
    image = np.zeros((11, 11))
    add_disc(image, row, column, radius, 3.0, SCRATCH)
    shares = brute_shares(11, row, column, radius)
    np.testing.assert_allclose(image / 3.0, shares, atol=0.01 / radius)
    assert image.min() >= 0.0


@pytest.mark.parametrize(
    ("view", "magnification"), [("AP", 1.0), ("LATERAL", 2.0), ("LAO45", 1.0)]
)
def test_drawn_centreline_is_the_projected_one(view, magnification):
    carm = CArm.view(view, magnification=magnification)
    points = curve()
    truth, _ = carm.project(CubicSpline(range(37), points)(np.linspace(0, 36, 3997)))
    image = device_thickness(carm, points, RADIUS)

    # Weight in a window round a point of the curve has its centre of mass on the
    # curve, where the curve is seen once and nearly straight.
    rows, columns = np.indices(image.shape)
    distances = []
    for centre in truth[200:-200:100]:
        near = np.hypot(truth[:, 0] - centre[0], truth[:, 1] - centre[1]) < 6
        parts = np.flatnonzero(np.diff(np.flatnonzero(near)) > 1)
        inside = (centre > 4).all() and (centre < 123).all()
        if len(parts) or not inside:
            continue
        window = np.exp(-((columns - centre[0]) ** 2 + (rows - centre[1]) ** 2) / 2.0)
        weight = image * window
        found = np.array([(weight * columns).sum(), (weight * rows).sum()])
        found /= weight.sum()
        distances.append(np.hypot(*(truth - found).T).min())
    assert len(distances) >= 8
    assert max(distances) < 0.5
    assert np.mean(distances) < 0.15


def arc(links):
    """Joints on a circle of 20 mm radius, (links + 1, 3)."""
    angle = np.linspace(0.0, 1.5 * np.pi, links + 1)
    return 0.02 * np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1)


def test_the_shadow_has_no_corners():
    carm = CArm.view("AP", resolution=(256, 256), magnification=4.0)
    # A joint every 22 degrees, 8 mm apart, as in a bend of the published device.
    image, circle = (device_thickness(carm, arc(n), RADIUS) for n in (12, 400))
    length = np.linalg.norm(np.diff(arc(12), axis=0), axis=1).sum()
    circle *= length / (1.5 * np.pi * 0.02)  # a device is as long as its links
    assert np.abs(image - circle).sum() < 0.04 * circle.sum()


@settings(max_examples=60)
@given(
    st.floats(0, 2 * np.pi),
    st.floats(-1.4, 1.4),
    st.floats(-1.0, 1.0),
    st.floats(-1.0, 1.0),
    st.floats(0.1e-3, 3e-3),
)
def test_weight_is_kept_under_rotation_and_subpixel_motion(turn, tilt, dx, dz, radius):
    carm = CArm.view("AP")
    pixel = carm.pitch * carm.source_isocentre / carm.source_detector
    half = 0.03 * np.array([np.cos(turn), np.tan(tilt), np.sin(turn)]) * np.cos(tilt)
    centre = np.array([dx * pixel, 0.0, dz * pixel])
    points = np.stack([centre - half, centre, centre + half])
    image = device_thickness(carm, points, radius)
    depth = carm.project(points)[1]
    expected = volume(points, radius)
    # Mean of (focal / depth)² along the rod, in closed form.
    shrink = 1.0 / (depth[0] * depth[2]) * depth[1] ** 2
    seen = seen_volume(carm, image, depth[1]) / shrink
    assert seen == pytest.approx(expected, rel=0.01)


def test_marker_adds_its_weight_at_the_tip():
    carm = CArm.view("AP")
    points = np.linspace([-0.05, 0, 0], [0.05, 0, 0], 15)
    plain = device_attenuation(carm, Shadow(points, RADIUS, 100.0, None))
    marked = device_attenuation(carm, Shadow(points, RADIUS, 100.0, 1100.0, 4e-3))
    extra = (marked - plain).astype(float)
    depth = carm.source_isocentre
    # The marker covers the last 4 mm of the chain, its round end included.
    expected = 1000.0 * np.pi * RADIUS**2 * 4e-3
    assert seen_volume(carm, extra, depth) == pytest.approx(expected, rel=0.02)
    where = (extra.sum(axis=0) * np.arange(128)).sum() / extra.sum()
    tip = np.array([0.05 + 2 / 3 * RADIUS - 2e-3, 0, 0])
    assert where == pytest.approx(carm.project(tip)[0][0], abs=0.15)
    assert extra.min() > -1e-6


def test_a_batch_equals_its_frames_bit_for_bit():
    rng = np.random.RandomState(1)
    points = curve() + rng.uniform(-0.02, 0.02, (5, 7, 1, 3))
    radius = rng.uniform(0.3e-3, 4e-3, (5, 7))
    carm = CArm(0.3, 0.1)
    material = 100.0, 900.0, 3e-3
    batch = device_attenuation(carm, Shadow(points, radius, *material))
    assert batch.shape == (5, 7, 128, 128) and batch.dtype == np.float32
    for i in np.ndindex(5, 7):
        single = Shadow(points[i], radius[i], *material)
        assert (device_attenuation(carm, single) == batch[i]).all()


def test_devices_outside_the_view_or_broken_leave_the_rest():
    carm = CArm.view("AP")
    points = np.stack([curve(), curve() + [1.0, 0, 0], curve() + [0, 3.0, 0], curve()])
    points[3, 5] = np.nan
    image = device_thickness(carm, points, RADIUS)
    assert (image[1:3] == 0.0).all()
    assert np.isfinite(image).all()
    assert 0.8 * image[0].sum() < image[3].sum() < image[0].sum()
    assert (device_thickness(carm, np.full((2, 3), np.inf), RADIUS) == 0.0).all()
    # A device that leaves the image is cut at its edge.
    line = np.linspace([-0.5, 0, 0], [0.5, 0, 0], 101)
    image = device_thickness(carm, line, RADIUS)
    assert image.sum(axis=0) == pytest.approx(image.sum(axis=0).mean(), rel=0.02)
    far = device_thickness(carm, [[0, 0, 0], [1e9, 0, 0]], RADIUS)
    assert np.isfinite(far).all()


@pytest.mark.parametrize(
    ("points", "radius", "message"),
    [
        (np.zeros((4, 2)), RADIUS, r"have shape \(4, 2\); give two joints or more"),
        (np.zeros((1, 3)), RADIUS, r"have shape \(1, 3\); give two joints or more"),
        (curve(), 0.0, "> 0"),
        (curve(), np.full(12, RADIUS), "shape"),
        (curve(), 0.5, "px in radius"),
    ],
)
def test_wrong_devices_are_refused(points, radius, message):
    with pytest.raises(ValueError, match=message):
        device_thickness(CArm(), points, radius)


def test_the_curve_has_no_corner_beside_links_in_one_line():
    joints = np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1], [3, 1, 1], [3, 3, 1.0]])
    links = np.diff(joints, axis=0)
    bends = np.array([_bends(joints, link) for link in range(4)])
    lengths = np.linalg.norm(links, axis=1, keepdims=True)
    starts = (links + bends[:, :3]) / lengths  # tangents at the joints of every link
    ends = (links + bends[:, 3:]) / lengths
    np.testing.assert_allclose(starts[1:], ends[:-1], atol=1e-12)
    assert np.abs(bends[0]).max() == 0.0  # a link beside one in its line is straight
