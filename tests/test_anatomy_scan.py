"""Import of a scan: a synthetic Y-shaped lumen, and every error."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_scans import marched, write_markup, write_obj, y_tree

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.parts import End, Inlet, Surface
from cathsim_dmc.anatomy.scan import check, units
from cathsim_dmc.anatomy.scan.curves import read_curve, vessel_name
from cathsim_dmc.anatomy.scan.importer import import_scan
from cathsim_dmc.anatomy.scan.places import cut_open, describe, opened_at_inlet
from cathsim_dmc.anatomy.scan.tree import name_trunk
from cathsim_dmc.anatomy.surface import lumen_surface
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth
from cathsim_dmc.anatomy.tree_depth import TreeDepth

DEVICE_RADIUS = 0.84e-3


@pytest.fixture(scope="module")
def y_scan(tmp_path_factory):
    """Mesh file, centreline files, and the tree they were made from."""
    folder = tmp_path_factory.mktemp("scan")
    tree = y_tree()
    vertices, faces = marched(tree)
    mesh = write_obj(folder / "lumen.obj", vertices, faces)
    curves = []
    for name in ("left", "right"):
        own = tree.vessel(name).centreline
        trunk = tree.root.centreline.slice(0.0, 0.049)
        points = np.concatenate([trunk.points[4:], own.points]) * 1e3
        curves.append(
            write_markup(folder / f"centreline-{name.upper()}.mrk.json", points)
        )
    return mesh, curves, tree


@pytest.fixture(scope="module")
def y_anatomy(y_scan):
    mesh, curves, _ = y_scan
    return import_scan(mesh, curves)


def test_import_finds_the_tree(y_anatomy, y_scan):
    tree = y_anatomy.tree
    assert list(tree.vessels) == ["trunk", "left", "right"]
    parents = {tree.vessel(name).parent for name in ("left", "right")}
    assert "trunk" in parents
    truth = y_scan[2]
    for name in ("left", "right"):
        line = tree.vessel(name).centreline
        own = line.points[line.arc_length > tree.vessel(name).ostium]
        distance = truth.vessel(name).centreline.project(own).distance
        assert distance.max() < 1.0e-3
    root = tree.root.centreline
    assert np.abs(root.radii[5:25] - 6e-3).max() < 0.8e-3


def test_import_places_inlet_and_goals(y_anatomy):
    inlet = y_anatomy.inlet
    # The trunk's free end is at z = 0, and its lumen leads to +z.
    assert 0.0 < inlet.position[2] < 15e-3
    assert inlet.direction[2] > 0.97
    assert sum(end.open for end in y_anatomy.ends) == 1
    for goal in y_anatomy.goals.values():
        assert y_anatomy.lumen(goal.position) > DEVICE_RADIUS
        assert y_anatomy.route(goal.name).radii.min() > DEVICE_RADIUS
    assert {"left", "right"} <= set(y_anatomy.goals)
    assert json.dumps(describe(y_anatomy))


def test_saved_anatomy_keeps_its_depth(y_anatomy, tmp_path):
    y_anatomy.save(tmp_path / "a")
    again = Anatomy.load(tmp_path / "a")
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.03, 0.09, size=(500, 3))
    np.testing.assert_array_equal(again.lumen(points), y_anatomy.lumen(points))
    assert again.scan and again.lumen.digest == y_anatomy.lumen.digest


def test_the_command_draws_what_it_imports(y_anatomy, tmp_path, monkeypatch, capsys):
    from cathsim_dmc.cli import phantoms

    monkeypatch.setattr(phantoms, "import_scan", lambda *_, **options: y_anatomy)
    phantoms.import_phantom(Path("lumen.obj"), out=tmp_path / "one")
    said = json.loads(capsys.readouterr().out)
    assert Path(said["picture"]).parent == tmp_path / "one"
    assert Path(said["picture"]).stat().st_size > 20_000
    first, second = said["next"]
    assert first.startswith("cathsim eval pretrained:navigator --anatomy")
    assert "--goal left" in first and second.endswith("check.png")
    options = {"out": tmp_path / "two", "device": "microcatheter_021"}
    phantoms.import_phantom(Path("lumen.obj"), **options)
    first, _ = json.loads(capsys.readouterr().out)["next"]
    assert "eval push" in first and "--device microcatheter_021" in first


@pytest.mark.slow
def test_inlet_in_the_middle_cuts_the_lumen(y_scan):
    mesh, curves, _ = y_scan
    short = []
    for path in curves:  # they start at the trunk's end, so the cut shortens them
        curve = read_curve(path)
        keep = curve[curve[:, 2] > 30e-3] * 1e3
        short.append(write_markup(path.with_name(f"short-{path.name}"), keep))
    anatomy = import_scan(mesh, short, inlet=(0.0, 0.0, 28.0))
    assert anatomy.inlet.position[2] == pytest.approx(28e-3, abs=2e-3)
    assert anatomy.surface.vertices[:, 2].min() > 25e-3


CUT = Inlet("aorta", np.array([0, 0, -0.0101]), np.array([0, 0, 1.0]), 5e-3)


@pytest.fixture(scope="module")
def tube():
    """Closed cylinder of 5 mm radius and 60 mm length along z (m)."""
    import trimesh

    mesh = trimesh.creation.cylinder(radius=5e-3, height=60e-3, sections=24)
    return mesh.subdivide().subdivide()


@pytest.fixture(scope="module")
def cut_tube(tube):
    """The tube cut at z = -10.1 mm: points, open shell, cap."""
    return cut_open(np.asarray(tube.vertices), np.asarray(tube.faces), CUT)


def test_cut_keeps_the_far_side(tube, cut_tube):
    import trimesh

    points, shell, cap = cut_tube
    closed = trimesh.Trimesh(points, np.concatenate([shell, cap]), process=False)
    assert closed.is_watertight
    part = (0.03 + 0.0101) / 0.06
    assert closed.volume == pytest.approx(tube.volume * part, rel=1e-6)


def test_the_lumen_ends_at_the_inlet(cut_tube):
    points, shell, cap = cut_tube
    end = End("aorta", CUT.position, -CUT.direction, CUT.radius, True)
    surface = Surface(points, np.concatenate([shell, cap]))
    depth = Field.of(surface, [end])
    s = np.linspace(-19e-3, 30e-3, 99)
    line = CUT.position + s[:, None] * CUT.direction + (4e-3, 0.0, 0.0)
    ahead = s > 0.0
    np.testing.assert_allclose(depth(line[ahead]), 0.95e-3, atol=0.06e-3)
    np.testing.assert_allclose(depth(line[s < 0.0]), s[s < 0.0], atol=1e-9)


def tube_line(start, end, radius) -> Centreline:
    """A straight centreline, mm."""
    ends = Centreline(np.array([start, end]) * 1e-3, np.full(2, radius * 1e-3))
    return ends.resampled(1e-3)


def fork(*names, trunk=(0.0, 60.0)) -> VesselTree:
    """A root of 8 mm radius, a branch, and further branches off that branch, mm."""
    low, high, line = *trunk, tube_line
    vessels = {
        "aorta": Vessel("aorta", line((0, 0, -40), (0, 0, 40), 8.0)),
        names[0]: Vessel(names[0], line((low, 0, 0), (high, 0, 0), 3.0), "aorta", 8e-3),
    }
    for x, name in zip((30, 40), names[1:], strict=False):
        vessels[name] = Vessel(name, line((x, 0, 0), (x, 40, 0), 2.0), names[0], 3e-3)
    return VesselTree(vessels)


def test_less_is_cut_off_where_the_inlet_would_meet_a_branch():
    """A branch 8 mm from the end, of which 6.4 mm are cut off otherwise."""
    root = Vessel("aorta", tube_line((0, 0, 0), (0, 0, 60), 8.0))
    branch = Vessel("lsa", tube_line((0, 0, 8), (40, 0, 2), 3.0), "aorta", 8e-3)
    tree = VesselTree({"aorta": root, "lsa": branch})
    opened, inlet, surface = opened_at_inlet(tree, True, lumen_surface(tree, 1e-3))
    assert 1e-3 < inlet.position[2] < 5e-3
    assert SurfaceDepth(surface)(branch.centreline.points[-2:-1]) > 1e-3
    assert list(opened.vessels) == ["aorta", "lsa"]


@pytest.mark.parametrize(
    ("order", "right"),
    [
        ("lcca rcca lsa", True),
        ("lsa rcca lcca", True),
        ("rcca lcca lsa", False),
        ("lsa lcca rcca", False),
        ("lcca lsa", False),
    ],
)
def test_the_left_carotid_leaves_a_right_sided_arch_first(order, right):
    vessels = {"aorta": Vessel("aorta", tube_line((0, 0, -40), (0, 0, 40), 8.0))}
    for z, name in zip((-20, 0, 20), order.split(), strict=False):
        line = tube_line((0, 0, z), (40, 0, z), 3.0)
        vessels[name] = Vessel(name, line, "aorta", 8e-3)
    assert check._right_sided(SimpleNamespace(tree=VesselTree(vessels))) is right


def test_right_branches_share_the_brachiocephalic():
    before = fork("rva", "rcca", "reca")
    tree = name_trunk(before)
    assert list(tree.vessels) == ["aorta", "bca", "rva", "rcca", "reca"]
    parents = [vessel.parent for vessel in tree.vessels.values()]
    assert parents == [None, "aorta", "bca", "bca", "rva"]
    bca = tree.vessel("bca")
    assert bca.centreline.length == pytest.approx(30e-3)
    assert bca.ostium == before.vessel("rva").ostium
    # Own lumen starts where the trunk's radius is left, and no way is longer.
    assert tree.vessel("rva").ostium == pytest.approx(4e-3, abs=1e-3)
    for name in ("rva", "rcca", "reca"):
        ways = [t.route("aorta", name).length for t in (before, tree)]
        assert ways[0] == pytest.approx(ways[1], abs=1e-9)
    rng = np.random.default_rng(4)
    points = rng.uniform((-10e-3, -5e-3, -8e-3), (59e-3, 39e-3, 8e-3), size=(500, 3))
    depths = [TreeDepth(each)(points) for each in (tree, before)]
    np.testing.assert_allclose(*depths, atol=2e-5)


@pytest.mark.parametrize(
    "names", [("lva", "lcca"), ("rva", "lcca"), ("rva",), ("rva", "bca"), ("a", "b")]
)
def test_other_trunks_keep_their_names(names):
    tree = fork(*names)
    assert name_trunk(tree) is tree


def test_an_aberrant_subclavian_artery_keeps_what_it_shares_with_its_vertebral():
    tree = fork("rsa", "rva")
    rcca = Vessel("rcca", tube_line((0, 0, -10), (0, -30, -10), 3.0), "aorta", 8e-3)
    other = VesselTree({**tree.vessels, "rcca": rcca})
    assert "bca" in name_trunk(tree).vessels
    assert name_trunk(other) is other


def test_a_bovine_trunk_is_the_brachiocephalic():
    """The left carotid leaves it before the right branches part."""
    tree = name_trunk(fork("rcca", "lcca", "rsa"))
    parents = {key: vessel.parent for key, vessel in tree.vessels.items()}
    assert parents.pop("bca") == "aorta"
    assert parents == {"aorta": None, "rcca": "bca", "lcca": "bca", "rsa": "bca"}
    after = fork("rcca", "rsa", "lcca")
    assert name_trunk(after) is after


def test_branches_that_are_right_ones_need_no_name():
    tree = name_trunk(fork("branch_2", "branch_1"), right={"branch_1", "branch_2"})
    assert [v.parent for v in tree.vessels.values()] == [None, "aorta", "bca", "bca"]
    assert list(tree.vessels) == ["aorta", "bca", "branch_2", "branch_1"]


def test_ras_markup_and_table_are_the_same_curve(y_scan, tmp_path):
    curve = read_curve(y_scan[1][0])
    ras = curve * 1e3 * (-1.0, -1.0, 1.0)
    path = write_markup(tmp_path / "c-A.mrk.json", ras, system="RAS")
    np.testing.assert_allclose(read_curve(path), curve, atol=1e-12)
    table = tmp_path / "centreline_A.csv"
    rows = np.c_[curve * 1e3, np.full(len(curve), 2.0)]
    body = "\n".join(",".join(f"{x:.9f}" for x in row) for row in rows)
    table.write_text("x,y,z,radius\n" + body + "\n")
    np.testing.assert_allclose(read_curve(table), curve, atol=1e-9)
    table.write_text(body)  # without headings
    np.testing.assert_allclose(read_curve(table), curve, atol=1e-9)


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("centreline-LCCA.mrk.json", "lcca"),
        ("Centerline curve (8) RVA.json", "8_rva"),
        ("left_mca.csv", "left_mca"),
    ],
)
def test_vessels_are_called_after_their_files(file, name):
    assert vessel_name(file) == name


def test_centreline_elsewhere(y_scan, tmp_path):
    mesh, curves, _ = y_scan
    points = read_curve(curves[0]) * 1e3
    away = write_markup(tmp_path / "centreline-A.mrk.json", points + (30.0, 0, 0))
    with pytest.raises(ValueError, match=r"only \d+% of the centreline"):
        import_scan(mesh, [away])
    ras = points * (-1.0, -1.0, 1.0)
    mirrored = write_markup(tmp_path / "centreline-B.mrk.json", ras)
    with pytest.raises(ValueError, match="mesh_frame='RAS'"):
        import_scan(mesh, [mirrored])


def test_names_must_differ(y_scan, tmp_path):
    mesh, curves, _ = y_scan
    text = curves[0].read_text()
    for name in ("left", "aorta"):
        (tmp_path / f"{name}.mrk.json").write_text(text)
    with pytest.raises(ValueError, match="'left', which is taken"):
        import_scan(mesh, [curves[0], tmp_path / "left.mrk.json"])
    with pytest.raises(ValueError, match="'aorta', which is taken"):
        import_scan(mesh, [tmp_path / "aorta.mrk.json"])


def test_inlet_off_the_lumen(y_scan):
    far = r"inlet \(90, 0, 0\) mm is .* away from the lumen, whose middle is \(.*\) mm"
    far += ".*mesh_frame, on the command line --units and --frame"
    with pytest.raises(ValueError, match=far):
        import_scan(*y_scan[:2], inlet=(90.0, 0.0, 0.0))


def test_places_are_told_as_the_file_has_them():
    place = np.array([0.012, -0.034, 0.0561])
    with units.file_frame(units.to_lps("cm", "RAS"), "cm"):
        assert units.shown(place) == "(-1.2, 3.4, 5.6) cm"
    with units.file_frame(units.to_lps("m", "LPS", "ILA"), "m"):
        assert units.shown(units.upright("ILA") @ place) == "(0.012, -0.034, 0.056) m"
    assert units.shown(place) == "(12, -34, 56) mm"
