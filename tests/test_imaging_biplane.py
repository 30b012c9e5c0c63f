"""What two planes tell of device, vessel and route in space."""

import numpy as np
import pytest
import trimesh
from test_imaging_device import RADIUS

from cathsim_dmc.anatomy import Surface, phantoms
from cathsim_dmc.imaging import biplane, views
from cathsim_dmc.imaging.angiograph import Angiograph
from cathsim_dmc.imaging.biplane import TRACE_SPACING, Biplane
from cathsim_dmc.imaging.carm import CArm
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.options import FluoroscopyOptions, RoadmapErrors


@pytest.fixture(scope="module")
def anatomy():
    return phantoms.load("type1")


@pytest.fixture(scope="module")
def planes(anatomy):
    surface = anatomy.surface
    options = FluoroscopyOptions(view=(60, 0), biplane=(-30, 0), roadmap=0.5)
    return Angiograph(surface, options).planes()


@pytest.fixture(scope="module")
def machine(planes):
    return Biplane(planes)


def images(planes, line, random_state=None):
    shadows = [Shadow(line[None], RADIUS)]
    return np.concatenate([p.render(shadows, random_state) for p in planes], axis=-1)


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("goal", ["bca", "lcca"])
def test_a_device_on_a_route_is_found_from_its_marker_on(
    anatomy, planes, machine, goal, noise
):
    route = anatomy.route(goal).resampled(3e-3).points
    state = np.random.RandomState(0) if noise else None
    line = machine.device(images(planes, route, state)[0])
    assert len(line) >= 15
    apart = np.linalg.norm(line[:15, None] - route, axis=-1).min(axis=1)
    assert np.median(apart) < 1.5e-3 and apart.max() < 4e-3
    assert np.linalg.norm(line[0] - route[-1]) < 2.5e-3
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    np.testing.assert_allclose(steps, TRACE_SPACING, rtol=1e-6)


def test_nothing_is_found_in_empty_images(planes, machine):
    empty = np.stack([plane.empty for plane in planes], axis=-1)
    assert machine.device(empty).shape == (0, 3)


def test_a_point_is_where_both_planes_see_it(planes, machine):
    for point in np.random.RandomState(1).uniform(-0.04, 0.04, (5, 3)):
        there = np.asarray(planes[0].carm.isocentre) + point
        seen = [plane.carm.project(there)[0] for plane in planes]
        np.testing.assert_allclose(machine.point(seen), there, atol=1e-9)


def test_the_hull_holds_the_vessel(anatomy, machine):
    line = anatomy.route("lcca").resampled(3e-3)
    depth = machine.depth(line.points)
    # Where the vessel begins, its outline is that of the flat end.
    assert (depth > 0.3 * line.radii)[5:].all()
    aside = np.asarray(machine.isocentre) + [0.09, 0.0, 0.0]
    assert machine.depth(aside) < -0.01


@pytest.mark.parametrize("goal", ["bca", "lcca"])
def test_the_route_through_the_roadmaps_is_near_that_of_the_tree(
    anatomy, machine, goal
):
    line = anatomy.route(goal).resampled(1e-3)
    found = machine.route(line.points[20], anatomy.goals[goal].position)
    apart = np.linalg.norm(found[:, None] - line.points, axis=-1)
    assert apart.min(axis=1).mean() < 8e-3
    assert apart.min(axis=1).max() < 20e-3
    np.testing.assert_allclose(found[0], line.points[20], atol=1e-5)
    assert np.linalg.norm(found[-1] - anatomy.goals[goal].position) < 2e-3


def farthest(anatomy, machine, goal="lcca"):
    """Largest distance of the found route from that of the tree, m."""
    line = anatomy.route(goal).resampled(1e-3)
    found = machine.route(line.points[20], anatomy.goals[goal].position)
    apart = np.linalg.norm(found[:, None] - line.points, axis=-1)
    return apart.min(axis=1).max()


def test_the_hull_reaches_as_far_as_tall_images_show(anatomy):
    found = []
    for size, width in ((384, 0.36), ((384, 128), 0.12)):  # the same pixels and rows
        options = {"view": "AP", "biplane": "LATERAL", "size": size}
        options = FluoroscopyOptions(**options, detector_size=width)
        found.append(Biplane(Angiograph(anatomy.surface, options).planes())._hull)
    (low, square), (tall_low, tall) = found
    np.testing.assert_allclose(tall_low[2], low[2], atol=biplane.HULL_SPACING)
    assert abs(tall.shape[2] - square.shape[2]) <= 1


