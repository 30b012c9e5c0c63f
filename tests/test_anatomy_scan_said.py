"""What files say of themselves, and what they do not: units, frames, ends, headings."""

import json
import re

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from synthetic_scans import marched, write_markup, write_obj, y_tree
from test_anatomy_scan_files import ball, meta, poly_data, written

from cathsim_dmc.anatomy.scan import bodies, topology
from cathsim_dmc.anatomy.scan.curves import read_curve, read_curves
from cathsim_dmc.anatomy.scan.labels import label_surface
from cathsim_dmc.anatomy.scan.lumen import guess_units, read_lumen
from cathsim_dmc.anatomy.scan.mesh import read_triangles, stated_frame, stem
from cathsim_dmc.anatomy.scan.repair import mend


@pytest.fixture(scope="module")
def y_mesh():
    return marched(y_tree(), 1.6e-3)


def nrrd_map(path, per_mm, **entries):
    """A label map of a ball, voxels given in the unit of its header."""
    nrrd = pytest.importorskip("nrrd")
    header = {
        "space": "left-posterior-superior",
        "space directions": np.diag((0.8, 0.9, 1.0)) * per_mm,
        "space origin": np.array((5.0, -3.0, 20.0)) * per_mm,
        **entries,
    }
    nrrd.write(str(path), ball(), {k: v for k, v in header.items() if v is not None})
    return path


@pytest.mark.parametrize(
    ("name", "per_mm", "unit"),
    [("mm", 1.0, "mm"), ("cm", 0.1, "cm"), ("m", 1e-3, "m"), ("micron", 1e3, "um")],
)
def test_the_unit_of_a_label_map_is_that_of_its_header(tmp_path, name, per_mm, unit):
    plain = label_surface(nrrd_map(tmp_path / "plain.nrrd", 1.0))
    assert plain.unit == "mm" and "no unit named: mm taken" in plain.notes[0]
    path = nrrd_map(tmp_path / "map.nrrd", per_mm, **{"space units": [name] * 3})
    found = label_surface(path)
    assert found.unit == unit
    assert f"unit {unit}, as its header says; frame is" in found.notes[0]
    np.testing.assert_allclose(found.vertices, plain.vertices, atol=1e-9)
    given = label_surface(path, units="cm")
    assert given.unit == "cm" and f"as given (its header says {unit})" in given.notes[0]
    np.testing.assert_allclose(given.vertices, 10 * per_mm * plain.vertices, rtol=1e-9)


@pytest.mark.parametrize("names", [["furlong"] * 3, ["mm", "mm", "cm"]])
def test_units_that_are_none_are_refused(tmp_path, names):
    path = nrrd_map(tmp_path / "map.nrrd", 1.0, **{"space units": names})
    with pytest.raises(ValueError, match="the unit of its coordinates is .*one of mm"):
        label_surface(path)


