"""The anatomy container: what is saved is read, every wrong entry has its message."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from cathsim_dmc import suite
from cathsim_dmc.anatomy import Anatomy, Goal, phantoms
from cathsim_dmc.anatomy.arch.arch import build_arch


@pytest.fixture(scope="module")
def anatomy():
    return phantoms.load("simple1")


@pytest.fixture(scope="module")
def saved(anatomy, tmp_path_factory):
    return anatomy.save(tmp_path_factory.mktemp("saved") / "a") / "anatomy.npz"


@pytest.fixture
def forged(saved, tmp_path):
    """Writes the anatomy anew after a change of its header and arrays."""

    def write(change) -> None:
        with np.load(saved) as archive:
            arrays = dict(archive)
        header = json.loads(str(arrays["header"]))
        change(header, arrays)
        if "header" in arrays:
            arrays["header"] = np.array(json.dumps(header))
        np.savez(tmp_path / "anatomy.npz", **arrays)

    return write


@pytest.mark.parametrize(
    ("tree", "options", "words"),
    [
        ("type1", {}, "^tree is 'type1'; it must be a Mapping"),
        ("lines", {}, "^vessel 'aorta' is .*; it must be a Curve"),
        (None, {"inlet": "bca"}, "^inlet is 'bca'; it must be a VesselPlace"),
        (None, {"goals": ["bca"]}, r"^goals is \['bca'\]; it must be a Mapping"),
        (None, {"goals": {"x": 3}}, "^goal 'x' is 3; it must be a VesselPlace"),
        (None, {"name": 3}, "^name is 3; it must be a text"),
    ],
)
def test_parts_of_a_tree_of_another_class_are_refused(anatomy, tree, options, words):
    lines = {name: one.centreline for name, one in anatomy.tree.vessels.items()}
    given = {None: anatomy.tree, "lines": lines}.get(tree, tree)
    with pytest.raises(ValueError, match=words):
        Anatomy.from_tree(given, **options)


def test_an_arch_is_built_from_parameters_alone():
    with pytest.raises(ValueError, match="^params is 'simple1'; it must be an Arch"):
        build_arch("simple1")


# Changes of the header and the arrays, and what the error says.
WRONG = {
    "unit": (lambda h, a: h.update(units="mm"), "'units': 'mm'.*write it again"),
    "version": (lambda h, a: h.update(version=99), "'version': 99.*write it again"),
    "name": (lambda h, a: h.update(name=3), "name is 3; it must be a text"),
    "vessel": (
        lambda h, a: h.update(vessels=["left"]),
        "an entry is wrong: .*mapping, not str",
    ),
    "field": (lambda h, a: h["inlet"].update(width=3.0), "is wrong: .*'width'"),
    "twice": (lambda h, a: h["goals"][1].update(name="bca"), "goals has a name twice"),
    "inlet text": (
        lambda h, a: h["inlet"].update(position="here"),
        "inlet position is 'here'; it must be 3 numbers, each a finite",
    ),
    "goal": (lambda h, a: h["goals"][0].update(vessel="renal"), "vessel is 'renal'"),
    "nan": (
        lambda h, a: a["surface_vertices"].put(5, np.nan),
        "vertices is .*finite numbers",
    ),
    "scanned": (lambda h, a: h.update(scanned="yes"), "scanned is 'yes'"),
    "shape": (
        lambda h, a: a.update(vessel_0_radii=a["vessel_0_radii"][:-1]),
        "radii is float64 of shape",
    ),
    "faces": (lambda h, a: a["surface_faces"].put(0, 10**8), "faces name vertices"),
    "pickle": (
        lambda h, a: a.update(vessel_0_radii=np.array([{}], dtype=object)),
        "allow_pickle",
    ),
    "missing": (lambda h, a: a.pop("surface_faces"), "lacks .*surface_faces"),
    "header": (lambda h, a: a.pop("header"), "lacks .*header"),
}


@pytest.mark.parametrize("fault", WRONG)
def test_a_wrong_entry_is_named_in_one_line(forged, tmp_path, fault):
    change, match = WRONG[fault]
    forged(change)
    with pytest.raises(ValueError, match=match) as error:
        Anatomy.load(tmp_path)
    assert "\n" not in str(error.value) and "anatomy.npz" in str(error.value)


def test_round_trip(anatomy, saved):
    again = Anatomy.load(saved.parent)
    assert again.name == anatomy.name
    np.testing.assert_array_equal(again.surface.faces, anatomy.surface.faces)
    points = np.random.default_rng(0).uniform(-0.05, 0.2, (200, 3))
    np.testing.assert_array_equal(again.lumen(points), anatomy.lumen(points))
    assert again.goals.keys() == anatomy.goals.keys()
    np.testing.assert_array_equal(again.inlet.direction, anatomy.inlet.direction)
    assert [end.open for end in again.ends] == [end.open for end in anatomy.ends]


def test_saving_again_replaces_the_file(anatomy, tmp_path):
    anatomy.save(tmp_path)
    phantoms.load("simple2").save(tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    assert Anatomy.load(tmp_path).name == "simple2"


def test_damage_is_found(saved, tmp_path):
    data = bytearray(saved.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "anatomy.npz").write_bytes(data)
    with pytest.raises(ValueError, match="CRC|decompress"):
        Anatomy.load(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no anatomy\.npz .*Anatomy.save"):
        Anatomy.load(tmp_path / "nothing")


def test_route_starts_at_the_inlet_and_ends_at_the_goal(anatomy):
    route = anatomy.route("lcca")
    np.testing.assert_allclose(route.points[0], anatomy.inlet.position, atol=1e-9)
    goal = anatomy.goal("lcca").position
    np.testing.assert_allclose(route.points[-1], goal, atol=1e-9)
    assert anatomy.lumen(route.points[1:-1]).min() > 0.0


def test_triangles_of_a_tree_are_built_when_they_are_asked_for():
    (arch,) = suite.load_arches(pool=1, first=40)
    assert "surface" not in vars(arch)
    assert pickle.loads(pickle.dumps(arch)).surface.volume == arch.surface.volume > 0


def test_names_and_shapes_are_checked(anatomy):
    with pytest.raises(ValueError, match="bca, lcca, lsa, descending"):
        anatomy.goal("renal")
    with pytest.raises(ValueError, match="vessel is 'rca'"):
        goal = Goal("rca", "rca", [0, 0, 0], 0.0)
        Anatomy("x", anatomy.tree, anatomy.inlet, {"rca": goal})
