"""Anatomies from disk: every wrong entry has its message; readers and writers meet."""

from __future__ import annotations

import hashlib
import io
import json

import numpy as np
import pytest

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.arch import arch


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    return arch.load("simple1").save(tmp_path_factory.mktemp("saved") / "a")


@pytest.fixture
def forged(saved, tmp_path):
    """Writes the anatomy anew after a change of its description and arrays."""

    def write(change) -> None:
        description = json.loads((saved / "anatomy.json").read_text())
        data = (saved / description["geometry"]).read_bytes()
        with np.load(io.BytesIO(data)) as archive:
            arrays = {key: archive[key] for key in archive.files}
        change(description, arrays)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        description["sha256"] = hashlib.sha256(buffer.getvalue()).hexdigest()
        (tmp_path / description["geometry"]).write_bytes(buffer.getvalue())
        (tmp_path / "anatomy.json").write_text(json.dumps(description))

    return write


def put(*keys_and_value):
    """A change that puts a value where the keys lead in the description."""
    *keys, last, value = keys_and_value

    def change(description, arrays):
        place = description
        for key in keys:
            place = place[key]
        place[last] = value

    return change


def array(name, edit):
    """A change of one array."""

    def change(description, arrays):
        arrays[name] = edit(np.array(arrays[name]))

    return change


def spoilt(row, value):
    def edit(values):
        values[row] = value
        return values

    return edit


WRONG = {
    "unit": (put("units", "mm"), "units is 'mm'"),
    "name": (put("name", 3), "name is 3; it must be a text"),
    "vessel": (put("vessels", 0, "left"), r"vessels\[0\] is 'left'"),
    "inlet far": (put("inlet", "position", [99.0, 0, 0]), "inlet lies 9.* outside"),
    "inlet text": (
        put("inlet", "position", "here"),
        "must be 3 numbers, each a finite",
    ),
    "goal": (put("goals", 0, "vessel", "renal"), "no vessel 'renal'"),
    "goal far": (
        put("goals", 0, "position", [0, 0, 3.0]),
        "goal .* outside the vessel",
    ),
    "nan": (
        array("surface_vertices", spoilt(5, np.nan)),
        "surface_vertices is .*finite numbers",
    ),
    "scale": (array("surface_vertices", lambda v: v * 1e3), "unit is not the metre"),
    "scanned": (put("scanned", "yes"), "scanned is 'yes'"),
    "shape": (array("vessel_0_radii", lambda v: v[:-1]), "vessel_0_radii is float64"),
    "faces": (array("surface_faces", spoilt(0, 10**8)), "faces name vertices"),
    "empty": (array("surface_faces", lambda f: f[:0]), "no triangles"),
    "pickle": (
        lambda d, a: a.update(vessel_0_radii=np.array([{}], dtype=object)),
        "damaged.*allow_pickle",
    ),
    "missing": (lambda d, a: a.pop("surface_faces", None) is None, "lacks the array"),
}


@pytest.mark.parametrize("fault", WRONG)
def test_a_wrong_entry_is_named_in_one_line(forged, tmp_path, fault):
    change, match = WRONG[fault]
    forged(change)
    with pytest.raises(ValueError, match=match) as error:
        Anatomy.load(tmp_path)
    assert "\n" not in str(error.value)


def test_what_was_not_changed_is_read(forged, tmp_path):
    forged(lambda description, arrays: None)
    assert Anatomy.load(tmp_path).name == "simple1"


def test_links_are_not_followed(forged, tmp_path):
    forged(lambda description, arrays: None)
    for name in ("geometry-*.npz", "anatomy.json"):
        (path,) = tmp_path.glob(name)
        away = tmp_path / f"away-{path.name}"
        path.rename(away)
        path.symlink_to(away)
        with pytest.raises(ValueError, match="symbolic link, which is not followed"):
            Anatomy.load(tmp_path)
        path.unlink()
        away.rename(path)


def test_an_archive_that_unpacks_to_gigabytes_is_refused(forged, tmp_path, monkeypatch):
    monkeypatch.setattr("cathsim_dmc.anatomy.loading.LARGEST_ARRAYS", 100_000)
    monkeypatch.setattr(
        "cathsim_dmc.anatomy.loading.read_regular", lambda path, most: path.read_bytes()
    )
    forged(lambda description, arrays: None)
    with pytest.raises(ValueError, match="its arrays unpack to"):
        Anatomy.load(tmp_path)
