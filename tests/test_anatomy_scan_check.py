"""The checks of a vessel tree, each against a lumen or vessels of a formula."""

import re
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_scans import tube

from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.parts import Goal
from cathsim_dmc.anatomy.scan import check


def test_a_small_tree_is_checked_by_limits_of_its_size():
    """A tenth of a phantom; its line may not leave the lumen by 0.04 mm."""
    small = check._enlarged(phantoms.load("simple1", access="descending"), 0.1)
    assert not any(check.check_tree(small).values())
    lcca = small.tree.vessel("lcca")
    points = lcca.centreline.points + (0.0, 0.34e-3, 0.0)  # of a radius of 0.3 mm
    beside = replace(lcca, centreline=replace(lcca.centreline, points=points))
    tree = VesselTree({**small.tree.vessels, "lcca": beside})
    found = check.check_tree(replace(small, tree=tree, goals={}))
    assert found["centrelines in the lumen"].startswith("lcca leaves the lumen")


def test_branches_are_checked_against_radius_and_ostium():
    """A start outside of the parent; 22 mm in the lumen of another branch."""

    def line(radius, *corners):
        parts = [np.linspace(a, b, 40) for a, b in pairwise(np.array(corners))]
        points = np.concatenate(parts) * 1e-3
        keep = np.append(True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 0)
        return Centreline(points[keep], np.full(keep.sum(), radius * 1e-3))

    root = Vessel("aorta", line(5.0, (0.0, 0, 0), (0, 0, 100)))

    def found(look, *branches):
        tree = VesselTree({one.name: one for one in (root, *branches)})
        return list(look(SimpleNamespace(tree=tree), None))

    for off in (4.9, 5.1):
        one = Vessel("b", line(2.0, (off, 0, 50), (off + 40, 0, 50)), "aorta", 1e-3)
        said = found(check._parents, one)
        assert bool(said) == (off > 5.0)
    assert said[0].startswith("b starts 5.1 mm from the centreline of aorta")
    path = line(2.0, (0.0, 0, 50), (60, 0, 50))
    both = Vessel("c", line(2.0, (0.0, 0, 50), (22, 0, 50), (40, 0, 90)), "aorta", 0.0)
    for ostium in (25e-3, 1e-3):
        said = found(check._own_lumen, Vessel("b", path, "aorta", ostium), both)
        assert any(each.startswith("c runs") for each in said) == (ostium < 22e-3)
    # Off its middle by less than half of the wider radius, but not of the other.
    wide = Vessel("c", line(4.0, (0.0, 1.5, 50), (60, 1.5, 50)), "aorta", 6e-3)
    one = Vessel("b", path, "aorta", 6e-3)
    assert not found(check._own_lumen, one, wide)


@pytest.mark.parametrize(
    ("volume", "radii", "words"),
    [
        (100, (46, 3, 3), ""),  # its own lumen begins at the ostium
        (0.01, (9, 3, 3), "holds 0.01 ml .*: the unit is wrong"),
        (3000, (9, 3, 3), "holds 3e.03 ml .*: the unit is wrong"),
        (100, (9, 0.2, 0.2), r"b has a radius of 0.2 mm.*one \(--units\)"),
        (100, (9, 31, 31), r"b has a radius of 31 mm.*one \(--units\)"),
        (100, (9, 3, 46), r"b has a radius of 24.5 mm.*one \(--units\)"),
    ],
)
def test_volume_and_radii_that_no_vessel_has_are_told(volume, radii, words):
    points = np.linspace(0.0, 0.04, 3)[:, None] * (0, 0, 1)
    line = Centreline(points, 1e-3 * np.array(radii, float))
    tree = SimpleNamespace(vessels={"b": Vessel("b", line, "aorta", 10e-3)})
    surface = SimpleNamespace(volume=1e-6 * volume)
    said = "; ".join(check._sizes(SimpleNamespace(tree=tree, surface=surface)))
    assert re.fullmatch(words, said) or (words and re.search(words, said)), said


