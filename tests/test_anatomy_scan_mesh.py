"""Reading and mending the surface of a lumen: formats, units, repairs, bad scans."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import slow
from skimage.measure import marching_cubes
from synthetic_scans import marched, write_obj, y_tree

from cathsim_dmc.anatomy import phantoms
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan.lumen import guess_units, read_lumen, typical_radius
from cathsim_dmc.anatomy.scan.mesh import read_triangles
from cathsim_dmc.anatomy.scan.repair import mend
from cathsim_dmc.anatomy.scan.topology import (
    crossings,
    decimated,
    edge_counts,
    without_slivers,
)
from cathsim_dmc.anatomy.scan.units import upright

DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="module")
def y_mesh():
    """Closed surface of the Y: vertices (mm), faces with outward normals."""
    return marched(y_tree(), 2.0e-3)


def volume(vertices, faces):
    return Surface(vertices, faces).volume


def assert_closed(lumen):
    edges, times = edge_counts(lumen.surface.faces)
    assert (times == 2).all()
    assert lumen.surface.volume > 0.0
    directed = lumen.surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)


def said(lumen, text):
    return any(text in note for note in lumen.notes)


@pytest.mark.parametrize(
    "file", sorted(DATA.glob("cylinder-*.vtp")), ids=lambda p: p.stem
)
def test_vtk_wrote_these_cylinders(file):
    pytest.importorskip("vtkmodules")
    vertices, faces = read_triangles(file)
    # A prism of nine sides in a circle of 5 mm, 40 mm high.
    assert volume(vertices, faces) == pytest.approx(2892.544, rel=1e-5)


def test_damaged_vtp_files(tmp_path):
    pytest.importorskip("vtkmodules")
    good = (DATA / "cylinder-ascii.vtp").read_text()
    polygons = good.index("<Polys>")
    bad = {
        "cut": good[: len(good) // 2],
        "other": '<VTKFile type="ImageData"></VTKFile>',
        "beyond": good[:polygons] + re.sub(r"\b8\b", "10000000", good[polygons:]),
    }
    for name, text in bad.items():
        path = tmp_path / f"{name}.vtp"
        path.write_text(text)
        with pytest.raises(ValueError, match="cannot be read as VTP") as error:
            read_triangles(path)
        assert "\n" not in str(error.value)


def test_without_vtk_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "vtkmodules", None)
    with pytest.raises(ValueError, match=r"needs vtk.*pip install .*-e '\.\[vtp\]'"):
        read_triangles(DATA / "cylinder-ascii.vtp")


@pytest.mark.parametrize("kind", ["stl", "ply", "obj"])
def test_formats_and_inverted_normals(y_mesh, tmp_path, kind):
    vertices, faces = y_mesh
    path = tmp_path / f"lumen.{kind}"
    trimesh.Trimesh(vertices, faces[:, ::-1], process=False).export(path)
    lumen = read_lumen(path)
    assert_closed(lumen)
    before = volume(vertices * 1e-3, faces)
    assert lumen.surface.volume == pytest.approx(before, rel=1e-4)
    assert said(lumen, "inside out")


@pytest.mark.parametrize(
    ("units", "scale"), [("mm", 1.0), ("cm", 0.1), ("m", 1e-3), ("um", 1e3)]
)
def test_units_are_guessed_and_said(y_mesh, tmp_path, units, scale):
    vertices, faces = y_mesh
    path = write_obj(tmp_path / "lumen.obj", vertices * scale, faces)
    lumen = read_lumen(path)
    assert lumen.units == units and said(lumen, f"unit guessed: {units}")
    assert np.ptp(lumen.surface.vertices, axis=0) == pytest.approx(
        np.ptp(vertices, axis=0) * 1e-3, rel=1e-2
    )


@pytest.mark.parametrize("noise", [0.3, *slow(0.0, 0.5)])
def test_noise_does_not_change_the_unit(noise):
    vertices, faces = marched(y_tree(), 0.6e-3)
    radius = typical_radius(vertices, faces)
    assert radius == pytest.approx(5.8, abs=0.3)
    normals = Surface(vertices, faces).normals
    steps = np.random.default_rng(0).normal(0.0, noise, (len(vertices), 1))
    rough = vertices + normals * steps
    assert typical_radius(rough, faces) == pytest.approx(radius, rel=0.05)
    assert guess_units("rough", rough, faces, None)[0] == "mm"


def test_a_cerebral_artery_is_not_taken_for_a_wide_aorta(y_mesh):
    vertices, faces = y_mesh
    thin = vertices * (0.33, 0.33, 1.3)  # 4 mm wide, 130 mm long; or a metre in cm
    assert guess_units("thin", thin, faces, None)[0] == "mm"


def test_two_likely_units_are_asked_for_with_their_sizes(y_mesh):
    vertices, faces = y_mesh
    with pytest.raises(ValueError) as error:
        guess_units("siphon", vertices * 0.4, faces, None)
    said = str(error.value)
    assert re.search(r"mm makes the widest lumen 4\.\S* mm wide .* 4\d\.\S* mm", said)
    assert re.search(r"cm makes the widest lumen 4\d\.\S* mm wide .* 4\d\d", said)
    assert said.endswith("pass units='mm' or 'cm' (--units).")
    assert guess_units("siphon", vertices * 0.4, faces, "cm")[0] == "cm"


def test_sizes_that_no_lumen_has_are_refused(y_mesh, tmp_path):
    vertices, faces = y_mesh
    path = write_obj(tmp_path / "lumen.obj", vertices, faces)
    with pytest.raises(ValueError, match="11.* mm wide .* 11.* across .*units='mm'"):
        read_lumen(path, units="cm")
    path = write_obj(tmp_path / "large.obj", vertices * 7.5, faces)
    with pytest.raises(ValueError, match="holds .* litres when its unit is 'mm'"):
        read_lumen(path, units="mm")


def test_the_unit_is_said_before_anything_is_mended(y_mesh, tmp_path):
    vertices, faces = y_mesh
    both = np.concatenate([vertices, vertices + 100.0])
    faces = np.concatenate([faces, faces + len(vertices)])
    lines = []
    words = r"2 separate parts, the largest around \(.*\) mm, \(.*\) mm; one"
    with pytest.raises(ValueError, match=words):
        read_lumen(write_obj(tmp_path / "two.obj", both, faces), say=lines.append)
    assert lines[-1].startswith("note: unit guessed: mm")


def test_an_stl_that_ends_early_is_refused(y_mesh, tmp_path):
    vertices, faces = y_mesh
    path = tmp_path / "cut.stl"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    path.write_bytes(path.read_bytes()[: 84 + 50 * 1234 + 20])
    with pytest.raises(ValueError, match=rf"early, after 1,234 of {len(faces):,}"):
        read_lumen(path)


def test_a_given_unit_is_taken_and_the_one_that_fits_is_named(y_mesh, tmp_path):
    vertices, faces = y_mesh
    lumen = read_lumen(write_obj(tmp_path / "a.obj", vertices * 0.15, faces), "mm")
    assert lumen.units == "mm" and said(lumen, "pass units='cm'")
    path = write_obj(tmp_path / "lumen.obj", vertices * 0.1, faces)
    with pytest.raises(ValueError, match="1.1[0-9]* mm wide .*pass units='cm'"):
        read_lumen(path, units="mm")  # too small for a tree of vessels
    with pytest.raises(ValueError, match="pass units='cm'"):
        read_lumen(path, units="m")
    with pytest.raises(ValueError, match="one of mm, cm, m"):
        read_lumen(path, units="ft")


def test_far_too_many_triangles_are_refused_unread(tmp_path, monkeypatch):
    path = tmp_path / "huge.stl"
    with path.open("wb") as stream:
        stream.write(b"\0" * 80 + np.array([10_000_000], "<u4").tobytes())
        stream.truncate(84 + 50 * 10_000_000)  # sparse
    monkeypatch.setattr(Path, "read_bytes", lambda self: pytest.fail("was read"))
    with pytest.raises(ValueError, match="some 10.0 million triangles"):
        read_lumen(path)


def test_holes_flips_slivers_and_small_parts_are_mended(y_mesh, tmp_path):
    vertices, faces = y_mesh
    rng = np.random.default_rng(0)
    flipped = rng.choice(len(faces), 40, replace=False)
    faces = faces.copy()
    faces[flipped] = faces[flipped][:, ::-1]
    # A triangle without area between two neighbours, as exporters leave them.
    a, b, c = faces[100]
    middle = 0.5 * (vertices[a] + vertices[b])
    vertices = np.concatenate([vertices, middle[None]])
    m = len(vertices) - 1
    faces[100] = (m, b, c)
    faces = np.concatenate([faces, [(a, m, c), (a, b, m)]])
    speck = trimesh.creation.icosphere(1, 0.5)
    count = len(vertices)
    vertices = np.concatenate([vertices, speck.vertices + (40, 0, 0)])
    faces = np.concatenate([np.delete(faces, [300, 500], axis=0), speck.faces + count])
    lumen = read_lumen(write_obj(tmp_path / "rough.obj", vertices, faces))
    assert_closed(lumen)
    for text in ("flipped", "holes filled", "small parts", "without area"):
        assert said(lumen, text), text


def test_a_triangle_without_area_beside_a_corner_of_three_opens_no_hole():
    """Its flip would give an edge to four triangles."""
    vertices = 1e-3 * np.array([[0, 0, 0], [4, 0, 0], [2, 0, 0], [1, 3, 0.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [2, 3, 1]])
    left, _ = without_slivers(vertices, faces)
    assert set(edge_counts(left)[1]) == {2}


def test_open_ends_are_capped(y_mesh, tmp_path):
    vertices, faces = y_mesh
    axes = {"left": (8, 0, 22), "right": (-3, 11, 13)}
    stay = vertices[:, 2] > 4.0
    for name, axis in axes.items():
        tip = y_tree().vessel(name).centreline.points[-1] * 1e3
        off = vertices - tip
        stay &= (off @ axis < -4.0 * np.linalg.norm(axis)) | (
            np.linalg.norm(off, axis=1) > 12.0
        )
    lumen = read_lumen(
        write_obj(tmp_path / "open.obj", vertices, faces[stay[faces].all(axis=1)])
    )
    assert_closed(lumen)
    assert said(lumen, "3 open vessel ends")


@pytest.mark.parametrize("outward", [True, False])
def test_a_ragged_rim_is_cut_back_to_a_plane(y_mesh, outward):
    """A fan over its teeth would fold into the lumen, which then ends in a bow tie."""
    vertices, faces = y_mesh
    angle = np.arctan2(vertices[:, 1], vertices[:, 0])
    tooth = 6.0 + 5.0 * np.cos(3.0 * angle)  # mm, height of the rim
    open_faces = faces[(vertices[:, 2] > tooth)[faces].all(axis=1)]
    rim = vertices[np.unique(open_faces)][:, 2]
    faces = open_faces if outward else open_faces[:, ::-1]
    surface, notes, _ = mend("ragged", vertices * 1e-3, faces)
    assert any("1 open vessel ends capped, ragged rims cut" in note for note in notes)
    low = surface.vertices[:, 2].min()
    assert rim.min() * 1e-3 + 5e-3 < low < 16e-3
    corners = surface.vertices[surface.faces]
    cap = corners[(corners[..., 2] < low + 0.5e-3).all(axis=1)]
    across = np.cross(cap[:, 1] - cap[:, 0], cap[:, 2] - cap[:, 0])
    assert np.all(across[:, 2] < 0.0)
    assert 0.5 * np.linalg.norm(across, axis=1).sum() == pytest.approx(
        np.pi * 6e-3**2, rel=0.05
    )


def test_a_gash_in_the_side_is_refused(y_mesh, tmp_path):
    vertices, faces = y_mesh
    middle = vertices[faces].mean(axis=1)
    gone = np.linalg.norm(middle - (6, 0, 25), axis=1) < 6.0
    path = write_obj(tmp_path / "gash.obj", vertices, faces[~gone])
    with pytest.raises(ValueError, match="hole 1[0-9.]* mm wide in the side"):
        read_lumen(path)


def test_edges_shared_by_three_triangles_are_mended(y_mesh, tmp_path):
    vertices, faces = y_mesh
    a, b, _ = faces[200]
    fin = vertices[a] + (0.5, 0.5, 3.0)
    path = write_obj(
        tmp_path / "fin.obj",
        np.concatenate([vertices, fin[None]]),
        np.concatenate([faces, [(a, b, len(vertices))]]),
    )
    lumen = read_lumen(path)
    assert_closed(lumen)
    assert said(lumen, "1 edges shared by more than two triangles")


def test_a_hole_that_mending_makes_between_large_triangles_is_filled():
    ball = trimesh.creation.icosphere(2, 14e-3)
    one, other, _ = ball.faces[0]
    vertices = np.vstack([ball.vertices, 1.3 * ball.vertices[one]])
    faces = np.vstack([ball.faces, [[one, other, len(ball.vertices)]]])
    surface, notes, _ = mend("ball", vertices, faces)
    assert surface.volume == pytest.approx(ball.volume, rel=0.1)
    (filled,) = (note for note in notes if "holes filled" in note)
    assert float(re.search(r"widest (\S+) mm", filled)[1]) > 8.0


def test_shared_edges_of_a_dense_surface_are_cut_before_it_is_decimated():
    # Radii of whole voxels: the surface is pinched where branches leave the trunk.
    x, y, z = np.mgrid[-12:60:1.0, -12:13:1.0, 0:200:1.0]

    def tube(start, end, radius):
        way = np.subtract(end, start)
        off = np.stack([x, y, z], axis=-1) - start
        along = np.clip(off @ way / (way @ way), 0.0, 1.0)
        return np.linalg.norm(off - along[..., None] * way, axis=-1) - radius

    trunk = tube((0, 0, 12), (0, 0, 188), 10)
    thin, wide = tube((0, 0, 80), (48, 0, 116), 4), tube((0, 0, 130), (48, 0, 172), 5)
    vertices, faces, _, _ = marching_cubes(np.minimum(trunk, np.minimum(thin, wide)), 0)
    surface, notes, _ = mend("pinched", 1e-3 * vertices, faces[:, ::-1])
    assert any("shared by more than two" in note for note in notes)
    assert any("decimated" in note for note in notes)
    before = 1e-9 * abs(volume(vertices, faces))
    assert surface.volume == pytest.approx(before, rel=1e-3)


def thick(rims):
    """A bent tube of 5 mm inner radius with a wall, open at both ends (mm)."""
    length = 40.0 * np.pi
    tube = trimesh.creation.annulus(5.0, 6.5, length, sections=24)
    if not rims:
        tube.update_faces(np.abs(tube.face_normals[:, 2]) < 0.5)
    points, faces = trimesh.remesh.subdivide_to_size(tube.vertices, tube.faces, 4.0)
    x, y, angle = (points / (1.0, 1.0, 40.0)).T
    return np.stack([(40 + x) * np.cos(angle), y, (40 + x) * np.sin(angle)], 1), faces


@pytest.mark.slow
@pytest.mark.parametrize("rims", [True, False], ids=["one surface", "two surfaces"])
def test_of_a_thick_wall_the_lumen_is_taken(tmp_path, rims):
    vertices, faces = thick(rims)
    lumen = read_lumen(write_obj(tmp_path / "wall.obj", vertices, faces))
    assert_closed(lumen)
    assert said(lumen, "thick wall") and said(lumen, "2 open vessel ends")
    exact = np.pi * 40 * np.pi * 5**2 * 1e-9
    assert lumen.surface.volume == pytest.approx(exact, rel=0.03)


@pytest.mark.slow
def test_many_triangles_are_decimated(tmp_path):
    vertices, faces = marched(y_tree(), 0.45e-3)
    assert len(faces) > 50_000
    path = tmp_path / "fine.stl"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    lumen = read_lumen(path)
    assert_closed(lumen)
    assert len(lumen.surface.faces) < 13_000 and said(lumen, "decimated from")
    before = volume(vertices * 1e-3, faces)
    assert lumen.surface.volume == pytest.approx(before, rel=5e-3)


@pytest.mark.parametrize("seed", [0, *slow(1, 2)])
def test_decimation_glues_nothing_together(seed):
    """Where noise folds the surface, edges would have three or more triangles."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=10e-3)
    noise = np.random.default_rng(seed).normal(size=(len(ball.vertices), 1))
    vertices = ball.vertices * (1.0 + 0.1 * noise)
    points, faces = decimated(vertices, ball.faces, 1500)
    assert len(faces) <= 1500 and (edge_counts(faces)[1] == 2).all()
    size = [np.linalg.norm(each, axis=1).mean() for each in (points, vertices)]
    assert size[0] == pytest.approx(size[1], rel=0.04)


