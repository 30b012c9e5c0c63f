"""Triangles of a lumen, and lattice points inside it."""

import numpy as np
import pytest

from cathsim_dmc.anatomy import geodesic, phantoms, surface
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.scan import topology
from cathsim_dmc.anatomy.tree_depth import TreeDepth


def cylinder(radius=0.01, length=0.1):
    line = Centreline([[0, 0, 0], [0, 0, length / 2], [0, 0, length]], [radius] * 3)
    return VesselTree({"aorta": Vessel("aorta", line)})


@pytest.mark.parametrize(
    "name",
    [pytest.param("type1", marks=pytest.mark.slow), "type2", "simple1", "bovine"],
)
def test_surface_is_closed_points_outwards_and_follows_the_lumen(name):
    anatomy = phantoms.load(name)
    found = anatomy.surface
    assert len(found.faces) < 40_000
    faces = found.faces.astype(np.int64)
    assert (topology.edge_counts(faces)[1] == 2).all()
    assert (topology.parts(faces) == 0).all()
    assert found.volume > 0.0
    measure = TreeDepth(anatomy.tree)
    assert np.percentile(np.abs(measure(found.vertices)), 95) < 0.3e-3
    # Volume of the tubes from Monte Carlo points in the bounding box.
    low, high = found.vertices.min(axis=0), found.vertices.max(axis=0)
    points = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    expected = (measure(points) > 0.0).mean() * np.prod(high - low)
    assert found.volume == pytest.approx(expected, rel=0.07)


def test_surface_spacing_must_be_positive():
    with pytest.raises(ValueError, match="spacing"):
        surface.lumen_surface(cylinder(), 0.0)


def test_lattice_points_inside_are_all_found():
    low, spacing, shape = np.array([-1.3, -1.2, -1.1]), 0.1, np.array([27, 25, 23])
    depth = lambda points: 1.0 - np.linalg.norm(points, axis=1)  # noqa: E731
    ijk, found = geodesic.inside(depth, low, shape, spacing, above=0.15)
    every = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    exact = depth((low + spacing * every).reshape(-1, 3))
    assert len(ijk) == (exact > 0.15).sum() and found.min() > 0.15
    np.testing.assert_allclose(depth(low + spacing * ijk), found)
