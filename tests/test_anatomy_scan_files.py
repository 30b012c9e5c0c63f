"""Files of other programs: VTK's surfaces and centrelines, label maps, and images."""

import re
import struct
import zlib

import numpy as np
import pytest
from synthetic_scans import marched, y_tree

from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.anatomy.scan.curves import read_curves
from cathsim_dmc.anatomy.scan.labels import label_surface
from cathsim_dmc.anatomy.scan.mesh import read_triangles, stated_frame


def poly_data(points, faces=(), lines=(), **cells):
    """A vtkPolyData of points, triangles, lines and arrays of its cells."""
    core = pytest.importorskip("vtkmodules.vtkCommonCore")
    model = pytest.importorskip("vtkmodules.vtkCommonDataModel")
    from vtkmodules.util.numpy_support import numpy_to_vtk

    data, places = model.vtkPolyData(), core.vtkPoints()
    places.SetData(numpy_to_vtk(np.asarray(points, dtype=float), deep=True))
    data.SetPoints(places)
    for rows, put in ((faces, data.SetPolys), (lines, data.SetLines)):
        array = model.vtkCellArray()
        for row in rows:
            array.InsertNextCell(len(row), [int(k) for k in row])
        put(array)
    for name, values in cells.items():
        array = numpy_to_vtk(np.asarray(values), deep=True)
        array.SetName(name)
        data.GetCellData().AddArray(array)
    return data


def written(data, path):
    """The file of a vtkPolyData, in VTK's old or new format."""
    from vtkmodules import vtkIOLegacy, vtkIOXML

    old = path.suffix == ".vtk"
    writer = (vtkIOLegacy.vtkPolyDataWriter if old else vtkIOXML.vtkXMLPolyDataWriter)()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    writer.Write()
    return path


def test_surfaces_in_the_old_format_of_vtk(tmp_path):
    vertices, faces = marched(y_tree(), 3e-3)
    path = written(poly_data(vertices, faces), tmp_path / "lumen.vtk")
    points, triangles = read_triangles(path)
    np.testing.assert_allclose(points[triangles], vertices[faces], atol=1e-4)
    line = written(poly_data(vertices, (), [range(9)]), tmp_path / "line.vtk")
    with pytest.raises(ValueError, match="0 triangles.*lines are centrelines"):
        read_triangles(line)
    volume = tmp_path / "volume.vtk"
    text = path.read_bytes().replace(b"DATASET POLYDATA", b"DATASET UNSTRUCTURED_GRID")
    volume.write_bytes(text)
    with pytest.raises(ValueError, match="no PolyData; extract the surface first"):
        read_triangles(volume)


@pytest.mark.parametrize("share", [0.8, 0.99])
@pytest.mark.parametrize("kind", ["binary .vtk", "text .vtk", ".vtp"])
def test_a_surface_of_vtk_that_is_cut_off_is_refused(tmp_path, kind, share, capfd):
    data = poly_data(*marched(y_tree(), 3e-3))
    from vtkmodules import vtkIOLegacy

    path = tmp_path / f"lumen{kind.split()[-1]}"
    if kind == ".vtp":
        written(data, path)
    else:
        writer = vtkIOLegacy.vtkPolyDataWriter()
        writer.SetFileName(str(path))
        writer.SetInputData(data)
        writer.SetFileType(2 if kind.startswith("binary") else 1)
        writer.Write()
    read_triangles(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match="damaged or cut off"):
        read_triangles(path)
    assert not capfd.readouterr().err


