"""The anatomy container."""

import pickle

import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.parts import Goal


@pytest.fixture(scope="module")
def anatomy():
    return phantoms.load("simple1")


def test_route_starts_at_the_inlet_and_ends_at_the_goal(anatomy):
    route = anatomy.route("lcca")
    np.testing.assert_allclose(route.points[0], anatomy.inlet.position, atol=1e-9)
    goal = anatomy.goal("lcca").position
    np.testing.assert_allclose(route.points[-1], goal, atol=1e-9)
    assert anatomy.depth(route.points[1:-1]).min() > 0.0


def test_triangles_of_a_tree_are_built_when_they_are_asked_for():
    (arch,) = suite.load_arches(pool=1, first=40)
    assert "vertices" not in vars(arch.surface)
    assert pickle.loads(pickle.dumps(arch)).surface.volume == arch.surface.volume > 0


def test_names_and_shapes_are_checked(anatomy):
    with pytest.raises(ValueError, match="bca, lcca, lsa, descending"):
        anatomy.goal("renal")
    with pytest.raises(ValueError, match="no vessel 'rca'"):
        Anatomy(
            "x",
            anatomy.tree,
            anatomy.surface,
            anatomy.inlet,
            {"rca": Goal("rca", "rca", [0, 0, 0], 0.0)},
        )
