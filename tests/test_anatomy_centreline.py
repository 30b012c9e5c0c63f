"""Centrelines, projections, vessel trees and routes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cathsim_dmc.anatomy import centreline
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree


def straight(length=0.1, radius=0.01, count=11):
    points = np.zeros((count, 3))
    points[:, 2] = np.linspace(0.0, length, count)
    return Centreline(points, np.full(count, radius))


def helix(count=200):
    t = np.linspace(0.0, 4.0, count)
    points = np.stack([0.03 * np.cos(t), 0.03 * np.sin(t), 0.02 * t], axis=1)
    return Centreline(points, np.linspace(0.01, 0.004, count))


def tree():
    trunk = straight()
    branch = Centreline([[0, 0, 0.05], [0.03, 0, 0.05], [0.06, 0, 0.05]], [0.004] * 3)
    twig = Centreline([[0.04, 0, 0.05], [0.04, 0, 0.08]], [0.002, 0.002])
    return VesselTree(
        {
            "aorta": Vessel("aorta", trunk),
            "bca": Vessel("bca", branch, "aorta", 0.01),
            "twig": Vessel("twig", twig, "bca", 0.004),
        }
    )


def brute_force_distance(line, points):
    """Distance to the polyline by plain point-to-segment geometry."""
    a, way = line.points[:-1], np.diff(line.points, axis=0)
    offset = points[:, None] - a
    t = np.clip(np.vecdot(offset, way) / np.vecdot(way, way), 0.0, 1.0)
    return np.linalg.norm(offset - t[..., None] * way, axis=-1).min(axis=1)


def test_interpolation_on_a_straight_line():
    place = straight().at(np.array([[0.0, 0.025], [0.1, 7.0]]))
    assert place.position.shape == (2, 2, 3)
    np.testing.assert_allclose(place.position[..., 2], [[0, 0.025], [0.1, 0.1]])
    np.testing.assert_allclose(place.tangent[1, 1], [0, 0, 1])
    np.testing.assert_allclose(place.radius, 0.01)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_projection_agrees_with_brute_force(seed):
    line = helix(40)
    points = np.random.default_rng(seed).uniform(-0.05, 0.1, (20, 3))
    points[:5] = line.at(np.linspace(0.0, line.length, 5)).position  # on the line
    found = line.project(points)
    np.testing.assert_allclose(
        found.distance, brute_force_distance(line, points), atol=1e-12
    )
    place = line.at(found.arc_length)
    np.testing.assert_allclose(
        np.linalg.norm(points - place.position, axis=1), found.distance, atol=1e-12
    )
    np.testing.assert_allclose(place.radius, found.radius, atol=1e-12)


def test_projection_keeps_leading_axes_and_chunks_agree(monkeypatch):
    line = helix()
    points = np.random.default_rng(0).normal(size=(4, 5, 3))
    whole = line.project(points)
    monkeypatch.setattr("cathsim_dmc.anatomy.centreline._CHUNK_ELEMENTS", 400)
    parts = line.project(points)
    assert whole.distance.shape == (4, 5)
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


def test_slice_and_resample_keep_the_curve():
    line = helix()
    part = line.slice(0.02, 0.07)
    assert part.length == pytest.approx(0.05, abs=1e-9)
    np.testing.assert_allclose(part.points[0], line.at(0.02).position, atol=1e-12)
    back = line.slice(0.07, 0.02)
    np.testing.assert_allclose(back.points, part.points[::-1], atol=1e-12)
    even = line.resampled(1e-3)
    np.testing.assert_allclose(even.points[[0, -1]], line.points[[0, -1]], atol=1e-12)
    steps = np.diff(even.arc_length)
    assert steps.max() <= 1.05e-3
    assert steps.min() >= 0.95e-3


def test_arrays_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        straight().points[0, 0] = 1.0


def test_depth_of_a_cylinder_and_its_open_ends():
    vessels = VesselTree({"aorta": Vessel("aorta", straight())})
    points = np.array(
        [[0, 0, 0.05], [0.004, 0, 0.05], [0.013, 0, 0.05], [0, 0, -0.003], [0, 0, 0.1]]
    )
    np.testing.assert_allclose(
        vessels.depths(points)["aorta"], [0.01, 0.006, -0.003, -0.003, 0.01], atol=1e-12
    )
    assert tree().depths(np.array([0.05, 0, 0.05]))["bca"] == pytest.approx(0.004)


def test_route_into_a_branch_and_between_branches():
    vessels = tree()
    route = vessels.route("aorta", "twig", 0.02)
    assert route.length == pytest.approx(0.05 + 0.04 + 0.02)
    np.testing.assert_allclose(route.points[0], [0, 0, 0])
    np.testing.assert_allclose(route.points[-1], [0.04, 0, 0.07])
    # A branch is entered by its distal end: back along it, then down the trunk.
    back = vessels.route("bca", "aorta", start_arc_length=np.inf)
    assert back.length == pytest.approx(0.06 + 0.05)
    np.testing.assert_allclose(back.points[-1], [0, 0, 0.1])
    femoral = vessels.route("aorta", "bca", 0.05, start_arc_length=0.1)
    assert femoral.length == pytest.approx(0.05 + 0.05)


@pytest.mark.parametrize(
    ("vessels", "message"),
    [
        ({"a": Vessel("a", straight()), "b": Vessel("b", straight())}, "no parent"),
        ({"a": Vessel("a", straight()), "b": Vessel("b", straight(), "c")}, "before"),
        ({"x": Vessel("a", straight())}, "filed under"),
        ({}, "at least one"),
    ],
)
def test_trees_need_parents_first_and_one_root(vessels, message):
    with pytest.raises(ValueError, match=message):
        VesselTree(vessels)


def test_one_point_is_projected_as_one_of_many():
    line = helix()
    points = line.points[::7] + np.random.RandomState(0).normal(0, 3e-3, (29, 3))
    many = line.project(points)
    for row, point in enumerate(points):
        for shape in ((3,), (1, 3)):
            found = line.project_rows(point.reshape(shape))
            assert found.distance.shape == shape[:-1]
            for one, other in zip(found, many, strict=True):
                assert one.item() == other[row]


def test_the_last_point_of_a_chunk_is_projected_as_alone(monkeypatch):
    line = helix()
    monkeypatch.setattr(centreline, "_CHUNK_ELEMENTS", 4 * (len(line.points) - 1))
    points = line.points[:13] + np.random.RandomState(1).normal(0, 3e-3, (13, 3))
    for count in (4, 5, 13):
        many = line.project_rows(points[:count])
        alone = line.project_rows(points[count - 1])
        for one, other in zip(alone, many, strict=True):
            assert one.item() == other[-1]


@pytest.mark.parametrize("factor", [0.4, 2.0])
def test_a_tree_is_scaled_with_its_radii_and_ostia(factor):
    plain, points = tree(), np.random.RandomState(0).uniform(-0.02, 0.08, (50, 3))
    scaled = plain.scaled(factor)
    for name, depth in plain.depths(points).items():
        found = scaled.depths(factor * points)[name]
        np.testing.assert_allclose(found, factor * depth, atol=1e-12)
        mouth, own = plain.vessel(name).mouth, scaled.vessel(name).mouth
        np.testing.assert_allclose(own.position, factor * mouth.position)
        assert own.radius == pytest.approx(factor * mouth.radius)