def test_decimation_makes_no_surface_intersect_itself():
    surface = phantoms.load("type1").surface
    points, faces = decimated(surface.vertices, surface.faces, 240)
    assert len(faces) <= 240 and (edge_counts(faces)[1] == 2).all()
    assert not len(crossings(points, faces)[0])


def test_axes_turn_a_lying_scan(y_mesh, tmp_path):
    vertices, faces = y_mesh
    np.testing.assert_array_equal(upright("LPS"), np.eye(3))
    # +x points to the feet, +y to the left, +z to the front.
    np.testing.assert_array_equal(upright("ILA") @ [1, 0, 0], [0, 0, -1])
    lying = vertices[:, [2, 0, 1]] * (-1, 1, -1)
    lumen = read_lumen(write_obj(tmp_path / "a.obj", lying, faces), axes="ILA")
    for corner in (np.min, np.max):
        both = [corner(x, axis=0) for x in (lumen.surface.vertices, vertices * 1e-3)]
        np.testing.assert_allclose(*both, atol=0.1e-3)


@pytest.mark.parametrize("form", [str, np.array])
def test_axes_take_any_rotation(form):
    """The nearest rotation to rounded directions of left, back and head."""
    numbers = "-0.5,0,0.87,-0.87,0,-0.5,0,-1,0"
    turn = upright(numbers if form is str else np.fromstring(numbers, sep=","))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(turn @ (0, -1, 0), (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(turn[0], (-0.5, 0, 0.87), atol=5e-3)


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ("LPX", "three letters"),
        ("LLS", "right angles"),
        ("RPS", "mirror"),
        ("1,0,0,0,1,0", "nine numbers"),
        ("1,0,0,0,1,0,0,0,nan", "nine numbers"),
        ("1,0,0,0.5,1,0,0,0,1", "right angles"),
        ("1,0,0,0,1,0,0,0,-1", "mirror"),
    ],
)
def test_axes_that_are_no_rotation_are_refused(axes, words):
    with pytest.raises(ValueError, match=words):
        upright(axes)


