"""Scans that are no adult arch: trees of other vessels, children, short models."""

import functools

import import_cases
import import_trees
import numpy as np
import pytest
import synthetic_scans
from synthetic_scans import marched, write_obj, y_tree

from cathsim_dmc.anatomy.centreline import Vessel, VesselTree
from cathsim_dmc.anatomy.parts import Inlet, Surface
from cathsim_dmc.anatomy.scan import units
from cathsim_dmc.anatomy.scan.extract import trunk
from cathsim_dmc.anatomy.scan.growth import THINNEST
from cathsim_dmc.anatomy.scan.importer import import_scan
from cathsim_dmc.anatomy.scan.left_out import left_out, said
from cathsim_dmc.anatomy.scan.lumen import enlargement, guess_units
from cathsim_dmc.anatomy.scan.places import resized
from cathsim_dmc.anatomy.scan.ways import Ways
from cathsim_dmc.anatomy.surface import lumen_surface
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth
from cathsim_dmc.entities.devices import DEVICES

tube = functools.partial(synthetic_scans.tube, step=0.5e-3)


def imported(folder, tree, spacing, **options):
    """The anatomy of a tree's surface, and what was noted."""
    notes = []
    path = write_obj(folder / "lumen.obj", *marched(tree, spacing))
    return import_scan(path, notes=notes, **options), " | ".join(notes)


@pytest.mark.slow
def test_a_carotid_has_a_trunk_that_can_be_renamed(tmp_path):
    """CCA and ICA together are no aorta, and each of the three has its goal."""
    vessels = {
        "cca": Vessel("cca", tube([(0, 0, 0), (0, 0, 40)], [3.2, 3.2])),
        "ica": Vessel(
            "ica", tube([(0, 0, 39), (-5, 2, 55), (-8, 2, 85)], [3, 2.6, 2.5]), "cca"
        ),
        "eca": Vessel(
            "eca", tube([(0, 0, 39), (6, -2, 52), (9, -2, 80)], [2.5, 2, 2]), "cca"
        ),
    }
    rename = {"trunk": "cca", "branch_1": "one"}
    anatomy, notes = imported(tmp_path, VesselTree(vessels), 0.8e-3, rename=rename)
    assert set(anatomy.tree.vessels) == {"cca", "one", "branch_2"}
    assert {vessel.parent for vessel in anatomy.tree.vessels.values()} == {None, "cca"}
    assert {"one", "branch_2"} <= set(anatomy.goals)
    assert "trunk is renamed cca" in notes and "axes" not in notes
    assert anatomy.tree.root.centreline.length == pytest.approx(38e-3, abs=6e-3)
    for name in ("one", "branch_2"):
        goal = anatomy.goals[f"{name}_distal"]
        room = anatomy.goal_room(goal)
        between = goal.arc_length - anatomy.goals[name].arc_length
        assert room == pytest.approx(between)


@pytest.mark.slow
def test_a_single_tube_is_a_trunk_with_a_goal(tmp_path):
    line = tube([(0, 0, 0), (8, 2, 30), (-4, 6, 60), (4, 0, 90)], [4, 4, 4, 4])
    anatomy, notes = imported(tmp_path, VesselTree({"v": Vessel("v", line)}), 1.2e-3)
    assert list(anatomy.tree.vessels) == list(anatomy.goals) == ["trunk"]
    assert line.project(anatomy.goals["trunk"].position).distance < 1e-3
    assert anatomy.goals["trunk"].arc_length > 0.7 * anatomy.tree.root.centreline.length
    assert "left out" not in notes and "arch recognised" in notes


def test_a_trunk_ends_where_an_even_fork_parts_it():
    """A thin side branch does not end it."""
    vessels = {
        "stem": Vessel("stem", tube([(0, 0, 0), (0, 0, 80)], [9, 9])),
        "renal": Vessel("renal", tube([(0, 0, 30), (50, 0, 30)], [3, 3]), "stem"),
        "left": Vessel("left", tube([(0, 0, 78), (30, 0, 130)], [6, 6]), "stem"),
        "right": Vessel("right", tube([(0, 0, 78), (-30, 0, 130)], [6, 6]), "stem"),
    }
    ways = Ways(SurfaceDepth(lumen_surface(VesselTree(vessels), 2e-3)))
    before = ways.deepest_from(ways.node(np.zeros(3)))
    ends = [vessels[k].centreline.points[-1] for k in ("left", "right", "renal")]
    curves = [ways.points[ways.trace(before, ways.node(end))] for end in ends]
    end, leaving = trunk(ways, curves)
    assert end[2] == pytest.approx(80e-3, abs=12e-3) and len(leaving) == 3
    end, leaving = trunk(ways, [curves[0], curves[2]])
    assert np.linalg.norm(end - ends[0]) < 4e-3 and len(leaving) == 1


