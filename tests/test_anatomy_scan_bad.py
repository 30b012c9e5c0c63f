"""Scans that cannot be used: each refused in its own words, with nothing written."""

import json

import numpy as np
import pytest
from synthetic_scans import marched, write_obj, y_tree


@pytest.fixture(scope="module")
def y_mesh():
    return marched(y_tree(), 2.0e-3)


def empty(y_mesh, folder):
    (folder / "scan.stl").touch()
    return ["scan.stl"], r"is empty (0 bytes)"


def text(y_mesh, folder):
    (folder / "scan.ply").write_text("Dear all,\nthe scan follows tomorrow.\n")
    return ["scan.ply"], "cannot be read"


def intersecting(y_mesh, folder):
    vertices, faces = y_mesh
    spiked = vertices.copy()
    spiked[np.linalg.norm(spiked - (6, 0, 25), axis=1).argmin()] = (-25, 0, 25)
    write_obj(folder / "scan.obj", spiked, faces)
    return ["scan.obj"], "intersects itself: 5 triangles, one at"


def two_components(y_mesh, folder):
    vertices, faces = y_mesh
    both = np.concatenate([vertices, vertices + 200.0])
    write_obj(folder / "scan.obj", both, np.concatenate([faces, faces + len(vertices)]))
    return ["scan.obj"], "2 separate parts"


def no_volume(y_mesh, folder):
    vertices, faces = y_mesh
    write_obj(folder / "scan.obj", vertices * (1.0, 1.0, 0.0), faces)
    return ["scan.obj"], ""


def not_finite(y_mesh, folder):
    vertices, faces = y_mesh
    broken = vertices.copy()
    broken[7] = np.nan
    write_obj(folder / "scan.obj", broken, faces)
    return ["scan.obj"], "1 vertices whose coordinates are NaN"


def wrong_unit(y_mesh, folder):
    write_obj(folder / "scan.obj", *y_mesh)
    return ["scan.obj", "--units", "m"], "pass units='mm'"


def missing_centreline(y_mesh, folder):
    write_obj(folder / "scan.obj", *y_mesh)
    return [
        "scan.obj",
        "--centreline",
        "bca.mrk.json",
    ], "no centreline file bca.mrk.json"


def truncated_centreline(y_mesh, folder):
    write_obj(folder / "scan.obj", *y_mesh)
    curve = json.dumps({"markups": [{"type": "Curve", "controlPoints": []}]})
    (folder / "bca.mrk.json").write_text(curve[: len(curve) // 2])
    return ["scan.obj", "--centreline", "bca.mrk.json"], "is not JSON"


def another_format(y_mesh, folder):
    (folder / "scan.glb").write_bytes(b"glTF")
    return ["scan.glb"], "formats obj, stl, ply, vtp"


SCANS = (
    empty,
    text,
    intersecting,
    two_components,
    no_volume,
    not_finite,
    wrong_unit,
    missing_centreline,
    truncated_centreline,
    another_format,
)


def test_bad_scans_are_told_apart_and_leave_nothing(
    y_mesh, tmp_path, monkeypatch, cathsim
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    said = {}
    for scan in SCANS:
        folder = tmp_path / scan.__name__
        folder.mkdir()
        monkeypatch.chdir(folder)
        arguments, words = scan(y_mesh, folder)
        before = sorted(folder.iterdir())
        code, out, err = cathsim("phantom", "import", *arguments, "--out", "OUT")
        assert code == 2 and not out, scan.__name__
        assert "Traceback" not in err
        message = " ".join(err.split())
        assert words in message, f"{scan.__name__}: {message}"
        # Progress before it is the same for several; its end is not.
        said[scan.__name__] = err.strip().splitlines()[-1]
        assert sorted(folder.iterdir()) == before, "something was written"
    assert len(set(said.values())) == len(SCANS), said
    assert not list((tmp_path / "cache" / "cathsim_dmc").glob("**/*"))