@pytest.mark.parametrize("ending", [".vtp", ".vtk"])
def test_the_centrelines_of_vmtk(tmp_path, ending):
    """A file holds all ways; those that are split at forks are joined again."""
    t = np.linspace(0.0, 1.0, 11)[:, None]
    stem, one, other = (
        a + t * (np.array(b) - a)
        for a, b in (
            (np.zeros(3), (0, 0, 30)),
            (np.array((0, 0, 30)), (10, 0, 60)),
            (np.array((0, 0, 30)), (-10, 0, 60)),
        )
    )
    points = np.concatenate([stem, one, other])
    rows = [np.arange(11), np.arange(11, 22), np.arange(22, 33)]
    whole = [[*rows[0], *rows[1]], [*rows[0], *rows[2]]]
    path = written(poly_data(points, (), whole), tmp_path / f"centreline-A{ending}")
    curves = read_curves([path], "mm", "RAS", None)
    assert list(curves) == ["a_1", "a_2"]
    np.testing.assert_allclose(curves["a_1"][-1], (-10e-3, 0, 60e-3), atol=1e-6)
    assert len(curves["a_1"]) == 21  # the fork is in both pieces
    # The second piece of the first way comes before its first.
    split = [rows[1], rows[0], rows[0], rows[2]]
    ids = {"CenterlineIds": [0, 0, 1, 1], "TractIds": [1, 0, 0, 1]}
    path = written(poly_data(points, (), split, **ids), tmp_path / f"b{ending}")
    again = read_curves([path], "mm", "RAS", None)
    for name, curve in curves.items():
        np.testing.assert_allclose(again[name.replace("a", "b")], curve, atol=1e-9)
    single = written(poly_data(points, (), [rows[0]]), tmp_path / f"lcca{ending}")
    assert list(read_curves([single], "mm", "LPS", None)) == ["lcca"]
    none = written(poly_data(points, [(0, 11, 22)]), tmp_path / f"none{ending}")
    with pytest.raises(ValueError, match="holds no lines"):
        read_curves([none], "mm", "LPS", None)


SPACING, ORIGIN = np.array((0.8, 0.9, 1.0)), np.array((5.0, -3.0, 20.0))
TURN = np.array([(0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])  # rows: axes


def ball():
    """Labels of a ball off the middle of a box of voxels."""
    ijk = np.stack(np.meshgrid(*map(np.arange, (30, 26, 22)), indexing="ij"), -1)
    return (np.linalg.norm((ijk - (16, 11, 10)) * SPACING, axis=-1) < 6).astype("u1")


def meta(path, voxels, element="MET_UCHAR", packed=True):
    """A MetaImage, its voxels in the same file."""
    data = voxels.transpose().tobytes()
    body = zlib.compress(data) if packed else data
    entries = {
        "ObjectType": "Image",
        "NDims": 3,
        "BinaryData": True,
        "BinaryDataByteOrderMSB": False,
        "CompressedData": packed,
        **({"CompressedDataSize": len(body)} if packed else {}),
        "TransformMatrix": " ".join(f"{x:g}" for x in TURN.ravel()),
        "Offset": " ".join(f"{x:g}" for x in ORIGIN),
        "ElementSpacing": " ".join(f"{x:g}" for x in SPACING),
        "DimSize": " ".join(map(str, voxels.shape)),
        "ElementType": element,
        "ElementDataFile": "LOCAL",
    }
    head = "".join(f"{key} = {value}\n" for key, value in entries.items())
    path.write_bytes(head.encode() + body)
    return path


@pytest.mark.parametrize("kind", ["mha", "mha packed", "nhdr"])
def test_label_maps_of_itk_lie_where_they_were_saved(tmp_path, kind):
    if kind == "nhdr":
        nrrd = pytest.importorskip("nrrd")
        path = tmp_path / "map.nhdr"
        header = {
            "space": "left-posterior-superior",
            "space directions": TURN * SPACING[:, None],
            "space origin": ORIGIN,
        }
        nrrd.write(str(path), ball(), header, detached_header=True)
    else:
        pytest.importorskip("vtkmodules")
        path = meta(tmp_path / "map.mha", ball(), packed="packed" in kind)
    vertices, faces, (why,), _ = label_surface(path)
    middle = 1e-3 * (ORIGIN + (np.array((16, 11, 10)) * SPACING) @ TURN)
    np.testing.assert_allclose(vertices.mean(axis=0), middle, atol=0.1e-3)
    assert np.linalg.norm(vertices - middle, axis=1).max() < 7e-3
    assert len(faces) > 100 and "label 1" in why and "voxels of 0.8 x 0.9 x 1 mm" in why


@pytest.mark.parametrize("packed", [False, True])
def test_an_image_of_itk_that_is_cut_off_is_refused(tmp_path, packed):
    """What is missing would have any values."""
    pytest.importorskip("vtkmodules")
    path = meta(tmp_path / "map.mha", ball(), packed=packed)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="read as MHA: it is damaged or cut off"):
        label_surface(path)


