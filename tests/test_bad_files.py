"""Damaged files at every loader: refused by path in one line, nothing is written."""

import copy
import json

import numpy as np
import pytest
from bad_values import Tally
from recording_samples import make_episode, make_tube
from synthetic_scans import write_markup

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.scan.curves import read_curve
from cathsim_dmc.anatomy.tree_file import read_tree
from cathsim_dmc.recording import dataset, viewer
from cathsim_dmc.recording.dataset import read_episodes
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.rerun_log import write_rrd
from cathsim_dmc.validation import rig

ERRORS = (ValueError, OSError, RuntimeError)  # of readers of files
TREE = {
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


def write_demonstrations(path):
    """A small dataset of two episodes, as `cathsim demos` writes them."""
    pytest.importorskip("minari")
    from gymnasium import spaces
    from minari.data_collector import EpisodeBuffer

    from cathsim_dmc.simulation.gymnasium import env_spec

    buffers = [
        EpisodeBuffer(
            seed=seed,
            observations={"position": np.ones((steps + 1, 3), np.float32)},
            actions=np.zeros((steps, 2), np.float32),
            rewards=[-0.1] * steps,
            terminations=[False] * (steps - 1) + [True],
            truncations=[False] * steps,
            infos={"success": np.arange(steps + 1) == steps},
        )
        for seed, steps in enumerate((4, 6))
    ]
    dataset.write(
        path,
        buffers,
        env_spec=env_spec("type1_bca"),
        observation_space=spaces.Dict(
            {"position": spaces.Box(-np.inf, np.inf, (3,), np.float32)}
        ),
        action_space=spaces.Box(-1, 1, (2,), np.float32),
        algorithm="tests",
        description="made up",
    )


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """One good file or folder of every kind."""
    folder = tmp_path_factory.mktemp("store")
    rig.tube(0.06, 4e-3).save(folder / "anatomy")
    make_episode().save(folder / "episode.npz")
    write_rrd(make_episode(), make_tube(), folder / "episode.rrd")
    write_demonstrations(folder / "demos-v0")
    points = [[0, 0, z] for z in range(0, 50, 5)]
    write_markup(folder / "lcca.mrk.json", points, radii=[4.0] * 10)
    (folder / "lcca.csv").write_text("0,0,0\n0,0,1\n0,0,2\n")
    (folder / "tree.json").write_text(json.dumps(TREE))
    return folder


# What loads each file, and entries of its JSON of which any value is right.
LOADERS = {
    "anatomy/anatomy.npz": (lambda path: Anatomy.load(path.parent), ()),
    "episode.npz": (Episode.load, ()),
    "episode.rrd": (viewer.check_recording, ()),
    "demos-v0/data/metadata.json": (
        lambda path: list(read_episodes(path.parent)),
        None,
    ),
    "demos-v0/data/main_data.hdf5": (lambda path: list(read_episodes(path.parent)), ()),
    "lcca.mrk.json": (
        read_curve,
        ("type", "coordinateUnits", "coordinateSystem", "measurements"),
    ),
    "lcca.csv": (read_curve, ()),
    "tree.json": (read_tree, ("note",)),
}


def entries(document, path=()):
    """Paths of all entries of a JSON document; of a list the first and the last."""
    items = document.items() if isinstance(document, dict) else ()
    if isinstance(document, list) and document:
        items = {0: document[0], len(document) - 1: document[-1]}.items()
    for key, value in items:
        yield (*path, key)
        yield from entries(value, (*path, key))


def damaged_json(text, free):
    """A JSON document with one entry of another kind, and where."""
    document = json.loads(text)
    for path in entries(document):
        if free is None or set(free) & set(map(str, path)):
            continue
        changed = inner = copy.deepcopy(document)
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = 7 if isinstance(inner[path[-1]], dict) else {"a": 1}
        yield str(path), json.dumps(changed)


def damages(path, free):
    """What becomes of a file, with a note."""
    data = path.read_bytes()
    half = len(data) // 2
    yield "empty", b""
    yield "text", b"not what it seems\n"
    yield "noise", np.random.default_rng(0).bytes(200)
    if path.suffix == ".csv":
        return
    yield "half", data[:half]
    if path.suffix != ".hdf5":  # which has no checksums
        yield "end", data[:-2]
        yield "zeros", data[:half] + bytes(len(data) - half)
    if path.suffix == ".json":
        for where, text in damaged_json(data, free):
            yield where, text.encode()


@pytest.mark.parametrize("name", LOADERS)
def test_damaged_files_are_refused_by_name(store, name):
    path, (load, free) = store / name, LOADERS[name]
    good, tally, before = path.read_bytes(), Tally(), sorted(store.rglob("*"))
    load(path)
    words = [name.partition("/")[0]]
    try:
        for note, data in damages(path, free):
            path.write_bytes(data)
            tally.refused(name, lambda: load(path), words, ERRORS, note)
    finally:
        path.write_bytes(good)
    load(path)
    print(tally.report())
    assert sorted(store.rglob("*")) == before, "something was written"
    assert not tally.wrong, "\n".join(tally.wrong)
