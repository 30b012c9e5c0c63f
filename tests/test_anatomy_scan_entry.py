"""Where an import enters a lumen, where its goals lie, and what it leaves out."""

import functools
import re
from types import SimpleNamespace

import numpy as np
import pytest
import synthetic_scans
from synthetic_scans import marched, write_markup, write_obj, y_tree

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.parts import Goal, Inlet, Surface
from cathsim_dmc.anatomy.scan import extract, importer
from cathsim_dmc.anatomy.scan.ends import free_ends
from cathsim_dmc.anatomy.scan.extract import plan_inlet, trunk
from cathsim_dmc.anatomy.scan.importer import import_scan
from cathsim_dmc.anatomy.scan.left_out import left_out
from cathsim_dmc.anatomy.scan.naming import renamed
from cathsim_dmc.anatomy.scan.places import (
    describe,
    opened_at_inlet,
    passable_length,
    place_goals,
)
from cathsim_dmc.anatomy.scan.ways import Ways
from cathsim_dmc.anatomy.surface import lumen_surface
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

tube = functools.partial(synthetic_scans.tube, step=0.5e-3)


def ways_of(vessels, spacing=1.5e-3):
    return Ways(SurfaceDepth(lumen_surface(VesselTree(vessels), spacing)))


def sac(start, direction, radius):
    """A ball of a radius (mm) whose wall is at a place: a line of its widths."""
    s = np.linspace(0.05, 1.95, 20)
    points = np.array(start) + radius * s[:, None] * np.array(direction)
    return tube(points, radius * np.sqrt(1.0 - (1.0 - s) ** 2))


def test_an_aneurysm_is_no_inlet():
    """At the tip of the basilar artery: wider than the artery, and as long as wide."""
    arms = {
        name: Vessel(
            name, tube([(0, 0, 60), (side * 20, 0, 66), (side * 60, 0, 60)], [3.5] * 3)
        )
        for name, side in (("left", 1), ("right", -1))
    }
    vessels = {"trunk": Vessel("trunk", tube([(0, 0, 0), (0, 0, 64)], [5, 5]))}
    vessels |= {k: Vessel(k, v.centreline, "trunk", 5e-3) for k, v in arms.items()}
    dome = Vessel("dome", sac((0, 0, 62), (0, 0, 1), 12.0), "trunk", 5e-3)
    ways = ways_of({**vessels, "dome": dome})
    ends = free_ends(ways)
    widest = max(ends, key=lambda end: end.bottleneck)
    assert widest.position[2] > 75e-3
    entry = plan_inlet(ways, ends, [], None)
    assert entry.sacs == (widest,)
    assert np.linalg.norm(entry.position) < 8e-3
    # Who wants to enter there says so.
    given = plan_inlet(ways, ends, [], widest.position)
    assert given.sacs == () and given.position is widest.position
    # A vessel that leads on as wide is one, however thin its branches are.
    stem = Vessel("trunk", tube([(0, 0, 0), (0, 0, 64)], [12, 12]))
    ways = ways_of({**vessels, "trunk": stem})
    entry = plan_inlet(ways, free_ends(ways), [], None)
    assert entry.sacs == () and np.linalg.norm(entry.position) < 18e-3


@pytest.mark.parametrize("beside", [18, 24])
def test_an_aorta_ends_at_its_root_though_coronaries_leave_beside_it(beside):
    aorta = tube([(0, 0, 0), (0, 0, 60), (0, 0, 200)], [15, 14, 11])
    left = tube([(0, 0, beside), (30, 0, beside), (45, 0, -50)], [2.2, 2.2, 2])
    right = tube([(0, 0, beside), (-30, 0, beside), (-45, 0, -50)], [2.2, 2.2, 2])
    vessels = {
        "aorta": Vessel("aorta", aorta),
        "left": Vessel("left", left, "aorta", 15e-3),
        "right": Vessel("right", right, "aorta", 15e-3),
    }
    ends = free_ends(ways_of(vessels))
    assert len(ends) == 4
    root = min(ends, key=lambda end: np.linalg.norm(end.position))
    assert np.linalg.norm(root.position) < 16e-3 and root.bottleneck > 12e-3


def test_a_trunk_whose_fork_is_beside_the_inlet_leads_on():
    """No device could turn into a branch there; a fork farther on ends the trunk."""
    for length, whole in ((18, False), (40, True)):
        vessels = {
            "stem": Vessel("stem", tube([(0, 0, 0), (0, 0, length)], [4.5, 4.5])),
            "one": Vessel(
                "one", tube([(0, 0, length - 1), (20, 0, length + 60)], [3, 3]), "stem"
            ),
            "other": Vessel(
                "other",
                tube([(0, 0, length - 1), (-20, 0, length + 50)], [3, 3]),
                "stem",
            ),
        }
        ways = ways_of(vessels)
        before = ways.deepest_from(ways.node(np.zeros(3)))
        tips = [vessels[key].centreline.points[-1] for key in ("one", "other")]
        curves = [ways.points[ways.trace(before, ways.node(tip))] for tip in tips]
        end, leaving = trunk(ways, curves)
        assert len(leaving) == (2 if whole else 1)
        assert bool(end[2] < (length + 15) * 1e-3) is whole