def slices(folder, named, *listed, **entries):
    """A MetaImage of the ball whose voxels are in the files slice0.raw to slice21.raw.

    They are in all.raw, too.
    """
    path = meta(folder / "map.mhd", ball(), packed=False)
    head = path.read_bytes().partition(b"ElementDataFile")[0].decode()
    for key, value in entries.items():
        head = re.sub(f"{key} = .*", f"{key} = {value}", head)
    path.write_text(head + "\n".join([f"ElementDataFile = {named}", *listed, ""]))
    for number in range(22):
        data = ball()[:, :, number].transpose().tobytes()
        (folder / f"slice{number}.raw").write_bytes(data)
    (folder / "all.raw").write_bytes(ball().transpose().tobytes())
    return path


NAMES = [f"slice{number}.raw" for number in range(22)]


@pytest.mark.parametrize(
    ("named", "listed"),
    [
        ("all.raw", ()),
        ("LIST", NAMES),
        ("LIST 2", [*NAMES, "more.raw"]),
        ("slice%d.raw 0", ()),
        ("./slice%d.raw 0 21 1", ()),
    ],
)
def test_the_slices_of_a_metaimage_may_have_their_own_files(tmp_path, named, listed):
    pytest.importorskip("vtkmodules")
    whole = label_surface(meta(tmp_path / "map.mha", ball(), packed=False)).vertices
    path = slices(tmp_path, named, *listed)
    assert np.array_equal(label_surface(path).vertices, whole)


def test_an_axis_of_negative_spacing_runs_backwards(tmp_path):
    """As ITK reads it: a voxel's place is its index times the spacing."""
    pytest.importorskip("vtkmodules")
    path = slices(tmp_path, "all.raw", ElementSpacing="0.8 -0.9 1.0")
    vertices, faces, *_ = label_surface(path)
    middle = ORIGIN + (np.array((16, 11, 10)) * SPACING * (1, -1, 1)) @ TURN
    np.testing.assert_allclose(vertices.mean(axis=0), 1e-3 * middle, atol=0.1e-3)
    assert Surface(vertices, faces).volume > 0.0


@pytest.mark.parametrize(
    ("named", "listed", "words"),
    [
        ("LIST", NAMES[:9], "its list names 9 files for 22 slices"),
        ("LIST", [*NAMES[:9], "", *NAMES[9:]], "its list names 21 files for 22"),
        ("LIST", ["\n".join(NAMES)], "its list names 21 files for 22"),
        ("LIST 3", ["all.raw"], "list one file for each slice"),
        ("LIST", [*NAMES[:-1], "../slice21.raw"], "outside its folder"),
        ("slice%d.raw 3 21 1", (), "names 19 of 22 slices"),
        ("slice%d.raw 0 21", (), "the last slice and the step"),
        ("slice%d.raw 0 21 0", (), "the last slice and the step"),
        ("slice%d.raw 0 21 -1", (), "the last slice and the step"),
        ("slice%s.raw 0", (), "give one %d"),
        ("slice%d%d.raw 0", (), "give one %d"),
        ("../all.raw", (), "outside its folder"),
        ("/all.raw", (), "outside its folder"),
    ],
)
def test_files_of_voxels_that_are_missing_or_elsewhere_are_refused(
    tmp_path, named, listed, words
):
    """VTK leaves their voxels undefined, or divides by zero."""
    pytest.importorskip("vtkmodules")
    path = slices(tmp_path, named, *listed)
    if len(listed) == 1 and listed[0].count("\n") == 21:  # VTK skips the last line
        path.write_bytes(path.read_bytes().removesuffix(b"\n"))
    with pytest.raises(ValueError, match=words):
        label_surface(path)


