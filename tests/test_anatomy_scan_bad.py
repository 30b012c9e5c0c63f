"""Scans that cannot be used: each refused in its own words, with nothing written."""

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic_scans import marched, write_obj, y_tree

from cathsim_dmc.anatomy.scan.importer import import_scan
from cathsim_dmc.validation.checks import Report


def scans(vertices, faces):
    """Name, file, its bytes or its mesh, further arguments, words of the error."""
    spiked, broken = vertices.copy(), vertices.copy()
    spiked[np.linalg.norm(spiked - (6, 0, 25), axis=1).argmin()] = (-25, 0, 25)
    broken[7] = np.nan
    both = np.concatenate([vertices, vertices + 200.0])
    both = both, np.concatenate([faces, faces + len(vertices)])
    good, drawn = (vertices, faces), ["--centreline", "bca.mrk.json"]
    flat = vertices * (1.0, 1.0, 0.0), faces
    yield "empty", "scan.stl", b"", [], "is empty (0 bytes)"
    yield "text", "scan.ply", b"Dear all,\ntomorrow.\n", [], "cannot be read"
    yield "format", "scan.glb", b"glTF", [], "formats obj, stl, ply, vtp"
    pierced = "intersects itself: 5 triangles, one at"
    yield "intersecting", "scan.obj", (spiked, faces), [], pierced
    yield "two parts", "scan.obj", both, [], "2 separate parts"
    yield "no volume", "scan.obj", flat, [], ""
    bad = "1 vertices whose coordinates are NaN"
    yield "not finite", "scan.obj", (broken, faces), [], bad
    yield "wrong unit", "scan.obj", good, ["--units", "m"], "pass units='mm'"
    yield "no curve", "scan.obj", good, drawn, "no centreline file bca.mrk.json"
    yield "half a curve", "scan.obj", good, drawn, "is no 3D Slicer markup"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"labels": 1}, "^labels is .*; it must be an array of integers"),
        ({"labels": (1.5,)}, "^labels is .*; it must be an array of integers"),
        ({"labels": "1"}, "^labels is .*; it must be an array of integers"),
        ({"name": 3}, "^name is 3; it must be a text"),
        ({"device": "wire_035_glide"}, "^device is 'wire_035_glide'; it must be a dev"),
    ],
)
def test_options_of_another_kind_are_refused_before_the_scan_is_read(options, words):
    with pytest.raises(ValueError, match=words):
        import_scan("missing.nii", **options)


def test_bad_scans_are_told_apart_and_leave_nothing(tmp_path, monkeypatch, cathsim):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    said = {}
    for name, file, content, arguments, words in scans(*marched(y_tree(), 2.0e-3)):
        folder = tmp_path / name
        folder.mkdir()
        monkeypatch.chdir(folder)
        if isinstance(content, bytes):
            (folder / file).write_bytes(content)
        else:
            write_obj(folder / file, *content)
        if name == "half a curve":
            curve = json.dumps({"markups": [{"type": "Curve", "controlPoints": []}]})
            (folder / "bca.mrk.json").write_text(curve[: len(curve) // 2])
        before = sorted(folder.iterdir())
        code, out, err = cathsim("phantom", "import", file, *arguments, "--out", "OUT")
        assert code == 2 and not out, name
        assert "Traceback" not in err
        message = " ".join(err.split())
        assert words in message, f"{name}: {message}"
        # Progress before it is the same for several; its end is not.
        said[name] = err.strip().splitlines()[-1]
        assert sorted(folder.iterdir()) == before, "something was written"
    assert len(set(said.values())) == len(said) == 10, said
    assert not list((tmp_path / "cache" / "cathsim_dmc").glob("**/*"))


@pytest.mark.parametrize("more", [(), ("--out", "./type1")])
def test_an_import_is_not_called_as_a_phantom_is(tmp_path, monkeypatch, cathsim, more):
    """Tasks would take the phantom, and its picture would replace the patient's."""
    monkeypatch.chdir(tmp_path)
    write_obj(tmp_path / "type1.obj", *marched(y_tree(), 4e-3))
    code, _, err = cathsim("phantom", "import", "type1.obj", *more)
    assert code == 2 and "as a phantom is" in err and "(--out), such as" in err
    assert not (tmp_path / "type1").exists()
    (tmp_path / "simple1").mkdir()
    measured = Report("wall", [], {"simple1": {"measures": {}}})
    monkeypatch.setattr(
        "cathsim_dmc.validation.wall.validate_anatomy", lambda anatomy: measured
    )
    assert cathsim("phantom", "check", "simple1", "--json")[0] == 0
    assert not list((tmp_path / "simple1").iterdir())


def test_a_folder_of_images_is_told_from_a_folder_in_the_way(
    tmp_path, monkeypatch, cathsim
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dicom").mkdir()
    code, _, err = cathsim("phantom", "import", "dicom")
    assert code == 2 and "dicom is a directory; give one file" in err
    write_obj(tmp_path / "dicom.obj", *marched(y_tree(), 4e-3))
    code, _, err = cathsim("phantom", "import", "dicom.obj")
    assert code == 2 and "dicom exists and is no anatomy" in err


def test_an_option_given_again_adds_its_values(tmp_path, monkeypatch, cathsim):
    """Only the last counted: of a lumen of two labels one was imported."""
    seen = {}

    def imported(mesh, curves, **options):
        seen.update(options, curves=curves)
        raise ValueError("seen")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cathsim_dmc.cli.phantoms.import_scan", imported)
    words = "--label 52 54 --label 55 --rename a=b --rename c=d e=f"
    words += " --centreline x.csv --centreline y.csv"
    assert cathsim("phantom", "import", "scan.nii", *words.split())[0] == 2
    assert seen["labels"] == (52, 54, 55)
    assert seen["rename"] == {"a": "b", "c": "d", "e": "f"}
    assert seen["curves"] == (Path("x.csv"), Path("y.csv"))