@pytest.mark.parametrize(
    ("start", "ends", "widths", "chosen"),
    [
        (20, (0, 60, 200), (1, 3, 3), 0),
        (175, (190, 150, 200), (3, 3, 3), 1),  # the nearest is ahead
        (160, (60, 0, 200), (3, 1, 3), 0),  # far from all, the farthest wide one
        (160, (60, 0, 200), (3, 2, 3), 1),
    ],
)
def test_the_inlet_lies_behind_the_start_of_a_drawn_curve(start, ends, widths, chosen):
    """Nodes are a millimetre apart on one line; the curve leads to the last end."""
    s = 1e-3 * np.arange(201)

    def at(node, radius=2e-3):
        return SimpleNamespace(position=np.array([node, 0.002, 0.003]), radius=radius)

    line = SimpleNamespace(
        node=lambda place: int(place[0]), lengths_from=lambda node: np.abs(s - s[node])
    )
    curve = np.array([at(start).position, at(200).position])
    free, widths = np.array([True, True, False]), np.array(widths)
    given = [curve]
    found = extract._chosen_by_curves(line, list(map(at, ends)), widths, free, given)
    assert found == chosen
    with pytest.raises(ValueError, match=r"inlet=.*: \(1, 2, 3\) mm, 4.0 mm wide"):
        extract._chosen_by_curves(line, [at(0.001)], widths[:1], ~free[:1], given)


def test_a_branch_counts_as_far_as_the_device_passes():
    """Depths in cells of the lattice, of which the device has a radius of four."""
    depth = extract.CELL * np.array([0.1, 1.2, 4.0, 3.1, 2.9, 5.0])
    ways = SimpleNamespace(depth=depth, device=4 * extract.CELL)
    every = np.arange(6)
    assert extract._passed(ways, every, from_inlet=True).tolist() == [2, 3]
    assert extract._passed(ways, every[2:], from_inlet=False).tolist() == [2, 3]
    assert extract._passed(ways, every, from_inlet=False).tolist() == []
    assert extract._passed(ways, every[5:], from_inlet=False).tolist() == [5]


def test_a_goal_is_not_in_the_ostium_of_another_vessel():
    one = tube([(0, 0, 50), (80, 0, 50)], [3, 3])
    vessels = {
        "trunk": Vessel("trunk", tube([(0, 0, 0), (0, 0, 100)], [8, 8])),
        "one": Vessel("one", one, "trunk", 8e-3),
        "other": Vessel(
            "other", tube([(38, 0, 50), (38, 50, 60)], [6, 4]), "one", 3e-3
        ),
    }
    tree = VesselTree(vessels)
    for goal in place_goals(tree).values():
        depths = tree.depths(goal.position)
        assert depths[goal.vessel] > max(depths.values()) - 0.5e-3
    moved = place_goals(tree)["one"]
    assert 2e-3 < abs(moved.arc_length - 38e-3) < 12e-3
    alone = VesselTree({k: vessels[k] for k in ("trunk", "one")})
    assert place_goals(alone)["one"].arc_length == pytest.approx(38e-3)


def test_less_is_cut_off_where_a_branch_begins():
    """The branch leaves before the place where the lumen has its whole width."""
    vessels = {
        "trunk": Vessel("trunk", tube([(0, 0, 0), (0, 0, 100)], [8, 8])),
        "near": Vessel(
            "near", tube([(0, 0, 5), (8, 0, 20), (50, 0, 70)], [3] * 3), "trunk", 8e-3
        ),
    }
    tree = VesselTree(vessels)
    opened, inlet, cut = opened_at_inlet(tree, True, lumen_surface(tree, 1.5e-3))
    start = opened.vessel("near").centreline.points[0]
    assert float(SurfaceDepth(cut)(start[None])[0]) > 0.0
    assert 1e-3 < inlet.position[2] < 5e-3
    # Where a given inlet cuts it off, another one is asked for.
    behind = {
        **vessels,
        "trunk": Vessel("trunk", tube([(0, 0, 9), (0, 0, 100)], [8, 8])),
    }
    with pytest.raises(
        ValueError, match=r"cut off at .*for the inlet.*--inlet X Y Z\), such"
    ):
        opened_at_inlet(VesselTree(behind), False, lumen_surface(tree, 1.5e-3))
    # So where a branch beside the inlet turns back, past its plane.
    back = tube([(0, 0, 16), (10, 0, 12), (60, 0, -12)], [4, 4, 3])
    beside = {**behind, "near": Vessel("near", back, "trunk", 8e-3)}
    whole = VesselTree({**beside, "trunk": vessels["trunk"]})
    cut = lumen_surface(whole, 1.5e-3)
    with pytest.raises(ValueError, match=r"cut off at \(60, 0, -12\) mm with the end"):
        opened_at_inlet(VesselTree(beside), False, cut)


