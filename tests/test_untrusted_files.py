"""A pickle in front of every loader that is not of agents: nothing is executed."""

import hashlib
import io
import json

import numpy as np
import pytest
from synthetic_scans import write_markup
from test_agents_untrusted_files import Bomb, bombs
from test_agents_untrusted_files import marker as marker
from test_bad_recordings import store as store

from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.scan.curves import read_curve
from cathsim_dmc.anatomy.scan.mesh import read_triangles
from cathsim_dmc.anatomy.tree_file import read_tree
from cathsim_dmc.recording import Episode, viewer
from cathsim_dmc.recording.dataset_reader import read_episodes
from cathsim_dmc.tasks import physics_errors
from cathsim_dmc.validation import force_sensors

REFUSED = (ValueError, OSError)


def loaders(folder):
    """Each file that is read, and what reads it."""
    yield folder / "episode.npz", Episode.load
    yield folder / "dump.npz", physics_errors.load
    yield folder / "episode.rrd", viewer.check_recording
    for name in ("metadata.json", "main_data.hdf5"):
        data = folder / "demos-v0" / "data"
        yield data / name, lambda path: list(read_episodes(path.parent))
    for kind in ("stl", "ply", "obj", "vtp"):
        yield folder / f"lumen.{kind}", read_triangles
    for name in ("lcca.mrk.json", "lcca.csv", "lcca.vtp"):
        yield folder / name, read_curve
    yield folder / "tree.json", read_tree
    yield folder / "anatomy" / "anatomy.json", lambda path: Anatomy.load(path.parent)


def test_no_loader_executes_a_pickle(store, marker):
    force_sensors.straight_tube(0.06, 4e-3).save(store / "anatomy")
    write_markup(store / "lcca.mrk.json", [[0, 0, z] for z in range(9)])
    for path, load in loaders(store):
        good = path.read_bytes() if path.exists() else None
        for kind, bomb in bombs(marker).items():
            path.write_bytes(bomb)
            with pytest.raises(REFUSED):
                assert load(path) is None, kind
        path.unlink() if good is None else path.write_bytes(good)
    assert not marker.exists()


def packed(arrays):
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, **arrays)
    return buffer.getvalue()


@pytest.mark.parametrize("name", ["episode.npz", "dump.npz", "anatomy"])
def test_no_array_of_an_archive_executes_a_pickle(store, marker, name):
    """Archives that are right but for one array, checksums included."""
    bomb = np.array([Bomb(marker)], dtype=object)
    load = {"episode.npz": Episode.load, "dump.npz": physics_errors.load}.get(name)
    path = store / name
    if name == "anatomy":
        force_sensors.straight_tube(0.06, 4e-3).save(store / "anatomy")
        (path,) = (store / "anatomy").glob("geometry-*.npz")

        def load(path):
            described = path.parent / "anatomy.json"
            values = json.loads(described.read_text())
            values["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
            described.write_text(json.dumps(values))
            return Anatomy.load(path.parent)

    good = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)
    load(path)
    for entry in arrays:
        path.write_bytes(packed({**arrays, entry: bomb}))
        with pytest.raises(REFUSED, match="allow_pickle=False"):
            load(path)
    path.write_bytes(good)
    load(path)
    assert not marker.exists()


def test_no_entry_of_a_dataset_executes_a_pickle(store, marker):
    h5py = pytest.importorskip("h5py")
    path = store / "demos-v0" / "data" / "main_data.hdf5"
    good = path.read_bytes()
    plain = bombs(marker)["plain"]
    for name in ("actions", "observations/position", "infos/success"):
        with h5py.File(path, "r+") as file:
            episode = file["episode_0"]
            del episode[name]
            episode[name] = np.void(plain)
            episode.attrs["seed"] = np.void(plain)
        with pytest.raises(REFUSED):
            list(read_episodes(path.parent))
        path.write_bytes(good)
    assert not marker.exists()