def test_what_a_tree_lacks_is_told_with_place_width_and_length():
    whole = y_tree()
    ways = Ways(SurfaceDepth(lumen_surface(whole, 1.5e-3)))
    assert left_out(ways, whole) == []
    part = VesselTree({k: whole.vessel(k) for k in ("trunk", "left")})
    (one,) = left_out(ways, part)
    own = whole.vessel("right").centreline
    assert own.project(one.position).distance < 3.5e-3
    assert one.width == pytest.approx(6e-3, abs=1e-3)
    assert 20e-3 < one.length < 45e-3
    note = said([one], "5 Fr catheter", 0.84e-3)
    assert note is not None
    assert "a vessel is left out for the 5 Fr catheter: (" in note
    assert f"{1e3 * one.width:.1f} mm wide, {1e3 * one.length:.0f} mm long" in note
    assert said([], "5 Fr catheter", 0.84e-3) is None
    thin = said([one], "5 Fr catheter", 4e-3)
    assert thin is not None and "too thin" in thin


@pytest.mark.parametrize("units", ["mm", "cm", "m"])
@pytest.mark.parametrize(
    ("wide", "long"),
    [(3.3, 19), (3.6, 90), (6.4, 100), (15, 110), (19, 250), (24, 205), (24, 640)],
)
def test_units_are_right_or_asked(wide, long, units):
    """Cerebral, coronary and carotid arteries, a child's and other arches."""
    import trimesh

    side = [(wide / 2, z) for z in np.arange(0.0, long, wide / 5)]
    mesh = trimesh.creation.revolve([(0.0, 0.0), *side, (0.0, long)], sections=24)
    scale = {"mm": 1.0, "cm": 0.1, "m": 1e-3}[units]
    vertices = scale * np.asarray(mesh.vertices)
    try:
        found = guess_units("tube", vertices, np.asarray(mesh.faces), None)[0]
    except ValueError as error:
        assert "may be in several units" in str(error) and repr(units) in str(error)
    else:
        assert found == units


def test_small_lumens_are_enlarged():
    assert enlargement(12e-3, 100e-6) == enlargement(8e-3, 100e-6) == 1.0
    assert enlargement(3e-3, 3e-6) == pytest.approx(4.0)
    assert enlargement(2e-3, 50e-6) == pytest.approx(2.0)  # or it would take long
    assert enlargement(float("nan"), 1e-6) == 1.0


def test_what_is_said_of_an_enlarged_lumen_has_the_size_of_the_patient():
    with units.file_frame(units.to_lps("cm", "RAS"), "cm", 4.0):
        assert units.mm(0.02) == pytest.approx(5.0)
        assert units.shown(np.array([0.02, -0.04, 0.08])) == "(-0.5, 1.0, 2.0) cm"
    assert units.mm(0.02) == 20.0


def test_an_inlet_is_made_smaller_with_its_lumen():
    tree = y_tree()
    inlet = Inlet("trunk", [0.0, 0.0, 0.02], [0.0, 0.0, 1.0], 6e-3)
    sheet = Surface(np.eye(3), np.array([[0, 1, 2]]))
    found, small, surface = resized(tree, inlet, sheet, 0.25)
    np.testing.assert_allclose(small.position, [0.0, 0.0, 0.005])
    np.testing.assert_allclose(small.direction, inlet.direction)
    assert small.radius == pytest.approx(1.5e-3)
    np.testing.assert_allclose(surface.vertices, 0.25 * np.eye(3))
    length = tree.root.centreline.length
    assert found.root.centreline.length == pytest.approx(0.25 * length)


def test_the_thinnest_device_is_that_of_the_library():
    thinnest = min(DEVICES.values(), key=lambda device: device.outer_radius)
    assert THINNEST.outer_radius == pytest.approx(thinnest.outer_radius)
    assert thinnest.name in THINNEST.name


def basilar_tip():
    """An intracranial tree, 20 mm across."""
    sides = [[(0, 0, 11.6), (side * 3, 1, 13), (side * 6, 3, 13)] for side in (1, -1)]
    vessels = {"basilar": Vessel("basilar", tube([(0, 0, 0), (0, 0, 12)], [1.65] * 2))}
    for name, way in zip(("left", "right"), sides, strict=True):
        vessels[name] = Vessel(name, tube(way, [1.2] * 3), "basilar")
    return VesselTree(vessels)


def test_the_unit_of_a_small_intracranial_tree_is_asked_for(tmp_path):
    """In cm it would be as wide as an aneurysm of the aorta."""
    with pytest.raises(ValueError, match=r"several units: mm makes .*; cm makes"):
        imported(tmp_path, basilar_tip(), 0.4e-3)


