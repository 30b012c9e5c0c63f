"""Damaged files at every loader: refused, by path, and nothing is written."""

import json

import numpy as np
import pytest
from bad_values import try_all, try_bytes, try_json
from hypothesis import strategies as st
from synthetic_scans import write_markup

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.scan.curves import read_curve
from cathsim_dmc.anatomy.tree_file import read_tree
from cathsim_dmc.validation import force_sensors


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """One good file or folder of every kind."""
    folder = tmp_path_factory.mktemp("store")
    force_sensors.straight_tube(0.06, 4e-3).save(folder / "anatomy")
    points = [[0, 0, z] for z in range(0, 50, 5)]
    write_markup(folder / "centreline-lcca.mrk.json", points, radii=[4.0] * 10)
    tree = {
        "format": "cathsim-vessel-tree",
        "version": 1,
        "name": "made up",
        "units": "mm",
        "frame": "LPS",
        "vessels": {
            "aorta": {
                "parent": None,
                "points_mm": [[0.0, 0, 0], [0, 0, 50], [0, 10, 100]],
                "radii_mm": [12.0, 12.0, 11.0],
            },
            "bca": {
                "parent": "aorta",
                "points_mm": [[0.0, 0, 60], [20, 0, 80], [40, 0, 110]],
                "radii_mm": [5.0, 5.0, 4.0],
            },
        },
        "inlets": {"first": {"vessel": "aorta", "end": "first"}},
        "goals": {"bca": {"vessel": "bca", "past_ostium_mm": 20.0}},
    }
    (folder / "tree.json").write_text(json.dumps(tree))
    return folder


def try_anatomy(tally, store, examples):
    path = store / "anatomy" / "anatomy.npz"
    good = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)
    # The header beside the file, where it can be damaged as other JSON is.
    header = store / "anatomy.npz"
    header.write_text(str(arrays["header"]))

    def load():
        return Anatomy.load(path.parent)

    def write(**changed):
        np.savez_compressed(path, allow_pickle=False, **{**arrays, **changed})

    def load_header():
        write(header=np.array(header.read_text()))
        return load()

    def harmless(path, value):
        # A vessel without a parent is a root; what names one is checked.
        return path[-1] == "parent" and (value is None or isinstance(value, str))

    try_json(tally, "anatomy", header, load_header, examples, harmless)
    header.unlink()
    try_bytes(tally, "anatomy", path, load, examples)
    kinds = ["nan", "inf", "huge", "shape", "text", "missing", "empty", "shift"]

    def check(damage):
        name, kind = damage
        values = arrays[name].copy()
        if kind in ("nan", "inf") and values.dtype.kind != "f":
            kind = "text"
        if kind in ("huge", "shift") and values.dtype.kind != "f":
            values = values + 10**6
        elif kind == "huge":
            values = values * 1e6
        elif kind == "shift":
            values = values + 20.0
        changed = {
            "nan": lambda: np.full_like(values, np.nan),
            "inf": lambda: np.full_like(values, np.inf),
            "shape": lambda: values[None],
            "text": lambda: np.full(values.shape, "x"),
            "empty": lambda: values[:0] if values.ndim else values[None],
        }.get(kind, lambda: values)()
        held = {k: v for k, v in arrays.items() if k != name}
        if kind != "missing":
            held[name] = changed
        np.savez_compressed(path, allow_pickle=False, **held)
        tally.refused("anatomy, arrays", load, ["anatomy"], note=damage)

    names = sorted(arrays.keys() - {"header"})
    cases = st.sampled_from([(n, k) for n in names for k in kinds])
    try:
        tally.draw(cases, examples, check)
    finally:
        path.write_bytes(good)


def try_curves_and_trees(tally, store, examples):
    curve = store / "centreline-lcca.mrk.json"

    def harmless(path, value):
        said = ("type", "coordinateUnits", "coordinateSystem", "measurements")
        return not set(said).isdisjoint(map(str, path))

    try_json(tally, "centreline", curve, lambda: read_curve(curve), examples, harmless)
    table = store / "lcca.csv"

    def check(text):
        table.write_text(text)
        tally.refused("centreline table", lambda: read_curve(table), [table.name])

    rows = st.sampled_from(
        ["1,2,3", "x,y,z", "1,2", "nan,1,2", "1;2", "", "a", "inf,0,0"]
    )
    bad = st.lists(rows, max_size=4).filter(lambda some: some.count("1,2,3") < 2)
    tally.draw(bad.map("\n".join), examples, check)
    table.unlink()
    tree = store / "tree.json"

    def optional(path, value):
        left = path[-1] in ("inlets", "goals", "note") and value == "left out"
        none = path == ("goals",) and value is None
        return left or none or (value == {} and path[-1] in ("inlets", "goals"))

    try_json(tally, "tree file", tree, lambda: read_tree(tree), examples, optional)
    try_bytes(
        tally,
        "tree file",
        tree,
        lambda: read_tree(tree),
        examples,
        # A letter of a name or a figure may be another and be fine.
        same=lambda other: True,
    )


EVERYTHING = (
    try_anatomy,
    try_curves_and_trees,
)


@pytest.mark.parametrize("examples", [8, pytest.param(60, marks=pytest.mark.slow)])
def test_damaged_files_are_refused_by_name(store, examples):
    try_all(EVERYTHING, store, examples, 4 * examples)