def test_a_third_roadmap_tells_branches_apart(anatomy, planes, machine):
    """Those that lie side by side in two."""
    options = FluoroscopyOptions(view=(60, 0), biplane=(-30, 0), third="AP")
    third = Angiograph(anatomy.surface, options).third()
    assert farthest(anatomy, machine) > 10e-3
    assert farthest(anatomy, Biplane(planes, third)) < 4e-3
    mild = RoadmapErrors(noise=0.5, erosion=0.5, calibration=2.0)
    assert farthest(anatomy, Biplane(planes, third, mild, 1)) < 8e-3


@pytest.mark.parametrize("name", ["type1", "type2"])
def test_a_device_on_the_true_route_is_inside_that_of_roadmaps_with_errors(name):
    options = FluoroscopyOptions(view=(60, 0), biplane=(-30, 0), third="AP")
    anatomy, outside, aside = phantoms.load(name), [], []
    line = anatomy.route("lcca").resampled(1e-3).points[20:]
    machines = Angiograph(anatomy.surface, options)
    for seed in range(6):
        errors = RoadmapErrors(noise=0.5, erosion=0.25)
        machine = Biplane(machines.planes(), machines.third(), errors, seed)
        found = machine.route(line[0], line[-1])
        apart = np.linalg.norm(line[-60:, None] - found, axis=-1)
        # A policy takes a device so far outside for lost.
        outside.append(((apart / machine.radii(found)).min(axis=1) > 1.25).mean())
        aside.append(apart.min(axis=1)[27:52].mean())  # in the branch
    assert np.mean(aside) < 1.35e-3
    assert np.mean(outside) < 0.08
    assert np.max(outside) < 0.4


def test_roadmaps_have_the_errors_that_are_asked_for(planes, machine):
    eroded = Biplane(planes, errors=RoadmapErrors(erosion=0.5))
    np.testing.assert_allclose(eroded._walls, machine._walls - 0.5, atol=1e-5)
    noisy = Biplane(planes, errors=RoadmapErrors(noise=0.5))
    deviation = (noisy._walls - machine._walls).std()
    assert deviation == pytest.approx(0.5, rel=0.2)
    gaps = Biplane(planes, errors=RoadmapErrors(gaps=2))
    assert (gaps._walls <= machine._walls).all()
    missing = (gaps._walls < 0) & (machine._walls > 0)
    assert missing.any(axis=(1, 2)).all()
    wrong = [
        Biplane(planes, errors=RoadmapErrors(calibration=2.0), seed=n) for n in (0, 1)
    ]
    assert not np.array_equal(wrong[0].matrices, wrong[1].matrices)
    for one in wrong:
        for plane in planes:
            arm, believed = plane.carm, one._believed(plane.carm)
            angles = np.subtract(
                [believed.primary, believed.secondary], [arm.primary, arm.secondary]
            )
            assert 0.0 < np.abs(np.rad2deg(angles)).max() <= 2.0
    with pytest.raises(ValueError, match="roadmap_errors: calibration is -1"):
        FluoroscopyOptions(roadmap_errors={"calibration": -1.0})


def test_places_on_both_sides_of_an_outline_are_as_far_from_it():
    box = trimesh.creation.box((0.06, 0.06, 0.06))
    arm = CArm()
    # One place in each column of pixels, across the right side of the shadow.
    x = np.arange(0.02, 0.04, arm.pitch * arm.source_isocentre / arm.source_detector)
    places = np.stack([x, 0 * x, 0 * x], axis=1)
    found = views._depths(Surface(box.vertices, box.faces), arm, places)
    inside, outside = found[found > 0.0], found[found < 0.0]
    assert inside.min() == pytest.approx(-outside.max(), rel=1e-6)


def test_the_anatomy_chooses_the_views(anatomy):
    options = FluoroscopyOptions(view="best", biplane="best", third="best")
    machine = Angiograph(anatomy.surface, options)
    angles = machine.options.view, machine.options.biplane, machine.options.third
    assert len(machine.planes()) == 2 and len(set(angles)) == 3
    two = Biplane(machine.planes())
    assert farthest(anatomy, two) < 8e-3  # 15 mm in those of the fixture
    with pytest.raises(ValueError, match="view is 'best' and .*give 'best' for"):
        FluoroscopyOptions(view="best", biplane=(90, 0))