def test_a_wrong_unit_of_a_header_is_mended_by_units(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(ball(), np.diag((-2.0, -2.0, 2.0, 1.0)))
    image.header.set_xyzt_units("meter")
    nibabel.save(image, tmp_path / "map.nii.gz")
    with pytest.raises(ValueError, match=r"unit is 'm'.*\(--units mm\)") as error:
        read_lumen(tmp_path / "map.nii.gz")
    assert "its header says" in str(error.value)
    found = label_surface(tmp_path / "map.nii.gz", units="mm")
    assert np.ptp(found.vertices, axis=0).max() < 0.1


def test_a_label_map_without_orientation_asks(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(ball(), None)
    image.header.set_zooms((0.8, 0.9, 1.0))
    nibabel.save(image, tmp_path / "none.nii")
    notes = label_surface(tmp_path / "none.nii").notes
    assert "frame is the file's" not in notes[0]
    assert notes[1].startswith("question: its header gives no orientation (sform")
    image = nibabel.Nifti1Image(ball(), np.eye(4))
    nibabel.save(image, tmp_path / "some.nii")
    (note,) = label_surface(tmp_path / "some.nii").notes
    assert note.endswith("frame is the file's")
    bare = {"space": None, "space dimension": 3}
    notes = label_surface(nrrd_map(tmp_path / "bare.nrrd", 1.0, **bare)).notes
    assert notes[1].startswith("question: its header names no space")


def test_a_metaimage_without_orientation_asks_and_without_size_is_refused(tmp_path):
    pytest.importorskip("vtkmodules")
    path = meta(tmp_path / "map.mha", ball())
    (note,) = label_surface(path).notes
    assert note.endswith("frame is the file's")
    head, body = path.read_bytes().split(b"ElementDataFile")
    lines = [line for line in head.splitlines(True) if b"TransformMatrix" not in line]
    path.write_bytes(b"".join(lines) + b"ElementDataFile" + body)
    notes = label_surface(path).notes
    assert notes[1].startswith("question: its header has no TransformMatrix")
    lines = [line for line in lines if b"ElementSpacing" not in line]
    path.write_bytes(b"".join(lines) + b"ElementDataFile" + body)
    with pytest.raises(ValueError, match="lacks the size of its voxels; add"):
        label_surface(path)


@pytest.mark.parametrize(("turned", "asks"), [(0.0, False), (0.3, True)])
def test_a_label_map_with_two_orientations_asks(tmp_path, turned, asks):
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(ball(), np.diag((0.8, 0.9, 1.0, 1.0)))
    other = image.affine.copy()
    other[:3, :3] = Rotation.from_rotvec((0, 0, turned)).as_matrix() @ other[:3, :3]
    image.set_qform(other, 1)
    nibabel.save(image, tmp_path / "two.nii")
    notes = label_surface(tmp_path / "two.nii").notes
    found = [note for note in notes if "two orientations, sform and qform" in note]
    assert len(found) == asks
    if asks:  # the farthest corner turns by 0.3 rad
        across = np.hypot(*np.array(image.shape[:2]) * (0.8, 0.9))
        assert f"{2 * across * np.sin(0.15):.3g} mm apart; sform is taken" in found[0]


def test_a_label_map_of_one_point_in_time_has_three_dimensions(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    found = []
    for name, voxels in (("three.nii", ball()), ("four.nii", ball()[..., None])):
        nibabel.save(nibabel.Nifti1Image(voxels, np.eye(4)), tmp_path / name)
        found.append(label_surface(tmp_path / name).vertices)
    np.testing.assert_array_equal(*found)


def test_the_space_of_an_nrrd_file_may_be_mirrored(tmp_path):
    """LAS is what LPS is with the second axis to the front."""
    lps = label_surface(nrrd_map(tmp_path / "lps.nrrd", 1.0))
    las = nrrd_map(tmp_path / "las.nrrd", 1.0, space="left-anterior-superior")
    las = label_surface(las)
    np.testing.assert_allclose(las.vertices * (1, -1, 1), lps.vertices, atol=1e-9)
    for one in (lps, las):
        assert trimesh.Trimesh(one.vertices, one.faces).volume > 0.0
    bare = label_surface(
        nrrd_map(tmp_path / "bare.nrrd", 1.0, **{"space origin": None})
    )
    moved = bare.vertices + 1e-3 * np.array((5.0, -3.0, 20.0))
    np.testing.assert_allclose(moved, lps.vertices, atol=1e-9)
    other = nrrd_map(tmp_path / "other.nrrd", 1.0, space="scanner-xyz")
    with pytest.raises(ValueError, match="its space is 'scanner-xyz'.*LPS, RAS, LAS"):
        label_surface(other)


def slicer(path, vertices, faces, space):
    """A surface as 3D Slicer writes it, which says its frame."""
    said = f"3D Slicer output. SPACE={space}"
    if path.suffix in (".vtk", ".vtp"):
        data = poly_data(vertices, faces)
        if path.suffix == ".vtp":
            from vtkmodules.vtkCommonCore import vtkStringArray

            array = vtkStringArray()
            array.SetName("SPACE")
            array.InsertNextValue(space)
            data.GetFieldData().AddArray(array)
        written(data, path)
        text = path.read_bytes()
        path.write_bytes(text.replace(b"vtk output", said.encode(), 1))
        return path
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    data = path.read_bytes()
    if path.suffix == ".stl":
        data = said.encode().ljust(80, b"\0") + data[80:]
    elif path.suffix == ".ply":
        data = data.replace(b"comment ", f"comment {said}\ncomment ".encode(), 1)
    else:
        data = f"# {said}\n".encode() + data
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("kind", ["stl", "ply", "obj", "vtk", "vtp"])
def test_the_frame_that_a_surface_says_is_taken(y_mesh, tmp_path, kind):
    path = slicer(tmp_path / f"lumen.{kind}", *y_mesh, "RAS")
    assert stated_frame(path) == "RAS"
    with pytest.raises(ValueError, match=r"says SPACE=RAS; .*\(--frame RAS\)"):
        read_lumen(path, "mm", frame="LPS")
    plain = tmp_path / f"plain.{kind}"
    if kind in ("vtk", "vtp"):
        written(poly_data(*y_mesh), plain)
    else:
        trimesh.Trimesh(*y_mesh, process=False).export(plain)
    assert stated_frame(plain) is None
    if kind == "stl":
        said, bare = read_lumen(path), read_lumen(plain)
        assert (said.frame, bare.frame) == ("RAS", "LPS")
        assert "frame: RAS, as the file says" in said.notes
        turned = np.unique((bare.surface.vertices * (-1, -1, 1)).round(9), axis=0)
        found = np.unique(said.surface.vertices.round(9), axis=0)
        np.testing.assert_allclose(found, turned, atol=2e-9)
        assert read_lumen(path, frame="RAS").notes == said.notes


def tube(wide, long):
    """A closed tube (m) as vertices and faces."""
    side = [(wide / 2, z) for z in np.arange(0.0, long, wide / 5)]
    mesh = trimesh.creation.revolve([(0.0, 0.0), *side, (0.0, long)], sections=24)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_units_are_not_sure_because_others_are_unusual():
    vertices, faces = tube(29e-3, 464e-3)
    with pytest.raises(ValueError, match=r"cm makes .*inch makes .*\(--units\)"):
        guess_units("arch", vertices / 25.4e-3, faces, None)
    assert guess_units("arch", vertices / 25.4e-3, faces, "inch")[0] == "inch"
    assert guess_units("arch", 1e3 * vertices, faces, None)[0] == "mm"
    # An aorta in feet has the size of a mouse's in inches.
    aorta, round_it = tube(24e-3, 550e-3)
    with pytest.raises(ValueError, match=r"no usual scan.*units='inch' \(--units\)"):
        guess_units("arch", aorta / 0.3048, round_it, None)
    # A mouse's in mm is a man's in cm.
    vertices, faces = tube(1.7e-3, 25e-3)
    unit, why, _ = guess_units("mouse", 1e3 * vertices, faces, None)
    assert unit == "cm" and "pass units='mm'" in why
    # Arteries of a whole body in cm are those of a heart in mm.
    vertices, faces = tube(26e-3, 1.4)
    with pytest.raises(ValueError, match=r"mm makes .*cm makes .*\(--units\)"):
        guess_units("body", 1e2 * vertices, faces, None)
    vertices, faces = tube(3.6e-3, 90e-3)
    assert guess_units("heart", 1e3 * vertices, faces, None)[0] == "mm"
    # A wide aneurysm is one in mm only.
    vertices, faces = tube(83e-3, 320e-3)
    assert guess_units("aneurysm", 1e3 * vertices, faces, None)[0] == "mm"
    vertices, faces = tube(3e-3, 1.9)
    with pytest.raises(ValueError, match=r"fits no usual .*units='mm' \(--units\)"):
        guess_units("hose", 1e3 * vertices, faces, None)


def text_files(folder, vertices, faces):
    """Whole files of text."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.export(folder / "lumen.stl", file_type="stl_ascii")
    mesh.export(folder / "lumen.ply", encoding="ascii")
    write_obj(folder / "lumen.obj", vertices, faces)
    return [folder / f"lumen.{kind}" for kind in ("stl", "ply", "obj")]


@pytest.mark.parametrize("share", [0.6, 0.93, 0.995])
def test_files_of_text_that_are_cut_off_are_refused(y_mesh, tmp_path, share):
    for path in text_files(tmp_path, *y_mesh):
        assert len(read_triangles(path)[1]) == len(y_mesh[1])
        whole = path.read_bytes()
        # The end of the last line is no part of the content.
        path.write_bytes(whole.rstrip())
        assert len(read_triangles(path)[1]) == len(y_mesh[1]), path
        cut = whole[: int(share * len(whole))]
        path.write_bytes(cut[:-1] if cut.endswith(b"\n") else cut)
        with pytest.raises(ValueError, match="it ends early"):
            read_triangles(path)


def test_whole_files_that_look_cut_off_are_read(y_mesh, tmp_path):
    """Points that no triangle uses, corners counted backwards, a mark before text."""
    vertices, faces = y_mesh
    solid = text_files(tmp_path, vertices, faces)[0]
    path = write_obj(tmp_path / "lumen.obj", np.append(vertices, [[0, 0, 0]], 0), faces)
    assert len(read_triangles(path)[1]) == len(faces)
    path.write_text(path.read_text() + "# end")
    assert len(read_triangles(path)[1]) == len(faces)
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces - len(vertices)]
    path.write_text("\n".join(lines))
    assert len(read_triangles(path)[1]) == len(faces)
    solid.write_bytes(b"\xef\xbb\xbf" + solid.read_bytes())
    assert len(read_triangles(solid)[1]) == len(faces)


def test_white_space_of_an_obj_may_be_any(y_mesh, tmp_path):
    vertices, faces = y_mesh
    path = write_obj(tmp_path / "lumen.obj", vertices, faces)
    text, plain = path.read_text(), read_triangles(path)
    changed = [text.replace(" ", "\t"), text.replace("\n", "\n  "), f"\ufeff{text}"]
    for other in changed:
        path.write_text(other.rstrip(" "), encoding="utf-8")
        for one, same in zip(read_triangles(path), plain, strict=True):
            np.testing.assert_array_equal(one, same)


def test_corners_of_an_obj_are_counted_back_from_where_they_stand(y_mesh, tmp_path):
    """Two objects, each with its points and then its triangles."""
    vertices, faces = y_mesh
    lines = []
    for points in (vertices, vertices + (90.0, 0.0, 0.0)):
        lines += [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in points]
        lines += [f"f {a}/1 {b}/1 {c}/1" for a, b, c in faces - len(vertices)]
    path = tmp_path / "lumen.obj"
    path.write_text("\n".join(lines) + "\n")
    points, triangles = read_triangles(path)
    both = np.concatenate([vertices[faces], vertices[faces] + (90.0, 0.0, 0.0)])
    np.testing.assert_allclose(points[triangles], both, atol=1e-4)
    path.write_text("\n".join(lines).replace(" -1/", " 0/"))
    with pytest.raises(ValueError, match="names point 0; OBJ counts from 1"):
        read_triangles(path)


def test_points_of_no_triangle_do_not_count_for_the_size(y_mesh, tmp_path):
    vertices, faces = y_mesh
    far = np.append(vertices, [[0.0, 0.0, 9000.0]], axis=0)
    trimesh.Trimesh(far, faces, process=False).export(tmp_path / "far.ply")
    assert read_lumen(tmp_path / "far.ply").units == "mm"
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.export(tmp_path / "lumen.ply", encoding="ascii")
    text = (tmp_path / "lumen.ply").read_text().rstrip()
    for corner in (len(vertices), -1):
        (tmp_path / "bad.ply").write_text(f"{text[: text.rindex(' ')]} {corner}\n")
        with pytest.raises(ValueError, match="bad.ply has triangles that name points"):
            read_lumen(tmp_path / "bad.ply")


def test_bytes_behind_an_stl_are_no_triangles(y_mesh, tmp_path):
    path = tmp_path / "lumen.stl"
    trimesh.Trimesh(*y_mesh, process=False).export(path)
    path.write_bytes(path.read_bytes() + b"\r\n")
    assert len(read_triangles(path)[1]) == len(y_mesh[1])
    # Of text, what is empty has no last line.
    path.write_bytes(b"solid lumen\n" + b"\n" * 9000)
    with pytest.raises(ValueError, match="it ends early, without 'endsolid'"):
        read_triangles(path)


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("lumen.stl", "lumen"),
        ("patient.v2.STL", "patient.v2"),
        ("a/labels.nii.gz", "labels"),
        ("ct.1.seg.nrrd", "ct.1"),
        (".lumen.stl", ".lumen"),
    ],
)
def test_only_the_ending_of_a_name_is_left_out(name, wanted):
    assert stem(name) == wanted


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.stl", b"<!DOCTYPE html>\n<html></html>\n" * 9, "content is no STL"),
        ("0.stl", b"\0" * 999, "name it after its format"),
        ("b.stl", b"v 1 2 3\nv 4 5 6\nv 7 8 9\nf 1 2 3\n" * 9, "begins with 'v 1 2 3"),
        ("c.vtu", b"<VTKFile>", "extract its surface first"),
        ("d.stl.gz", b"\x1f\x8b", "unpack it first"),
        ("e.dcm", b"DICM", "segment its lumen first"),
        ("f.glb", b"glTF", "vtk, or a label map in one of nii, nii.gz, nrrd"),
    ],
)
def test_files_of_other_kinds_are_named(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(words)):
        read_lumen(tmp_path / name)
    with pytest.raises(ValueError, match="is a directory; give one file"):
        read_lumen(tmp_path)


def test_bodies_that_overlap_are_to_be_united(y_mesh):
    vertices, faces = 1e-3 * y_mesh[0], y_mesh[1]
    points = [vertices, vertices + (5e-3, 0.0, 0.0)]
    both = np.concatenate([faces, faces + len(vertices)])
    with pytest.raises(ValueError, match="Some of them overlap: unite these"):
        mend("two", np.concatenate(points), both)
    points[1] = vertices + 0.2
    with pytest.raises(ValueError, match="Keep the largest island"):
        mend("two", np.concatenate(points), both)


@pytest.mark.parametrize("far", [60e-3, 5e-3], ids=["beside", "overlapping"])
def test_bodies_that_touch_in_a_point_are_two(y_mesh, far):
    """No device passes the point; one of them was taken, and the other was a ghost."""
    vertices, faces = 1e-3 * y_mesh[0], y_mesh[1]
    other, there = vertices + (far, 0.0, 0.0), vertices[:, 0].argmax()
    other[np.linalg.norm(other - vertices[there], axis=1).argmin()] = vertices[there]
    both = np.concatenate([faces, faces + len(vertices)])
    words = "unite these" if far < 0.01 else "Keep the largest island"
    with pytest.raises(ValueError, match=f"2 separate parts, .* {words}"):
        mend("two", np.concatenate([vertices, other]), both)


@pytest.mark.parametrize("what", ["small body", "wall"])
def test_what_touches_a_lumen_in_a_point_may_belong_to_it(y_mesh, what):
    vertices, faces = 1e-3 * y_mesh[0], y_mesh[1]
    there = vertices[:, 0].argmax()
    if what == "wall":
        more, rows = vertices + 0.1e-3 * normals(vertices, faces), faces
        more[there] = vertices[there]
    else:
        ball = trimesh.creation.icosphere(subdivisions=1, radius=1e-3)
        more, rows = np.array(ball.vertices), ball.faces
        more += vertices[there] - more[more[:, 0].argmin()]
    both = np.concatenate([faces, rows + len(vertices)])
    one = bodies.found(*topology.merged(np.concatenate([vertices, more]), both))
    assert one.label.max() == 0


def normals(vertices, faces):
    return trimesh.Trimesh(vertices, faces, process=False).vertex_normals


@pytest.mark.parametrize("where", ["inside", "in the wall", "outside"])
def test_small_bodies_in_the_lumen_are_dropped_though_wide(where):
    vertices, faces = tube(24e-3, 400e-3)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=4e-3)
    off = {"inside": 0.0, "in the wall": 12e-3, "outside": 30e-3}[where]
    points = np.concatenate([vertices, ball.vertices + (off, 0.0, 0.2)])
    both = np.concatenate([faces, ball.faces + len(vertices)])
    wide = topology.widths(points, both, topology.parts(both))
    assert wide[1] == pytest.approx(np.linalg.norm(ball.extents))
    if where == "outside":
        with pytest.raises(ValueError, match="2 separate parts"):
            mend("tube", points, both)
        return
    surface, notes, _ = mend("tube", points, both)
    assert surface.volume == pytest.approx(mend("tube", vertices, faces)[0].volume)
    assert any("1 small parts" in note for note in notes)


def test_corners_that_hardly_differ_are_one(y_mesh):
    vertices, faces = 1e-3 * y_mesh[0], y_mesh[1]
    soup = vertices[faces].reshape(-1, 3)
    soup = np.concatenate([soup, soup[2::-1]])  # a triangle given twice, once turned
    soup = soup + np.random.default_rng(0).normal(0.0, 1e-8, soup.shape)
    surface, notes, _ = mend("soup", soup, np.arange(len(soup)).reshape(-1, 3))
    assert not any(each in note for note in notes for each in ("hole", "open", "share"))
    clean = mend("y", vertices, faces)[0]
    assert surface.volume == pytest.approx(clean.volume, rel=1e-4)
    # A surface whose corners are apart stays as it is.
    cut = faces[:-9]
    assert topology.joined(vertices, cut)[1] is cut


WAY = np.array([(1.5, 2.0, 3.0), (4.0, 5.25, 6.0), (7.0, 8.0, 9.0)])


def table(heading, form, mark=","):
    rows = [form.format(k, *row).replace(";", mark) for k, row in enumerate(WAY)]
    return "\n".join([heading, *rows] if heading else rows)


@pytest.mark.parametrize(
    ("text", "sign"),
    [
        (table("", "{1};{2};{3}"), 1),
        (table("# x y z", "{1} {2} {3}"), 1),
        (table("id,x,y,z", "{0};{1};{2};{3}"), 1),
        (table("radius,x,y,z", "{0};{1};{2};{3}"), 1),
        (table("X (mm), Y (mm), Z (mm), r", "{1};{2};{3};{0}"), 1),
        (table("z;y;x", "{3};{2};{1}", ";"), 1),
        (table('"Radius","Points:0","Points:1","Points:2"', "{0};{1};{2};{3}"), 1),
        (table("R,A,S", "{1};{2};{3}"), -1),
        (table("x;y;z", "{1};{2};{3}", ";").replace(".", ","), 1),
        (table("", "{1};{2};{3}", "\t").replace(".", ","), 1),
        (table("one,two,three", "{1};{2};{3}"), 1),
        (table("u,v,w,radius", "{1};{2};{3};{0}"), 1),
    ],
)
def test_headings_say_which_columns_are_the_places(tmp_path, text, sign):
    (tmp_path / "lcca.csv").write_text(text)
    curve = read_curve(tmp_path / "lcca.csv")
    np.testing.assert_allclose(curve, 1e-3 * WAY * (sign, sign, 1), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (table("a,b,c,d", "{0};{1};{2};{3}"), "none are called x, y and z"),
        (table("", "{0};0;{1};{2};{3}"), "5 columns without headings"),
        (table("", "{1};{2};{3}").replace("3.0", ""), "columns"),
        ("x,y,z\n", "holds no numbers"),
    ],
)
def test_tables_that_do_not_say_are_refused(tmp_path, text, words):
    (tmp_path / "lcca.csv").write_text(text)
    with pytest.raises(ValueError, match=words):
        read_curve(tmp_path / "lcca.csv")


@pytest.mark.parametrize("name", ["Centerline curve.mrk.json", "頸動脈.mrk.json"])
def test_a_file_that_names_no_vessel_is_refused(tmp_path, name):
    path = write_markup(tmp_path / name, WAY)
    with pytest.raises(ValueError, match="is not called after a vessel; rename the"):
        read_curves([path], "mm", "LPS", None)


def test_points_of_a_curve_that_are_not_placed_are_left_out(tmp_path):
    path = write_markup(tmp_path / "lcca.mrk.json", WAY)
    markup = json.loads(path.read_text())
    place = {"position": [0.0, 0.0, 0.0], "positionStatus": "undefined"}
    markup["markups"][0]["controlPoints"].insert(1, place)
    path.write_text(json.dumps(markup))
    np.testing.assert_allclose(read_curve(path), 1e-3 * WAY)


@pytest.mark.slow
def test_frame_and_unit_of_the_file_are_kept(y_mesh, tmp_path, cathsim):
    """Places and centrelines are in the frame that the surface's file says."""
    path = slicer(tmp_path / "lumen.stl", *y_mesh, "RAS")
    code, out, _ = cathsim(
        "phantom", "import", str(path), "--out", str(tmp_path / "out")
    )
    assert code == 0
    assert "frame: RAS, as the file says" in json.loads(out)["notes"]