def test_a_packed_slice_that_is_damaged_is_refused(tmp_path):
    pytest.importorskip("vtkmodules")
    path = slices(tmp_path, "LIST", *NAMES, CompressedData="True")
    for name in NAMES:
        data = zlib.compress((tmp_path / name).read_bytes())
        (tmp_path / name).write_bytes(data)
    (tmp_path / NAMES[11]).write_bytes(data[:-1])
    with pytest.raises(ValueError, match="damaged or cut off"):
        label_surface(path)


@pytest.mark.parametrize("kind", ["nii.gz", "mha"])
def test_a_label_map_whose_packed_voxels_are_damaged_is_refused(tmp_path, kind):
    """They unpack to other labels, which only the checksum at the end tells."""
    path = tmp_path / f"map.{kind}"
    if kind == "mha":
        pytest.importorskip("vtkmodules")
        meta(path, ball())
        data = bytearray(path.read_bytes())
    else:
        nibabel = pytest.importorskip("nibabel")
        nibabel.save(nibabel.Nifti1Image(ball(), np.eye(4)), path)
        data = bytearray(path.read_bytes())
    label_surface(path)
    data[-2] ^= 1  # in the size or the checksum at the end
    path.write_bytes(data)
    with pytest.raises(ValueError, match="cannot be read as"):
        label_surface(path)


@pytest.mark.parametrize("element", ["MET_LONG", "MET_LONG_LONG"])
def test_an_image_of_itk_with_numbers_that_vtk_does_not_read_is_refused(
    tmp_path, element
):
    pytest.importorskip("vtkmodules")
    path = meta(tmp_path / "map.mha", ball().astype("i8"), element, packed=False)
    with pytest.raises(ValueError, match=f"{element}; save them as .* MET_UCHAR"):
        label_surface(path)


