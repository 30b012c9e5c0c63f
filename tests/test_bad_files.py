"""Damaged files at every loader: refused, by path, and nothing is written."""

import hashlib
import io
import json
import shutil

import numpy as np
import pytest
import synthetic_env
import torch
from bad_values import ERRORS, try_all, try_bytes, try_json
from hypothesis import strategies as st
from synthetic_scans import write_markup
from test_agents_training import run, small_ppo

from cathsim_dmc.agents import Checkpoint
from cathsim_dmc.agents.checkpoint import checkpoints_in
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.scan.curves import read_curve
from cathsim_dmc.anatomy.tree_file import read_tree
from cathsim_dmc.validation import force_sensors


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """One good file or folder of every kind."""
    folder = tmp_path_factory.mktemp("store")
    force_sensors.straight_tube(0.06, 4e-3).save(folder / "anatomy")
    run(small_ppo(total_frames=512), folder / "ppo")
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


def reseal(folder):
    """Makes the checksum of a checkpoint fit its edited files."""
    path = folder / "checkpoint.json"
    values = json.loads(path.read_text())
    for name in values["sha256"]:
        digest = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        values["sha256"][name] = digest
    path.write_text(json.dumps(values))


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


def try_checkpoint(tally, store, examples):
    path = checkpoints_in(store / "ppo")[-1]

    def harmless(where, value):
        # For people, and where the settings have more than one kind.
        free = ("versions", "num_threads", "target_kl", "task_kwargs")
        as_number = isinstance(value, int | float) and not isinstance(value, bool)
        fits = as_number and np.isfinite(value)
        return (
            not {"versions", "task_kwargs"}.isdisjoint(map(str, where))
            or where[-1] in free
            or (where[-1] == "observation" and isinstance(value, list) and value)
            or (fits and where[-1] in ("value_coefficient", "observation_clip"))
            or (fits and value > 0)
            or (value == "left out" and "config" in where and len(where) > 1)
        )

    def load():
        return Checkpoint.open(path).policy()

    try_json(tally, "checkpoint", path / "checkpoint.json", load, examples, harmless)
    for name in ("policy.pt", "learning.pt"):
        read = load if name == "policy.pt" else Checkpoint.open(path).learning_state
        try_bytes(tally, f"checkpoint {name}", path / name, read, examples)
    good = (path / "policy.pt").read_bytes(), (path / "checkpoint.json").read_text()
    state = torch.load(io.BytesIO(good[0]), weights_only=True)
    changes = {
        "shape": lambda v: v.new_zeros(3, *v.shape),
        "text": lambda v: "x",
        "none": lambda v: None,
        "number": lambda v: 1.5,
    }

    def check(damage):
        key, kind = damage
        changed = dict(state)
        if kind == "left out":
            del changed[key]
        elif kind == "added":
            changed[f"{key}.x"] = torch.zeros(3)
        else:
            changed[key] = changes[kind](state[key])
        torch.save(changed, path / "policy.pt")
        reseal(path)
        tally.refused("checkpoint, weights", load, ["policy.pt"], ERRORS, note=damage)

    kinds = st.sampled_from([*changes, "left out", "added"])
    keys = st.sampled_from([k for k, v in state.items() if isinstance(v, torch.Tensor)])
    try:
        tally.draw(st.tuples(keys, kinds), examples, check)
    finally:
        (path / "policy.pt").write_bytes(good[0])
        (path / "checkpoint.json").write_text(good[1])


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
    try_checkpoint,
    try_curves_and_trees,
)


@pytest.mark.parametrize("examples", [8, pytest.param(60, marks=pytest.mark.slow)])
def test_damaged_files_are_refused_by_name(store, examples):
    try_all(EVERYTHING, store, examples, 7 * examples)


def test_a_run_with_damaged_settings_can_still_be_evaluated(store, tmp_path):
    """The checkpoint holds its own settings: config.json is for people."""
    shutil.copytree(store / "ppo", tmp_path / "run")
    (tmp_path / "run" / "config.json").write_text("{")
    Checkpoint.open(tmp_path / "run").policy()
    assert synthetic_env.ACTIONS == Checkpoint.open(tmp_path / "run").shapes.actions
