from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_imaging_device import RADIUS, curve
from test_imaging_thickness import ball

from cathsim_dmc.imaging import angiograph, detector, materials
from cathsim_dmc.imaging.angiograph import Deviation
from cathsim_dmc.imaging.carm import CArm
from cathsim_dmc.imaging.device import Shadow, device_attenuation
from cathsim_dmc.imaging.fluoroscopy import MASK_SHARE, Fluoroscope
from cathsim_dmc.imaging.options import FluoroscopyOptions


@pytest.fixture(scope="module")
def vessel():
    """A ball that the catheter of `curve` enters."""
    return ball([0.02, 0, 0.01], 0.03)


@pytest.fixture(scope="module")
def fluoroscope(vessel):
    return Fluoroscope.from_surface(vessel)


@pytest.fixture(scope="module")
def frames():
    return curve() + np.random.RandomState(3).uniform(-5e-3, 5e-3, (20, 1, 3))


def drawn(scope, points, random_state=None):
    return scope.render([Shadow(points, RADIUS)], random_state)


@pytest.mark.parametrize("quanta", [5.0, 20.0, 400.0, 4000.0])
def test_noise_has_the_moments_of_poisson(quanta):
    signal = np.ones((8, 256, 256), dtype=np.float32)
    counts = (
        detector.quantum_noise(signal, quanta, [np.random.RandomState(0)] * 8) * quanta
    ).astype(float)
    assert counts.mean() == pytest.approx(quanta, rel=0.005)
    assert counts.var() == pytest.approx(quanta, rel=0.01)
    centred = counts - counts.mean()
    skew = (centred**3).mean() / counts.std() ** 3
    assert skew == pytest.approx(quanta**-0.5, abs=0.02)
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-2)


@settings(max_examples=30)
@given(st.floats(0.2, 4.0))
def test_blur_keeps_weight_and_has_its_width(sigma):
    point = np.zeros((61, 61), dtype=np.float32)
    point[30, 30] = 1.0
    spread = detector.blurred(point, sigma).astype(float)
    assert spread.sum() == pytest.approx(1.0, rel=1e-5)
    x = np.arange(61) - 30
    variance = (spread.sum(axis=0) * x**2).sum()
    # Cut off at three sigma, and sampled: exact for wide blurs.
    if sigma > 0.6:
        assert variance == pytest.approx(sigma**2, rel=0.06)
    np.testing.assert_allclose(spread, spread.T, atol=1e-7)
    flat = np.full((2, 9, 5), 0.3, dtype=np.float32)
    np.testing.assert_allclose(detector.blurred(flat, sigma), 0.3, rtol=1e-5)


def test_grey_levels():
    signal = np.array([[-1.0, 0.0, 0.5], [1.0, 1.2, 9.0]])
    image = detector.grey(signal, gain=0.8)
    assert image.dtype == np.uint8
    assert image.tolist() == [[0, 0, 102], [204, 245, 255]]


def test_image_is_beer_lambert_of_its_parts(fluoroscope, frames):
    image = drawn(fluoroscope, frames)
    assert image.shape == (20, 128, 128, 1) and image.dtype == np.uint8
    depth = device_attenuation(fluoroscope.carm, Shadow(frames, RADIUS))
    total = materials.IODINE * materials.CONTRAST * fluoroscope.vessel + depth
    expected = 255.0 * detector.GAIN * np.exp(-total.astype(float))
    assert np.abs(image[..., 0] - expected).max() < 0.51


def test_roadmap_lightens_the_vessel(fluoroscope, frames):
    live = replace(fluoroscope, contrast=0.0)
    road = replace(live, roadmap=0.5)
    a = drawn(live, frames[0])[..., 0].astype(int)
    b = drawn(road, frames[0])[..., 0].astype(int)
    mask = fluoroscope.vessel_mask
    assert (a[~mask] == b[~mask]).all()
    assert (b[mask] > a[mask]).all()
    # Tissue goes half the way from 0.75 to white; the device keeps its contrast.
    tissue = b[mask & (a == 191)]
    assert (np.abs(tissue - 255 * 0.875) <= 1.5).all()
    np.testing.assert_allclose(b[mask] / a[mask], 0.875 / 0.75, atol=0.02)


def test_a_roadmap_stays_where_the_vessel_moves():
    rest = ball([0, 0, 0], 0.03)
    scope = moved = Fluoroscope.from_surface(rest, contrast=0.0, roadmap=0.5)
    for place in ([0.01, 0, 0], [0.02, 0, 0]):  # one movement after the other
        moved = moved.around(ball(place, 0.03))
        assert (moved.vessel_mask != scope.vessel_mask).any()
        np.testing.assert_array_equal(moved.empty, scope.empty)