def test_a_small_tangle_between_large_triangles_is_mended():
    profile = [(0.0, 0.0), *((10e-3, 9e-3 * k) for k in range(60)), (0.0, 0.531)]
    tube = trimesh.creation.revolve(profile, sections=8)
    face = int(np.argmax(tube.area_faces))
    a, b, c = tube.faces[face]
    normal = tube.face_normals[face]
    middle = tube.triangles_center[face]
    # A fold of 1 mm in one triangle: the edge from p to t pierces that of q, r and s.
    along = (tube.vertices[a] - middle) / np.linalg.norm(tube.vertices[a] - middle)
    across = np.cross(normal, along)
    turns = np.radians([0.0, 120.0, 240.0])[:, None]
    base = middle + 0.5e-3 * (np.cos(turns) * along + np.sin(turns) * across)
    s = middle + 0.5e-3 * normal
    t = middle - 0.6e-3 * along + 0.25e-3 * normal
    vertices = np.vstack([tube.vertices, base, s, t])
    p, q, r, s, t = range(len(tube.vertices), len(vertices))
    patch = [(a, b, q), (a, q, p), (b, c, r), (b, r, q), (c, a, p), (c, p, r)]
    patch += [(q, r, s), (r, p, s), (p, q, t), (q, s, t), (s, p, t)]
    faces = np.vstack([np.delete(tube.faces, face, axis=0), patch])

    surface, notes, _ = mend("tube", vertices, faces)

    assert len(surface.faces) == len(tube.faces)
    assert surface.volume == pytest.approx(tube.volume)
    assert any("self-intersecting" in note for note in notes)