def test_an_image_of_colours_is_told(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    voxels = np.zeros((8, 8, 8), dtype=[(name, "u1") for name in "RGB"])
    nibabel.save(nibabel.Nifti1Image(voxels, np.eye(4)), tmp_path / "map.nii")
    with pytest.raises(ValueError, match="several numbers .* so it is an image"):
        label_surface(tmp_path / "map.nii")


@pytest.mark.parametrize(("axis", "edge"), [(2, 0.0), (0, np.nan)], ids=["flat", "nan"])
def test_voxels_without_a_place_are_refused(tmp_path, axis, edge):
    nrrd = pytest.importorskip("nrrd")
    directions = np.eye(3)
    directions[axis, axis] = edge
    header = {"space": "left-posterior-superior", "space directions": directions}
    nrrd.write(str(tmp_path / "map.nrrd"), ball(), header)
    with pytest.raises(ValueError, match="no place in space: .* Mend spacing"):
        label_surface(tmp_path / "map.nrrd")


def test_labels_of_few_voxels_are_refused(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    voxels = ball()
    voxels[2, 2, 2] = 9
    header = {"space": "left-posterior-superior", "space directions": np.eye(3)}
    nrrd.write(str(tmp_path / "map.nrrd"), voxels, header)
    with pytest.raises(ValueError, match=r"label 9 of .* has 1 voxels, .*\(--label\)"):
        label_surface(tmp_path / "map.nrrd", (9,))


def test_a_header_names_no_file_elsewhere(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    path = tmp_path / "map.nhdr"
    nrrd.write(str(path), ball(), detached_header=True)
    text = path.read_bytes()
    start = text.index(b"data file: ") + 11
    stop = text.index(b"\n", start)
    for elsewhere in (b"/etc/hostname", b"../map.raw.gz"):
        path.write_bytes(text[:start] + elsewhere + text[stop:])
        with pytest.raises(ValueError, match="another file, .* outside its folder"):
            label_surface(path)


@pytest.mark.parametrize(
    ("voxels", "words"),
    [
        (np.zeros((0, 4, 4), "u1"), r"has the shape \(0, 4, 4\); give one label map"),
        (np.where(np.eye(4), np.inf, np.ones((4, 4, 4))), "numbers that are not whol"),
    ],
)
def test_voxels_that_are_none_or_infinite_are_no_labels(tmp_path, voxels, words):
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(voxels.astype("f4"), np.eye(4))
    nibabel.save(image, tmp_path / "map.nii")
    with pytest.raises(ValueError, match=words):
        label_surface(tmp_path / "map.nii")


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (lambda noise: (40 * noise).astype("i2"), "negative numbers"),
        (lambda noise: (40 * noise + 2000).astype("i2"), "neighbours that differ"),
        (lambda noise: (300 * noise + 9000).astype("i2"), "different numbers"),
    ],
    ids=["CT", "few grey values", "many"],
)
def test_images_are_told_from_label_maps(tmp_path, image, words):
    nibabel = pytest.importorskip("nibabel")
    noise = np.random.default_rng(0).normal(size=(16, 16, 16))
    path = tmp_path / "image.nii.gz"
    nibabel.save(nibabel.Nifti1Image(image(noise), np.eye(4)), path)
    with pytest.raises(
        ValueError, match=f"{words}.*so it is an image; segment"
    ) as error:
        label_surface(path, (1,))
    assert "\n" not in str(error.value)
    # Many labels in thin vessels are none.
    labels = ball().astype("i2") * 300
    labels[:, :12] = np.where(labels[:, :12], 120, 0)
    labels[2:20:3] = 7
    nibabel.save(nibabel.Nifti1Image(labels, np.eye(4)), path)
    assert "label 300" in label_surface(path, (300,)).notes[0]


def polygons(path, points, rows, order="<"):
    """A binary PLY file of polygons, with a colour behind each."""
    kind = "little" if order == "<" else "big"
    head = [
        "ply",
        f"format binary_{kind}_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(rows)}",
        "property list uchar int vertex_indices",
        "property uchar red",
        "end_header\n",
    ]
    corners = (struct.pack(f"{order}B{len(row)}iB", len(row), *row, 7) for row in rows)
    data = np.asarray(points, f"{order}f8").tobytes() + b"".join(corners)
    path.write_bytes("\n".join(head).encode() + data)
    return path


@pytest.mark.parametrize("order", ["<", ">"])
def test_polygons_of_a_binary_ply_differ_in_their_corners(tmp_path, order):
    """As Blender writes them: quads along a vessel, and one polygon for each cap."""
    angle = np.linspace(0.0, 2.0 * np.pi, 9)[:-1]
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    points = np.concatenate([ring + (0.0, 0.0, z) for z in range(4)])
    sides = [
        (8 * z + k, 8 * z + (k + 1) % 8, 8 * z + 8 + (k + 1) % 8, 8 * z + 8 + k)
        for z in range(3)
        for k in range(8)
    ]
    rows = [range(7, -1, -1), *sides[:9], sides[9][:3], *sides[10:], range(24, 32)]
    rows.append((sides[9][0], *sides[9][2:]))
    path = polygons(tmp_path / "lumen.ply", points, rows, order)
    vertices, faces = read_triangles(path)
    assert len(faces) == 2 * 24 + 2 * 6
    corners = vertices[faces]
    volume = np.linalg.det(corners).sum() / 6.0
    assert volume == pytest.approx(3.0 * 8.0 * np.sin(np.pi / 4) / 2.0)
    whole = path.read_bytes()
    path.write_bytes(whole + b"\n")
    assert len(read_triangles(path)[1]) == len(faces)
    path.write_bytes(whole[:-20])
    with pytest.raises(ValueError, match="it ends early, 2 of 27 rows are missing"):
        read_triangles(path)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_headers_of_ply_end_where_a_line_says_so(tmp_path, end, form):
    points, faces = marched(y_tree(), 3e-3)
    path = polygons(tmp_path / "lumen.ply", points, faces)
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    if form == "ascii":
        head = head.replace(b"binary_little_endian", b"ascii")
        head = head.replace(b"property uchar red\n", b"")
        rows = [" ".join(map(repr, point)) for point in points.tolist()]
        rows += [" ".join(map(str, (3, *face))) for face in faces.tolist()]
        body = end.join([*rows, ""]).encode()
    note = b"comment 3 mm behind end_header\ncomment SPACE=RAS\nelement"
    head = head.replace(b"element", note, 1)
    path.write_bytes((head + mark).replace(b"\n", end.encode()) + body)
    vertices, triangles = read_triangles(path)
    np.testing.assert_allclose(vertices[triangles], points[faces])
    assert stated_frame(path) == "RAS"
    path.write_bytes(head + b"end header\n" + body)
    with pytest.raises(ValueError, match="has no line 'end_header'"):
        read_triangles(path)
    if form == "ascii":
        path.write_bytes((head + mark).replace(b"\n", end.encode()) + body[:-400])
        with pytest.raises(ValueError, match="it ends early"):
            read_triangles(path)


def lines_of_obj():
    points, faces = marched(y_tree(), 3e-3)
    rows = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in points]
    return rows, [f"f {a} {b} {c}" for a, b, c in faces + 1]


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("comment", ["", " # side 3", "#1,5"])
def test_an_obj_file_of_any_program_is_the_same_surface(tmp_path, comment, end):
    points, faces = lines_of_obj()
    (tmp_path / "plain.obj").write_text("\n".join([*points, *faces, ""]))
    vertices, triangles = read_triangles(tmp_path / "plain.obj")
    rows = ["# SPACE=RAS", *(row + comment for row in points), "g a#1"]
    rows += [row + comment for row in faces[:400]] + faces[400:]
    path = tmp_path / "other.obj"
    path.write_bytes(end.join([*rows, ""]).encode())
    other, corners = read_triangles(path)
    assert np.array_equal(other, vertices) and np.array_equal(corners, triangles)
    path.write_bytes(end.join(rows)[:-3000].encode())
    with pytest.raises(ValueError, match="it ends early, in 'f"):
        read_triangles(path)