def test_every_vessel_left_out_has_its_own_entry():
    """Two branches of one vessel that is left out are noted with it."""
    vessels = {
        "stem": Vessel("stem", tube([(0, 0, 0), (0, 0, 100)], [7, 7])),
        "main": Vessel("main", tube([(0, 0, 50), (120, 0, 50)], [3, 3]), "stem", 7e-3),
        "up": Vessel("up", tube([(35, 0, 50), (40, 0, 85)], [2, 2]), "main", 3e-3),
        "down": Vessel("down", tube([(50, 0, 50), (50, 0, 18)], [2, 2]), "main", 3e-3),
    }
    missed = left_out(ways_of(vessels), VesselTree({"stem": vessels["stem"]}))
    long = [one for one in missed if one.length > 20e-3]
    assert len(long) == 3
    for one, name in zip(long, ("main", "up", "down"), strict=True):
        line = vessels[name].centreline
        assert line.project(one.position).distance < 3e-3
        radius = float(np.median(line.radii))
        assert one.width == pytest.approx(2 * radius, abs=1.2e-3)
        assert abs(one.length - line.length) < 12e-3


def test_drawn_centrelines_are_renamed_and_what_has_none_is_noted(tmp_path):
    tree = y_tree()
    mesh = write_obj(tmp_path / "lumen.obj", *marched(tree))
    route = tree.route("trunk", "left").points * 1e3
    curve = write_markup(tmp_path / "vmtk_1.mrk.json", route)
    notes = []
    rename = {"vmtk_1": "lcca", "aorta": "cca"}
    anatomy = import_scan(mesh, [curve], units="mm", rename=rename, notes=notes)
    assert list(anatomy.tree.vessels) == ["cca", "lcca"]
    assert "vmtk_1 is renamed lcca" in notes
    (missed,) = [note for note in notes if "left out of the drawn centrelines" in note]
    assert re.search(r"a vessel is .*mm wide, \d+ mm long$", missed)
    with pytest.raises(
        ValueError, match="no vessel 'lsa' to rename; there are.*vmtk_1"
    ):
        renamed(["aorta", "vmtk_1"], {"lsa": "lcca"})


def test_an_import_without_a_goal_is_refused(tmp_path, monkeypatch):
    mesh = write_obj(tmp_path / "lumen.obj", *marched(y_tree()))
    monkeypatch.setattr(importer, "place_goals", lambda *arguments: {})
    with pytest.raises(ValueError, match=r"no goal.*--inlet X Y Z\), such as \("):
        import_scan(mesh, units="mm")


def test_what_a_branch_is_like_counts_from_its_ostium_on():
    """Within its parent the lumen is not that of the branch."""
    share = np.linspace(0.0, 1.0, 101)[:, None]
    trunk = Centreline([0, 0, 0.1] * share, np.full(101, 8e-3))
    radii = np.full(101, 3e-3)
    radii[:60], radii[2], radii[70:80], radii[95:] = 6e-3, 2.2e-3, 2e-3, 0.7e-3
    line = Centreline([0, 0, 0.05] + [0.1, 0, 0] * share, radii)
    branch = Vessel("arm", line, "trunk", 58e-3)
    tree = VesselTree({"trunk": Vessel("trunk", trunk), "arm": branch})
    assert passable_length(branch, 1e-3) == pytest.approx(95e-3)
    assert passable_length(branch, 2.5e-3) == pytest.approx(70e-3)
    start = Inlet("trunk", trunk.points[0], [0, 0, 1.0], 8e-3)
    goal = Goal("arm", "arm", line.at(90e-3).position, 90e-3)
    box = Surface(np.eye(3), np.array([[0, 1, 2]]))
    found = describe(Anatomy("a", tree, start, {"arm": goal}, scan=box), 1e-3)
    assert found["vessels"]["arm"] == {
        "parent": "trunk", "length_mm": 100.0, "ostium_mm": 58.0,
        "median_radius_mm": 3.0, "passable_mm": 95.0,
    }  # fmt: skip
    way = {"vessel": "arm", "route_mm": 140.0, "narrowest_radius_mm": 2.0}
    assert found["goals"]["arm"] == way