def test_device_mask_covers_the_catheter(fluoroscope, frames):
    masks = fluoroscope.device_mask([Shadow(frames, RADIUS)])
    assert masks.shape == (20, 128, 128) and masks.dtype == bool
    for mask, points in zip(masks, frames, strict=True):
        pixels, _ = fluoroscope.carm.project(points)
        t = np.linspace(0, 36, 800)
        line = np.stack([np.interp(t, np.arange(37), p) for p in pixels.T], -1)
        c, r = np.rint(line).astype(int).T
        assert mask[r, c].mean() > 0.97
        r, c = np.nonzero(mask)
        far = np.hypot(c[:, None] - line[:, 0], r[:, None] - line[:, 1]).min(axis=1)
        assert far.max() < 1.2


def test_vessel_mask_is_the_silhouette():
    scope = Fluoroscope.from_surface(ball([0, 0, 0], 0.03))
    carm = scope.carm
    distance = carm.source_isocentre
    edge = 0.03 / np.sqrt(distance**2 - 0.03**2) * carm.focal_length
    rows, columns = np.indices((128, 128)) - 63.5
    away = np.hypot(rows, columns)
    assert scope.vessel_mask[away < edge - 0.1].all()
    assert not scope.vessel_mask[away > edge + 0.1].any()


def test_a_batch_equals_its_frames_bit_for_bit(fluoroscope, frames):
    blurry = replace(fluoroscope, blur=2e-3, roadmap=0.3)
    for scope in (fluoroscope, blurry):
        batch = drawn(scope, frames.reshape(4, 5, 37, 3))
        for i in range(20):
            single = drawn(scope, frames[i])
            assert (single == batch.reshape(20, 128, 128, 1)[i]).all()


@pytest.mark.parametrize("resolution", [(128, 128), (33, 47)])
def test_noisy_batches_equal_noisy_frames(vessel, frames, resolution):
    carm = CArm(resolution=resolution).centred_on(vessel.vertices)
    scope = Fluoroscope.from_surface(vessel, carm=carm)
    batch = drawn(scope, frames, np.random.RandomState(7))
    one = np.random.RandomState(7)
    singles = np.stack([drawn(scope, p, one) for p in frames])
    assert (batch == singles).all()

    states = [np.random.RandomState(k) for k in range(20)]
    batch = drawn(scope, frames, states)
    singles = [drawn(scope, p, np.random.RandomState(k)) for k, p in enumerate(frames)]
    assert (batch == singles).all()


def test_seeds_decide_the_noise(fluoroscope, frames):
    def image(seed):
        return drawn(fluoroscope, frames[0], np.random.RandomState(seed))

    assert (image(0) != image(1)).mean() > 0.5
    clean = drawn(fluoroscope, frames[0])
    residual = image(0).astype(float) - clean
    tissue = fluoroscope.vessel[..., None] == 0.0
    expected = 255 * detector.GAIN / np.sqrt(fluoroscope.quanta)
    # Without noise, tissue is rounded from 191.25 to 191.
    assert residual[tissue].mean() == pytest.approx(0.25, abs=0.1)
    assert residual[tissue].std() == pytest.approx(expected, rel=0.15)


def test_biplane_stacks_two_views(vessel, frames):
    planes = [
        Fluoroscope.from_surface(vessel, carm=CArm.view(v).centred_on(vessel.vertices))
        for v in ("AP", "LATERAL")
    ]
    machines = [tuple(planes)] * 20
    image = angiograph.images(machines, [Shadow(frames, RADIUS)])
    assert image.shape == (20, 128, 128, 2)
    for channel, plane in enumerate(planes):
        assert (image[..., channel] == drawn(plane, frames)[..., 0]).all()
    states = [np.random.RandomState(k) for k in range(20)]
    noisy = angiograph.images(machines, [Shadow(frames, RADIUS)], states)
    state = np.random.RandomState(4)
    one = [Shadow(frames[4:5], RADIUS)]
    single = angiograph.images(machines[:1], one, [state])
    assert (noisy[4] == single[0]).all()


def test_quanta_are_those_of_the_pixel_and_the_kerma_of_the_machine(vessel):
    """30174 a mm² and µGy; a zoom of 2 shows a quarter of the detector on a pixel."""
    options = FluoroscopyOptions(kerma=40e-9, size=64, magnification=2.0)
    machine = angiograph.Angiograph(vessel, options)
    (usual,), (other,) = map(machine.planes, (Deviation(), Deviation(0, 0, 1.1, 0.5)))
    pixel = 1e3 * usual.carm.detector_size / 64 / 2.0
    assert usual.quanta == pytest.approx(30174 * 0.04 * pixel**2)
    assert other.quanta == pytest.approx(0.5 * usual.quanta)
    assert other.gain == pytest.approx(1.1 * usual.gain)
    assert other.vessel is usual.vessel