def test_folds_that_noise_makes_in_a_coarse_surface_are_smoothed():
    vertices, faces = marched(y_tree(), 1e-3)
    vertices, faces = decimated(vertices * 1e-3, faces, 3000)
    clean = Surface(vertices, faces)
    noise = np.random.default_rng(2).normal(0.0, 0.3e-3, (len(vertices), 1))
    surface, notes, _ = mend("y", vertices + noise * clean.normals, faces)
    assert len(surface.faces) == len(faces)
    assert surface.volume == pytest.approx(clean.volume, rel=0.01)
    (smoothed,) = (note for note in notes if "smoothed" in note)
    moved = re.search(r"triangles smoothed, by (\S+) mm at most", smoothed)
    assert moved and float(moved[1]) < 1.0


@pytest.fixture(scope="module")
def labelled(y_mesh):
    """Oblique voxels of 0.8 x 0.9 x 1.0 mm in the Y, matrix and origin (mm, LPS)."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    matrix = turn * (0.8, 0.9, 1.0)
    inside = y_mesh[0] @ np.linalg.inv(matrix).T
    low = inside.min(axis=0) - 4
    size = np.ceil(np.ptp(inside, axis=0) + 8).astype(int)
    origin = matrix @ low
    ijk = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), -1)
    places = (ijk @ matrix.T + origin) * 1e-3
    depth = np.max(list(y_tree().depths(places).values()), axis=0)
    voxels = np.where(depth > 0.0, 7, 0).astype(np.uint8)
    voxels[0, 0, 0] = 3
    return voxels, matrix, origin


def label_map(path, voxels, matrix, origin):
    """Writes a label map, in RAS or LPS."""
    if path.suffix == ".nrrd":
        nrrd = pytest.importorskip("nrrd")
        header = {
            "space": "left-posterior-superior",
            "space directions": matrix.T,
            "space origin": origin,
            "Segment0_LabelValue": "7",
            "Segment0_Name": "aorta",
        }
        nrrd.write(str(path), voxels, header)
    else:
        nibabel = pytest.importorskip("nibabel")
        affine = np.eye(4)
        affine[:3, :3], affine[:3, 3] = matrix, origin
        affine[:2] *= -1.0  # RAS
        nibabel.save(nibabel.Nifti1Image(voxels, affine), path)
    return path


@pytest.mark.parametrize("kind", [".nii.gz", *slow(".nrrd")])
def test_a_label_map_gives_the_surface_where_it_is(y_mesh, labelled, tmp_path, kind):
    path = label_map(tmp_path / f"map{kind}", *labelled)
    with pytest.raises(ValueError, match=r"2 labels: 3 \(1 voxels\), 7.*--label"):
        read_lumen(path)
    with pytest.raises(ValueError, match="has no label 4; it has 2 labels: 3"):
        read_lumen(path, labels=(4,))
    lumen = read_lumen(path, labels=(7,))
    assert_closed(lumen)
    assert lumen.units == "mm" and said(lumen, "label 7")
    vertices, faces = y_mesh
    for corner in (np.min, np.max):
        both = [corner(x, axis=0) for x in (lumen.surface.vertices, vertices * 1e-3)]
        np.testing.assert_allclose(*both, atol=0.8e-3)
    truth = volume(vertices * 1e-3, faces)
    assert lumen.surface.volume == pytest.approx(truth, rel=0.03)


def test_a_label_map_without_size_is_refused(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    nrrd.write(str(tmp_path / "bare.nrrd"), np.ones((4, 4, 4), np.uint8))
    with pytest.raises(ValueError, match="its header lacks 'space directions'"):
        read_lumen(tmp_path / "bare.nrrd")
    steps = {"spacings": [0.5, 0.5, 3.0], "space": "left-posterior-superior"}
    nrrd.write(str(tmp_path / "bare.nrrd"), np.ones((4, 4, 4), np.uint8), steps)
    with pytest.raises(
        ValueError, match=r"directions: \(0.5,0,0\) \(0,0.5,0\) \(0,0,3"
    ):
        read_lumen(tmp_path / "bare.nrrd")


def test_what_is_no_label_map_is_refused(y_mesh, tmp_path, monkeypatch):
    nibabel = pytest.importorskip("nibabel")
    image = np.random.default_rng(0).normal(size=(5, 5, 5)).astype(np.float32)
    nibabel.save(nibabel.Nifti1Image(image, np.eye(4)), tmp_path / "image.nii")
    with pytest.raises(ValueError, match="not whole"):
        read_lumen(tmp_path / "image.nii")
    nibabel.save(
        nibabel.Nifti1Image(np.zeros((4, 4, 4, 2), np.uint8), np.eye(4)),
        tmp_path / "four.nii",
    )
    with pytest.raises(ValueError, match="three dimensions"):
        read_lumen(tmp_path / "four.nii")
    grey = np.arange(1000, dtype=np.int16).reshape(10, 10, 10)
    nibabel.save(nibabel.Nifti1Image(grey, np.eye(4)), tmp_path / "ct.nii")
    with pytest.raises(ValueError, match="999 different numbers, so it is an image"):
        read_lumen(tmp_path / "ct.nii")
    (tmp_path / "broken.nii.gz").write_bytes(b"x" * 400)
    with pytest.raises(ValueError, match="cannot be read as NII"):
        read_lumen(tmp_path / "broken.nii.gz")
    mesh = write_obj(tmp_path / "a.obj", *y_mesh)
    with pytest.raises(ValueError, match="label is for label maps"):
        read_lumen(mesh, labels=(1,))
    monkeypatch.setitem(sys.modules, "nibabel", None)
    with pytest.raises(ValueError, match=r"-e '\.\[segmentation\]'"):
        read_lumen(tmp_path / "image.nii")