def lines_of_stl(name, corners):
    rows = [f"solid {name}"]
    for triangle in corners:
        rows += ["facet normal 0 0 0", "outer loop"]
        rows += [f"vertex {x:.4f} {y:.4f} {z:.4f}" for x, y, z in triangle]
        rows += ["endloop", "endfacet"]
    return [*rows, f"endsolid {name}"]


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_the_solids_of_a_text_stl_are_one_surface(tmp_path, end):
    points, faces = marched(y_tree(), 3e-3)
    corners = points[faces]
    rows = lines_of_stl("a", corners[:400]) + lines_of_stl("b", corners[400:])
    path = tmp_path / "solids.stl"
    path.write_bytes(end.join([*rows, ""]).encode())
    vertices, triangles = read_triangles(path)
    np.testing.assert_allclose(vertices[triangles], corners, atol=1e-4)


@pytest.mark.parametrize("kind", ["obj", "stl", "ply"])
def test_decimal_commas_are_named(tmp_path, kind):
    rows, front = [row for group in lines_of_obj() for row in group], ""
    if kind == "stl":
        points, faces = marched(y_tree(), 3e-3)
        rows = lines_of_stl("a", points[faces])
    if kind == "ply":
        points, faces = lines_of_obj()
        front = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
        front += "".join(f"property float {axis}\n" for axis in "xyz")
        front += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
        front += "end_header\n"
        rows = [row[2:] for row in points]
        rows += [f"3 {a} {b} {c}" for a, b, c in marched(y_tree(), 3e-3)[1]]
    text = "\n".join([*rows, ""])
    path = tmp_path / f"lumen.{kind}"
    path.write_text(front + text)
    assert len(read_triangles(path)[1]) > 1000
    path.write_text(front + text.replace(".", ","))
    with pytest.raises(ValueError, match=r"decimal commas \(\d+,\d+\)"):
        read_triangles(path)