@pytest.mark.parametrize("shift", [-0.4, -0.2, 0.2, 0.4])
def test_a_thin_device_shows_on_a_pixel_that_sees_enough_of_it(shift):
    """It stands across the edge of two columns, by a share of its radius off it."""
    arm = CArm(resolution=(32, 32))
    pixel = arm.pitch * arm.source_isocentre / arm.source_detector
    radius = 0.2 * pixel
    scope = Fluoroscope(arm, np.zeros((32, 32)), np.zeros((32, 32), bool))
    line = np.zeros((2, 3))
    line[:, 0], line[:, 2] = shift * radius, (-8 * pixel, 8 * pixel)
    row = scope.device_mask([Shadow(line, radius)])[16]
    # Chords of a round rod make half an ellipse; share of it on the left of the edge.
    left = (np.arccos(shift) - shift * np.sqrt(1 - shift**2)) / np.pi
    shown = np.array([left, 1 - left]) * np.pi / 4 >= MASK_SHARE
    np.testing.assert_array_equal(np.flatnonzero(row), 15 + np.flatnonzero(shown))
    assert shown.tolist() == [shift < 0.3, shift > -0.3]


def test_a_zoom_spreads_the_blur_of_the_detector_over_more_pixels():
    """A black line is as wide as the point spread, in pixels of the zoomed image."""
    usual = CArm(resolution=(9, 61))
    for zoom in (1.0, 2.0):
        arm, line = replace(usual, magnification=zoom), np.zeros((9, 61))
        line[:, 30] = 1e3
        scope = Fluoroscope(arm, line, line > 0, blur=1.2 * usual.pitch)
        darker = scope.empty[4, 0] - scope.empty[4].astype(float)
        spread = darker @ (np.arange(61) - 30.0) ** 2 / darker.sum()
        assert np.sqrt(spread) == pytest.approx(1.2 * zoom, rel=0.06)


def test_the_thin_end_of_a_chain_is_seen_beside_its_wide_base():
    arm = CArm(resolution=(128, 128), magnification=8.0)
    pixel = arm.pitch * arm.source_isocentre / arm.source_detector
    scope = Fluoroscope(arm, np.zeros((128, 128)), np.zeros((128, 128), bool))
    line = np.zeros((3, 3))
    line[:, 0] = np.array([-40.0, 0.0, 40.0]) * pixel
    radii = np.array([10.0, 1.5]) * pixel
    mask = scope.device_mask([Shadow(line, radii)])
    assert mask[:, 34].sum() == pytest.approx(20, abs=1)
    assert mask[:, 94].sum() == pytest.approx(3, abs=1)


@pytest.mark.parametrize(
    ("contrast", "iodine"), [(True, 15.0), (False, 0.0), (7.5, 7.5), (0.0, 0.0)]
)
def test_contrast_is_an_amount_of_iodine_or_whether_there_is_the_usual_one(
    vessel, contrast, iodine
):
    options = FluoroscopyOptions(contrast=contrast, size=32)
    (plane,) = angiograph.Angiograph(vessel, options).planes()
    assert plane.contrast == iodine
    dark = 1 - plane.signal.min()  # behind 60 mm of the ball
    assert dark == pytest.approx(1 - np.exp(-0.758 * iodine * 0.06), abs=0.01)


def test_all_planes_of_a_machine_are_off_by_its_own_angles(vessel):
    options = FluoroscopyOptions(view=(60, 0), biplane=(-30, 10), third="LAO45")
    machine, off = angiograph.Angiograph(vessel, options), Deviation(5, -3)
    planes = *machine.planes(off), *machine.third(off)
    angles = [(plane.carm.primary, plane.carm.secondary) for plane in planes]
    np.testing.assert_allclose(np.rad2deg(angles), [(65, -3), (-25, 7), (50, -3)])


def test_each_simulation_is_seen_by_its_own_machine(vessel, frames):
    options = FluoroscopyOptions(size=32)
    kinds = [
        angiograph.Angiograph(each, options).planes()
        for each in (vessel, ball([-0.03, 0.02, 0.0], 0.01))
    ]
    machines = [kinds[0], kinds[1], kinds[0]]
    shadow = Shadow(frames[:3], RADIUS)
    masks = angiograph.masks(machines, [shadow])
    pixels = angiograph.pixels(machines, frames[:3])
    states = [np.random.RandomState(k) for k in range(3)]
    images = angiograph.images(machines, [shadow], states)
    for k, own in enumerate(machines):
        one = [shadow.of(np.array([k]))]
        np.testing.assert_array_equal(masks[k], angiograph.masks([own], one)[0])
        alone = angiograph.images([own], one, [np.random.RandomState(k)])
        np.testing.assert_array_equal(images[k], alone[0])
        wanted, _ = own[0].carm.project(frames[k])
        np.testing.assert_array_equal(pixels[k, 0], wanted)
    assert (masks[0, ..., 1] != masks[1, ..., 1]).any()


def test_the_isocentre_goes_amid_the_places_that_the_middle_of_a_scan_misses():
    options = FluoroscopyOptions()
    scan, places = np.array([[0, 0, 0], [0.6, 0.1, 0.9]]), np.zeros((2, 3))
    places[1] = 0.04, 0.02, 0.08
    aimed = options.aimed(scan, places)
    np.testing.assert_allclose(aimed.centre, [0.02, 0.01, 0.04])
    assert options.aimed(0.2 * scan, places) is options  # all is shown already
    fixed = replace(options, centre=(0.3, 0.0, 0.4))
    assert fixed.aimed(scan, places) is fixed
