"""The measured phantoms against their measurements."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.scan import topology
from cathsim_dmc.anatomy.surface import lumen_surface
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

MEASURED = Path(__file__).parent / "data/measured"
SCRIPT = Path(__file__).parents[1] / "docs/scripts/measured_phantoms.py"


def measurements(name):
    vessels = json.loads((MEASURED / f"{name}.json").read_text())["vessels"]
    return {key: np.array(vessel["points"]) * 1e-3 for key, vessel in vessels.items()}


@pytest.mark.parametrize("name", phantoms.MEASURED)
def test_centrelines_follow_the_measured_ones(name):
    tree = phantoms.load(name).tree
    found = measurements(name)
    assert tree.vessels.keys() == found.keys()
    away, back = [], []
    for key, points in found.items():
        line = tree.vessel(key).centreline
        away.append(line.project(points[:, :3]).distance)
        # The other way round: no detour between the points, beyond their chords.
        measured = type(line)(points[:, :3], points[:, 3])
        back.append(measured.project(line.points).distance)
    assert np.percentile(np.concatenate(away), 95) < 1e-3
    assert np.percentile(np.concatenate(back), 95) < 1e-3
    assert np.concatenate(away).max() < 1e-3


@pytest.mark.parametrize("name", phantoms.MEASURED)
def test_inscribed_spheres_have_the_measured_radii(name):
    """Where a branch is 3 mm clear of its parent, and 10 mm from the flat ends."""
    tree = phantoms.load(name).tree
    surface = lumen_surface(tree, 1e-3)
    depth = SurfaceDepth(surface)
    errors = []
    for key, points in measurements(name).items():
        vessel = tree.vessel(key)
        line = vessel.centreline
        s = line.project(points[:, :3]).arc_length
        start = 10e-3 if vessel.parent is None else vessel.ostium + 3e-3
        own = (s > start) & (s < line.length - 10e-3)
        errors.append(depth(line.at(s[own]).position) - points[own, 3])
    errors = np.abs(np.concatenate(errors))
    assert len(errors) > 60
    assert np.percentile(errors, 95) < 0.5e-3
    assert errors.mean() < 0.25e-3


def test_a_grid_coarser_than_the_lumen_tears_the_carotids_into_beads():
    torn = lumen_surface(phantoms.load("type2").tree, 2.2e-3)
    assert topology.parts(torn.faces.astype(np.int64)).max() > 0


def test_accesses_enter_at_the_two_ends_of_the_aorta():
    ascending = phantoms.load("type1")
    assert ascending is phantoms.load("type1", access="ascending")
    descending = phantoms.load("type1", access="descending")
    aorta = ascending.tree.root.centreline
    np.testing.assert_allclose(ascending.inlet.position, aorta.points[0])
    np.testing.assert_allclose(descending.inlet.position, aorta.points[-1])
    # The first millimetres lean most; the descending aorta stands.
    lean = np.degrees(np.arccos(ascending.inlet.direction[2]))
    assert lean == pytest.approx(43, abs=5)
    assert descending.inlet.direction[2] > 0.98
    assert [end.open for end in descending.ends].count(True) == 1
    assert ascending.goals.keys() == descending.goals.keys()
    np.testing.assert_array_equal(
        ascending.goal("lcca").position, descending.goal("lcca").position
    )


@pytest.mark.parametrize("name", phantoms.MEASURED)
def test_goals_lie_in_the_branches_they_are_named_after(name):
    anatomy = phantoms.load(name)
    for key in ("bca", "lcca", "lsa", "bca_fork2"):
        goal = anatomy.goal(key)
        vessel = anatomy.tree.vessel(key)
        depths = anatomy.tree.depths(goal.position)
        assert max(depths, key=depths.get) == key or key == "bca"
        assert depths["aorta"] < -2e-3
        past = goal.arc_length - vessel.ostium
        assert past == pytest.approx(27e-3, abs=1e-3) or (key == "bca" and past >= 9e-3)


def test_data_are_what_the_script_makes_of_the_measurements():
    spec = importlib.util.spec_from_file_location("measured_phantoms", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    for name in phantoms.MEASURED:
        shipped = json.loads((phantoms._DATA / f"{name}.json").read_text())
        again = script.tree_file(name)
        assert shipped["vessels"] == again["vessels"]
        assert shipped["inlets"] == again["inlets"]
        # Derived from splines, which other machines may round otherwise.
        for key, goal in again["goals"].items():
            assert shipped["goals"][key] == pytest.approx(goal, abs=0.1)


def test_unknown_names_list_the_known():
    with pytest.raises(ValueError, match="type1, type2, simple1, simple2, type3"):
        phantoms.load("type9")
    with pytest.raises(ValueError, match="ascending, descending"):
        phantoms.load("type1", access="radial")
