"""Anatomies from centrelines: splines, ostia, inlets, goals, and the JSON file."""

import copy
import json
import re
from pathlib import Path

import numpy as np
import pytest

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.builder import VesselPlace, default_goals
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.curves import Curve, smooth_tree
from cathsim_dmc.anatomy.tree_file import parse_tree, read_tree
from cathsim_dmc.validation.wall import field_error

BEND = 40.0  # mm


def helix(count=25):
    """A vessel that climbs as it turns, and its points at equal angles, mm."""
    angle = np.linspace(0.0, 2.2, count)
    return np.stack(
        [BEND * np.cos(angle), BEND * np.sin(angle), 20.0 * angle], axis=1
    ), angle


def content():
    points, _ = helix()
    side = points[12] + np.outer(np.linspace(0.0, 60.0, 11), [0.3, 0.5, 0.81])
    return {
        "format": "cathsim-vessel-tree",
        "version": 1,
        "name": "helix",
        "units": "mm",
        "frame": "LPS",
        "vessels": {
            "trunk": {
                "parent": None,
                "points_mm": points.tolist(),
                "radii_mm": [9.0] * len(points),
            },
            "side": {
                "parent": "trunk",
                "points_mm": side.tolist(),
                "radii_mm": [3.5] * len(side),
            },
        },
        "inlets": {
            "low": {"vessel": "trunk", "end": "first"},
            "high": {"vessel": "trunk", "end": "last"},
            "cut": {"vessel": "trunk", "arc_length_mm": 15.0},
            "side": {"vessel": "side", "end": "last"},
        },
        "goals": {
            "side": {"vessel": "side", "past_ostium_mm": 27.0},
            "far": {"vessel": "trunk", "arc_length_mm": 80.0},
            "free": {"vessel": "side", "position_mm": (side[8] + [1, 0, 0]).tolist()},
        },
    }


@pytest.mark.parametrize("access", ["low", "high", "cut", "side"])
def test_tree_along_a_space_curve_is_free_and_closed(access):
    anatomy = parse_tree(content()).build(access)
    assert np.percentile(field_error(anatomy), 99) < 0.02e-3
    assert [end.open for end in anatomy.ends].count(True) == 1
    entered = next(end for end in anatomy.ends if end.open)
    np.testing.assert_allclose(entered.position, anatomy.inlet.position)
    route = anatomy.route("far" if access == "side" else "side")
    np.testing.assert_allclose(route.points[0], anatomy.inlet.position, atol=1e-9)
    # The device goes in along the centreline.
    first = route.points[1] - route.points[0]
    assert first @ anatomy.inlet.direction > 0.99 * np.linalg.norm(first)


def test_spline_is_the_curve_and_the_ostium_is_on_the_wall():
    points, _ = helix()
    tree = smooth_tree(parse_tree(content()).curves)
    dense, _ = helix(2000)
    away = tree.vessel("trunk").centreline.project(dense * 1e-3).distance
    assert away.max() < 0.5e-3
    side = tree.vessel("side")
    place = side.centreline.at(side.ostium)
    near = tree.vessel("trunk").centreline.project(place.position)
    assert near.distance == pytest.approx(near.radius, abs=0.05e-3)
    # A flare of 1 mm that begins within the parent and is over soon after.
    radii = side.centreline.at(side.ostium + np.array([-1e-3, 10e-3])).radius
    assert 3.7e-3 < radii[0] <= 4.5e-3
    assert radii[1] == pytest.approx(3.5e-3, abs=0.05e-3)
    origin = tree.vessel("trunk").centreline.project(side.centreline.points[0])
    assert origin.distance < 1e-6


def test_radii_of_a_branch_within_its_parent_are_ignored():
    wide = content()
    wide["vessels"]["side"]["radii_mm"][:2] = [8.0, 8.0]  # 0 and 6 mm from the start
    found, plain = (
        smooth_tree(parse_tree(each).curves).vessel("side").centreline
        for each in (wide, content())
    )
    np.testing.assert_allclose(found.radii, plain.radii, atol=1e-6)