@pytest.mark.slow
def test_a_small_intracranial_tree_has_neutral_names(tmp_path):
    anatomy, notes = imported(tmp_path, basilar_tip(), 0.4e-3, units="mm")
    assert set(anatomy.tree.vessels) == {"trunk", "branch_1", "branch_2"}
    assert {"branch_1", "branch_2"} <= set(anatomy.goals)
    assert "axes" not in notes and "bovine" not in notes


@pytest.mark.slow
def test_winding_iliacs_are_no_arch_and_stand_upright(tmp_path):
    vessels = {"aorta": Vessel("aorta", tube([(0, 0, 120), (0, 0, 0)], [9, 8.5]))}
    for name, side in (("left", 1), ("right", -1)):
        way = [(0, 0, 2), (25, 5, -30), (45, 30, -20), (40, 45, -60), (36, 32, -100)]
        way = [(side * x, y, z) for x, y, z in way]
        vessels[name] = Vessel(name, tube(way, [5, 4.5, 4.5, 4.5, 4.5]), "aorta")
    anatomy, notes = imported(tmp_path, VesselTree(vessels), 1.5e-3)
    assert set(anatomy.tree.vessels) == {"trunk", "branch_1", "branch_2"}
    assert {"branch_1", "branch_2"} <= set(anatomy.goals)
    assert "axes" not in notes


@pytest.mark.slow
@pytest.mark.parametrize("length", [18e-3, 26e-3])
def test_short_head_branches_are_named(length, tmp_path):
    """They are cut past the aorta's wall, as models for flow are."""
    change = tuple((name, length) for name in ("bca", "lcca", "lsa"))
    case = import_cases.Case("branch cut short", "I", 7, change=change)
    anatomy, _ = imported(tmp_path, import_cases.truth(case), 1.6e-3)
    assert {"aorta", "bca", "lcca", "lsa"} == set(anatomy.tree.vessels)
    assert {"bca", "lcca", "lsa", "aorta"} <= set(anatomy.goals)


@pytest.mark.slow
def test_a_childs_arch_is_one_by_its_shape(tmp_path):
    case = import_cases.Case("remeshed", "I", 7)
    anatomy, notes = imported(tmp_path, import_cases.truth(case).scaled(0.4), 0.8e-3)
    assert {"aorta", "bca", "lcca", "lsa"} == set(anatomy.tree.vessels)
    assert "--axes" not in notes


@pytest.mark.slow
def test_a_ring_keeps_both_arms(tmp_path):
    """Two arms of 3.2 mm radius, 30 mm apart, which join again."""
    vessels = {
        "stem": Vessel("stem", tube([(0, 0, 0), (0, 0, 40)], [4, 4])),
        "end": Vessel("end", tube([(0, 0, 130), (0, 0, 180)], [4, 4]), "stem"),
    }
    for name, x in (("left", 15), ("right", -15)):
        way = [(0, 0, 39), (x, 0, 65), (x, 0, 105), (0, 0, 131)]
        vessels[name] = Vessel(name, tube(way, [3.2] * 4), "stem")
    tree = VesselTree(vessels)
    anatomy, notes = imported(tmp_path, tree, 1.2e-3)
    for name in ("left", "right"):
        own = tree.vessel(name).centreline.slice(15e-3, 75e-3)
        near = [
            vessel.centreline.project(own.points).distance
            for vessel in anatomy.tree.vessels.values()
        ]
        assert np.min(near, axis=0).max() < 2e-3, name
    assert "left out" not in notes


FAST = ("tube",)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=() if case.kind in FAST else pytest.mark.slow)
        for case in import_trees.cases()[8:16]
    ],
    ids=lambda case: case.kind,
)
def test_trees_that_are_no_arches(case):
    """Every vessel is in the tree or in a note, and nothing is named as in an arch."""
    row = import_trees.run(case)
    assert not row.get("refused"), row["said"]
    assert row["scale_right"] and row["goals"]
    assert row["missing"] == [] and row["arch"] == [] and not row["axes"]


def test_the_truth_of_generated_trees_is_whole():
    cases = import_trees.cases()
    assert len(cases) == 48 and len({case.name for case in cases}) == 48
    tree = import_trees.truth(cases[0])
    surface = import_trees.surface(cases[0], tree)
    assert 2_500 < len(surface.faces) <= 3_000
    depth = SurfaceDepth(surface)
    for vessel in tree.vessels.values():
        inner = vessel.centreline.points[3:-3]
        assert depth(inner).min() > -0.3e-3, vessel.name
