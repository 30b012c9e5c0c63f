"""The anatomy container and its files."""

import json

import numpy as np
import pytest

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.arch import arch
from cathsim_dmc.anatomy.parts import Goal, Inlet, Surface


@pytest.fixture(scope="module")
def anatomy():
    return arch.load("simple1")


def test_round_trip(anatomy, tmp_path):
    anatomy.save(tmp_path / "a")
    again = Anatomy.load(tmp_path / "a")
    assert again.name == anatomy.name
    np.testing.assert_array_equal(again.surface.faces, anatomy.surface.faces)
    points = np.random.default_rng(0).uniform(-0.05, 0.2, (200, 3))
    np.testing.assert_array_equal(again.depth(points), anatomy.depth(points))
    assert again.goals.keys() == anatomy.goals.keys()
    np.testing.assert_array_equal(again.inlet.direction, anatomy.inlet.direction)
    assert [end.open for end in again.ends] == [end.open for end in anatomy.ends]


def test_saving_again_leaves_one_geometry(anatomy, tmp_path):
    anatomy.save(tmp_path)
    arch.load("simple2").save(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    assert Anatomy.load(tmp_path).name == "simple2"


def test_damage_is_found(anatomy, tmp_path):
    anatomy.save(tmp_path)
    geometry = next(tmp_path.glob("geometry-*.npz"))
    data = bytearray(geometry.read_bytes())
    data[len(data) // 2] ^= 1
    geometry.write_bytes(data)
    with pytest.raises(ValueError, match="checksum"):
        Anatomy.load(tmp_path)
    geometry.unlink()
    with pytest.raises(ValueError, match="missing"):
        Anatomy.load(tmp_path)
    description = tmp_path / "anatomy.json"
    description.write_text(description.read_text()[:50])
    with pytest.raises(ValueError, match="damaged"):
        Anatomy.load(tmp_path)
    description.write_text(json.dumps({"format": "cathsim-anatomy", "version": 99}))
    with pytest.raises(ValueError, match="version"):
        Anatomy.load(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"anatomy\.json"):
        Anatomy.load(tmp_path / "nothing")


def test_route_starts_at_the_inlet_and_ends_at_the_goal(anatomy):
    route = anatomy.route("lcca")
    np.testing.assert_allclose(route.points[0], anatomy.inlet.position, atol=1e-9)
    goal = anatomy.goal("lcca").position
    np.testing.assert_allclose(route.points[-1], goal, atol=1e-9)
    assert anatomy.depth(route.points[1:-1]).min() > 0.0


def test_names_and_shapes_are_checked(anatomy):
    with pytest.raises(ValueError, match="bca, lcca, lsa, descending"):
        anatomy.goal("renal")
    with pytest.raises(ValueError, match="there are 3"):
        Surface(np.zeros((3, 3)), [[0, 1, 3]])
    with pytest.raises(ValueError, match="direction"):
        Inlet("aorta", [0, 0, 0], [0, 0, 0], 0.01)
    with pytest.raises(ValueError, match="no vessel 'rca'"):
        Anatomy(
            "x",
            anatomy.tree,
            anatomy.surface,
            anatomy.inlet,
            {"rca": Goal("rca", "rca", [0, 0, 0], 0.0)},
        )