def test_the_chosen_views_show_fewer_places_beside_the_vessel_than_others(anatomy):
    """Places that both outlines hold and that lie 3 mm or more outside the lumen."""
    low, high = anatomy.lumen.box
    axes = [np.arange(a, b, 3e-3) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    places = places[anatomy.lumen(places) < -3e-3]

    def beside(view, biplane):
        options = FluoroscopyOptions(view=view, biplane=biplane)
        machine = Biplane(Angiograph(anatomy.surface, options).planes())
        return int((machine.depth(places) > 0.5e-3).sum())

    others = ((60, 0), (-30, 0)), ((0, 0), (90, 0)), ((45, 20), (-45, 20))
    best = beside("best", "best")
    assert all(beside(*each) > 1.1 * best for each in others)


def test_a_device_ends_where_it_leaves_an_image(anatomy):
    options = FluoroscopyOptions(
        view=(60, 0), biplane=(-30, 0), magnification=2.0, contrast=False
    )
    planes = Angiograph(anatomy.surface, options).planes()
    machine, middle = Biplane(planes), planes[0].carm.isocentre
    line = np.array(middle) + np.outer(np.linspace(0, 0.2, 60), [0.0, 0.0, -1.0])
    found = machine.device(images(planes, line[::-1])[0])
    pixels, _ = planes[0].carm.project(found)
    assert 6 <= len(found) < 20
    assert (pixels > -1.0).all() and (pixels < planes[0].carm.resolution[0]).all()


def test_planes_whose_angles_are_off_find_a_device_far_from_their_isocentre(planes):
    """Their rays to it miss each other by more than those of true planes do."""
    straight = np.linspace([0.0, 0.0, -0.05], [0.0, 0.0, 0.05], 50)
    for aside in (-0.09, 0.09):
        line = straight + planes[0].carm.isocentre + [aside, 0.0, 0.0]
        image = images(planes, line)[0]
        for seed in (5, 0):
            off = Biplane(planes, errors=RoadmapErrors(calibration=5.0), seed=seed)
            assert len(off.device(image)) > 12


def test_radii_are_not_too_small_where_outlines_have_errors(anatomy, planes):
    """The least of the distances to three outlines with errors is below its mean."""
    options = FluoroscopyOptions(view=(60, 0), biplane=(-30, 0), third="AP")
    third = Angiograph(anatomy.surface, options).third()
    line = anatomy.route("lcca").resampled(1e-3).points[20:]
    true, errors = Biplane(planes, third).radii(line), RoadmapErrors(noise=1.0)
    found = [Biplane(planes, third, errors, n).radii(line) for n in range(4)]
    assert np.mean(found - true) == pytest.approx(0.0, abs=0.7e-3)


def test_both_ends_of_a_route_stay_where_it_is_centred(anatomy, planes):
    machine = Biplane(planes, errors=RoadmapErrors(noise=0.5))
    line = anatomy.route("lcca").resampled(1e-3).points[20:]
    found = machine._centred(line)
    np.testing.assert_array_equal(found[[0, -1]], line[[0, -1]])
    assert np.linalg.norm(found - line, axis=1).max() > 0.5e-3


@pytest.mark.parametrize("length", [0.4e-3, 30.2e-3, 30.7e-3])
def test_both_ends_of_a_line_stay_where_it_is_smoothed(length):
    ends = np.array([[0.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    line = ends * length
    for _ in range(9):
        line = biplane._smoothed(line, 2e-3)
    np.testing.assert_allclose(line[[0, -1]], ends * length, atol=1e-5)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert 0.35e-3 < steps.min() <= steps.max() < 1.1e-3


def test_a_device_is_found_beside_a_short_line_that_is_darker(planes):
    """The longer of two lines that leave the marker is the device."""
    tip = np.array(planes[0].carm.isocentre)
    line = tip + np.outer(np.linspace(0.1, 0.0, 40), [0.0, 0.0, -1.0])
    other = tip + np.outer(np.linspace(0.0, 0.025, 10), [0.0, 0.0, 1.0])
    shadows = [
        Shadow(line[None], RADIUS, 150.0),
        Shadow(other[None], RADIUS, 400.0, marker_mu=None),
    ]
    image = np.concatenate([plane.render(shadows) for plane in planes], axis=-1)
    found = Biplane(planes).device(image[0])
    assert len(found) > 12
    assert np.linalg.norm(found[:, :2] - tip[:2], axis=1).max() < 3e-3
    assert found[-1, 2] < tip[2] - 0.06
