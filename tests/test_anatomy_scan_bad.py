"""Scans that cannot be used: each refused in its own words, with nothing written."""

import json

import numpy as np
from synthetic_scans import marched, write_obj, y_tree


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