def test_smoothing_takes_away_scatter_of_the_measurement():
    points, angle = helix(41)
    noise = np.random.default_rng(0).normal(0.0, 0.2, points.shape)
    curve = Curve((points + noise) * 1e-3, np.full(len(points), 9e-3))
    dense, _ = helix(2000)
    rough, smooth = (
        line.project(dense * 1e-3).distance.mean()
        for line in (curve, smooth_tree({"a": curve}).root.centreline)
    )
    assert smooth < 0.8 * rough


def test_a_tree_in_ras_is_the_one_in_lps():
    there = content()
    for entry in (*there["vessels"].values(), there["goals"]["free"]):
        for name in {"points_mm", "position_mm"} & set(entry):
            entry[name] = (np.array(entry[name]) * [-1, -1, 1]).tolist()
    ras, lps = parse_tree(there | {"frame": "RAS"}), parse_tree(content())
    for name, curve in lps.curves.items():
        np.testing.assert_array_equal(ras.curves[name].points, curve.points)
    places = [tree.goals["free"].position for tree in (ras, lps)]
    np.testing.assert_array_equal(*places)


def test_cut_inlet_drops_what_lies_behind_it():
    whole, cut = (parse_tree(content()).build(access) for access in ("low", "cut"))
    lengths = [a.tree.root.centreline.length for a in (whole, cut)]
    assert lengths[0] - lengths[1] == pytest.approx(15e-3)
    for name in whole.goals:
        np.testing.assert_allclose(
            whole.goal(name).position, cut.goal(name).position, atol=1e-9
        )
    moved = whole.goal("far").arc_length - cut.goal("far").arc_length
    assert moved == pytest.approx(15e-3)
    behind = cut.inlet.position - 10e-3 * cut.inlet.direction
    assert whole.lumen(behind) > 0.0 > cut.lumen(behind)


def test_from_tree_sets_a_goal_in_each_branch():
    anatomy = Anatomy.from_tree(parse_tree(content()).curves, "helix")
    assert list(anatomy.goals) == ["side"]
    side = anatomy.tree.vessel("side")
    assert anatomy.goal("side").arc_length == pytest.approx(side.ostium + 27e-3)
    again = Anatomy.from_tree(
        anatomy.tree, "b", goals={"x": VesselPlace("trunk", arc_length=0.03)}
    )
    assert again.tree is anatomy.tree
    assert list(again.goals) == ["x"]


def test_a_goal_lies_before_the_fork_of_its_branch_and_before_its_end():
    def straight(start, way):
        share = np.linspace(0.0, 1.0, 41)[:, None]
        return Centreline(np.array(start) + share * way, np.full(41, 2e-3))

    lines = {
        "trunk": (straight([0, 0, 0], [0, 0, 0.1]), None),
        "arm": (straight([0, 0, 0.05], [0.08, 0, 0]), "trunk"),
        "twig": (straight([0.02, 0, 0.05], [0, 0.03, 0]), "arm"),
        "stub": (straight([0, 0, 0.08], [0, 0.011, 0]), "trunk"),
    }
    vessels = {
        name: Vessel(name, line, parent, 2e-3 if parent else 0.0)
        for name, (line, parent) in lines.items()
    }
    found = default_goals(VesselTree(vessels))
    places = {name: place.arc_length for name, place in found.items()}
    assert places == pytest.approx({"arm": 20e-3, "twig": 25e-3})


def change(path, value):
    """Content with another value in one place."""
    tree = target = content()
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    return tree


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        (change(["units"], "m"), "units is 'm'"),
        (change(["version"], 2), "version is 2"),
        (change(["version"], True), "version is True; it must be 1"),
        (change(["frame"], "LAS"), "one of LPS, RAS"),
        (change(["colour"], "red"), "some of format, version"),
        (change(["vessels"], {}), "at least one vessel"),
        (change(["vessels", "trunk"], {"parent": None}), "lacks points_mm, radii_mm"),
        (change(["vessels", "trunk", "radii_mm", 3], -1.0), "radii from -1"),
        (change(["vessels", "trunk", "radii_mm", 3], float("nan")), r"\[3\] is \[nan"),
        (change(["vessels", "trunk", "radii_mm", 3], True), r"\[3\] is \[True"),
        (change(["vessels", "trunk", "points_mm", 3], [1, 2]), "must be 3 numbers"),
        (change(["vessels", "trunk", "points_mm", 3], [1e5, 2, 3]), "millimetres"),
        (change(["vessels", "side", "radii_mm"], [3.5]), r"of shape \(1,\)"),
        (change(["vessels", "side", "parent"], "aorta"), "before it: trunk"),
        (change(["vessels", "side", "parent"], None), "before it: trunk"),
        (change(["vessels", "trunk", "radii_mm"], [0.009] * 25), "millimetres"),
        (change(["inlets", "low", "end"], "middle"), "first, last"),
        (change(["inlets", "side", "end"], "first"), "one of last"),
        (change(["inlets", "low", "arc_length_mm"], 3.0), "one of end, arc"),
        (change(["goals", "side", "vessel"], "lcca"), "one of trunk, side"),
        (change(["goals", "side"], {"vessel": "side"}), "give one of"),
        (change(["goals", "side", "past_ostium_mm"], "deep"), "from 0 to 2000 mm"),
    ],
)
def test_wrong_entries_are_named(tree, message):
    with pytest.raises(ValueError, match=message):
        parse_tree(tree)


