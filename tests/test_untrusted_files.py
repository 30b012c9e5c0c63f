"""A pickle in front of every loader that is not of agents: nothing is executed."""

import pytest
from synthetic_scans import write_markup
from test_agents_untrusted_files import bombs
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
    yield folder / "anatomy" / "anatomy.npz", lambda path: Anatomy.load(path.parent)


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