def test_lumen_goals_and_inlet_are_checked_against_the_depth():
    """A tube of 4 mm along z in a lumen whose depth is a formula (mm)."""
    line = tube([(0, 0, 0), (0, 0, 100)], [4, 4])
    tree = VesselTree({"b": Vessel("b", line)})

    def found(look, depth, tree=tree, **others):
        measure = lambda points: 1e-3 * depth(1e3 * points[..., 2])  # noqa: E731
        return list(look(SimpleNamespace(tree=tree, **others), measure))

    # A narrow place may cut into the line by 0.05 mm.
    for narrow, told in ((-0.04, False), (-0.06, True)):
        depth = lambda z, d=narrow: np.where(abs(z - 80) < 2, d, 4.0)  # noqa: E731
        said = found(check._inside, depth)
        assert bool(said) == told
    assert re.fullmatch(r"b leaves the lumen (78|79|8.) mm .*, by 0.1 mm", said[0])
    # Past another vessel's lumen, and on to the end of its own.
    beyond = lambda z: np.where(z < 100, 4.0, 100.0 - z)  # noqa: E731
    for way, told in ((-1.0, False), (1.0, True)):
        where = {"vessel": "b", "radius": 10e-3, "position": np.array((0, 0, 0.098))}
        inlet = SimpleNamespace(direction=np.array((0, 0, way)), **where)
        assert bool(found(check._inlet, beyond, inlet=inlet)) == told
    # A goal in the middle of a wider vessel.
    wide = Vessel("wide", tube([(-60, 0, 50), (60, 0, 50)], [9, 9]))
    both = VesselTree({"wide": wide, "b": Vessel("b", line, "wide", 9e-3)})
    goals = {"b": Goal("b", "b", np.array((0, 0, 0.05)), 0.05)}
    said = found(check._goals, lambda z: 0 * z + 4.0, both, goals=goals)
    assert said == ["b lies in wide, not in b"]


@pytest.mark.parametrize(
    ("radius", "left", "joined", "told"),
    [(5, 30, False, True), (5, 30, True, False), (1.3, 20, False, False)],
    ids=["cut short", "in another", "a thin tail"],
)
def test_where_a_lumen_goes_on_a_vessel_does_not_end(radius, left, joined, told):
    """A tube along z whose lumen goes on by `left` mm, or on in another vessel."""

    def depth(points):
        past = np.maximum(points[..., 2] - (0.1 + 1e-3 * left), -points[..., 2])
        return 1e-3 * radius - np.hypot(np.hypot(*points.T[:2]), np.maximum(past, 0))

    radii = [radius, radius]
    vessels = {"a": Vessel("a", tube([(0, 0, 0), (0, 0, 100)], radii))}
    far = tube([(50, 0, 0), (50, 0, 40)], radii)
    vessels["far"] = Vessel("far", far, "a", 0.0)
    if joined:
        on = tube([(0, 0, 101), (0, 0, 131)], radii)
        vessels["on"] = Vessel("on", on, "far", 0.0)
    tree = VesselTree(vessels)
    said = list(check._free_ends(SimpleNamespace(tree=tree), depth))
    assert [each.startswith("a ends at ") for each in said] == [True] * told


@pytest.mark.parametrize(("apart", "tells"), [(50, False), (70, True)])
def test_arms_that_end_near_each_other_tell_no_sides(apart, tells):
    """The left one to the right of the other."""
    vessels = {}
    for name, x, z in (("rsa", apart, 50), ("lsa", 0, 110)):
        points = 1e-3 * np.array([[0.0, 0, 0], [x, 0, z]])
        vessels[name] = SimpleNamespace(centreline=SimpleNamespace(points=points))
    tree = SimpleNamespace(vessels=vessels)
    said = list(check._arms(SimpleNamespace(tree=tree)))
    assert bool(said) == tells