SIDE = np.array(content()["vessels"]["side"]["points_mm"])
LATE = {"vessel": "trunk", "arc_length_mm": 54}


def side_points(points):
    return change(["vessels", "side", "points_mm"], np.array(points).tolist())


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        (side_points(SIDE + [0, 0, 60]), "'side' begins .* from the centreline of "),
        (change(["vessels", "side", "radii_mm"], [8.9] * 11), "of its parent's"),
        (side_points(helix(41)[0][20:31]), "'side' ends inside its parent"),
        (side_points(helix(41)[0][20:31] * [1.27, 1.27, 1.0]), "not part from|begins"),
        (change(["vessels", "trunk", "radii_mm"], [49.0] * 25), "would fold"),
        (change(["goals", "side", "past_ostium_mm"], 200.0), "is not on it"),
        (change(["goals", "free", "position_mm"], [0, 0, 0]), "outside vessel 'side'"),
        (change(["inlets", "low"], LATE), "ostium of branch 'side'"),
    ],
)
def test_impossible_trees_are_refused(tree, message):
    with pytest.raises(ValueError, match=message):
        parse_tree(tree).build("low")


def test_branches_that_meet_are_refused():
    tree = content()
    other = copy.deepcopy(tree["vessels"]["side"])
    start = np.array(helix()[0][15])
    target = np.array(tree["vessels"]["side"]["points_mm"][8])
    way = np.linspace(0.0, 1.3, 11)[:, None] * (target - start)
    other["points_mm"] = (start + way).tolist()
    tree["vessels"]["other"] = other
    with pytest.raises(ValueError, match="'side' and 'other'|'other' and 'side'"):
        parse_tree(tree).build("low")


def test_command_builds_and_refuses(tmp_path, cathsim):
    path = tmp_path / "tree.json"
    path.write_text(json.dumps(content()))
    out, other = tmp_path / "helix", tmp_path / "other"
    code, text, _ = cathsim("phantom", "build", path, "--out", out)
    assert code == 0
    assert "goals side, far, free" in text
    assert Anatomy.load(out).goals.keys() == {"side", "far", "free"}
    wrong = ("build", path, "--out", other, "--access", "x")
    code, _, error = cathsim("phantom", *wrong)
    assert code == 2
    assert "low, high, cut, side" in error
    path.write_text("{")
    code, _, error = cathsim("phantom", "build", path, "--out", other)
    assert code == 2
    assert "tree.json" in error
    assert not other.exists()
    with pytest.raises(FileNotFoundError):
        read_tree(tmp_path / "none.json")


def test_the_file_of_the_docs_builds():
    page = Path(__file__).parents[1] / "docs/anatomy_files.md"
    (text,) = re.findall(r"```json\n(.*?)```", page.read_text(), re.DOTALL)
    tree = parse_tree(json.loads(text))
    for access in tree.inlets:
        assert [*tree.build(access).goals] == ["bca", "other"]


def test_a_file_of_windows_is_read_and_what_is_no_json_is_named(tmp_path):
    path = tmp_path / "tree.json"
    text = json.dumps(content(), indent=1).replace("\n", "\r\n")
    path.write_text(text, encoding="utf-8-sig", newline="")
    assert read_tree(path).name == "helix"
    path.write_text("vessels:\n")
    with pytest.raises(ValueError, match="cannot be read as JSON.*tree of centrelines"):
        read_tree(path)
