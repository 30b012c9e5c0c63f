"""Files that would unpack to far more than they hold: refused before they do."""

import gzip
import json
import tracemalloc
import zipfile

import numpy as np
import pytest
from recording_samples import make_episode
from test_bad_files import write_demonstrations

from cathsim_dmc import files
from cathsim_dmc.agents import submission
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.scan.lumen import read_lumen
from cathsim_dmc.anatomy.tree_file import read_tree
from cathsim_dmc.recording.dataset import read_episodes
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.validation import rig

ZEROS = 300_000_000  # bytes, which deflate to 300 kB


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """One good file of every kind that is packed, with the entry to be replaced."""
    folder = tmp_path_factory.mktemp("store")
    rig.tube(0.06, 4e-3).save(folder / "anatomy")
    make_episode().save(folder / "episode.npz")
    header = {
        "policy": "a", "task": "type1_lcca", "task_kwargs": {}, "observation": "route",
    }  # fmt: skip
    np.savez_compressed(
        folder / "actions.npz",
        header=json.dumps(header),
        seeds=np.arange(2),
        actions=np.zeros((2, 3, 21), np.float32),
    )
    return folder


LOADERS = {
    "anatomy/anatomy.npz": ("surface_vertices", lambda p: Anatomy.load(p.parent)),
    "episode.npz": ("qpos", Episode.load),
    "actions.npz": ("actions", submission.RecordedActions),
    "actions.npz again": ("header", submission.RecordedActions),
}


def replaced(path, name, write, packing=zipfile.ZIP_DEFLATED):
    """Replace an entry of an archive by what a function writes into a stream."""
    with zipfile.ZipFile(path) as old:
        entries = {one: old.read(one) for one in old.namelist() if one != f"{name}.npy"}
    with zipfile.ZipFile(path, "w", packing) as new:
        for one, data in entries.items():
            new.writestr(one, data)
        with new.open(f"{name}.npy", "w", force_zip64=True) as stream:
            write(stream)


def header_of(stream, shape):
    described = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, described)


def zeros(stream):
    header_of(stream, (ZEROS // 8,))
    for _ in range(ZEROS // 10**6):
        stream.write(bytes(10**6))


def announced(stream):
    header_of(stream, (10**13,))
    stream.write(bytes(1000))


@pytest.mark.parametrize("name", LOADERS)
@pytest.mark.parametrize(
    ("write", "message"),
    [(zeros, "unpacks to 30. MB"), (announced, r"holds less than its shape")],
)
def test_archives_that_grow_are_refused(store, name, write, message):
    path, (entry, load) = store / name.split()[0], LOADERS[name]
    good = path.read_bytes()
    load(path)
    try:
        replaced(path, entry, write)
        assert path.stat().st_size < 2_000_000
        tracemalloc.start()
        with pytest.raises(ValueError, match=message) as caught:
            load(path)
        assert tracemalloc.get_traced_memory()[1] < 20_000_000  # bytes
    finally:
        tracemalloc.stop()
        path.write_bytes(good)
    assert path.name in str(caught.value) and "\n" not in str(caught.value)


def test_packings_that_numpy_does_not_write_are_refused(store, tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.zeros(3))
    replaced(path, "b", lambda s: header_of(s, (0,)), zipfile.ZIP_LZMA)
    with pytest.raises(ValueError, match="packed in a way"):
        files.read_arrays(path, ["b"])


def test_what_is_large_and_does_not_shrink_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_UNPACKED", 10_000)
    noise = np.random.default_rng(0).normal(size=10_000)
    np.savez_compressed(tmp_path / "a.npz", a=noise)
    np.testing.assert_array_equal(files.read_arrays(tmp_path / "a.npz")["a"], noise)
    np.savez_compressed(tmp_path / "b.npz", a=np.zeros(1_000_000))
    with pytest.raises(ValueError, match="unpacks to 8 MB"):
        files.read_arrays(tmp_path / "b.npz")


DATASETS = {
    "unpacks to": lambda group, h5py: group.create_dataset("actions", (10**10, 2)),
    "link to another place": lambda group, h5py: group.__setitem__(
        "actions", h5py.ExternalLink("/etc/passwd", "/")
    ),
    "in another file": lambda group, h5py: group.create_dataset(
        "actions", (4, 2), "f4", external=[("/dev/zero", 0, 32)]
    ),
}


@pytest.mark.parametrize("message", DATASETS)
def test_datasets_that_grow_or_lead_elsewhere_are_refused(tmp_path, message):
    h5py = pytest.importorskip("h5py")
    write_demonstrations(tmp_path / "demos-v0")
    assert len(list(read_episodes(tmp_path / "demos-v0"))) == 2
    with h5py.File(tmp_path / "demos-v0/data/main_data.hdf5", "r+") as file:
        del file["episode_0/actions"]
        DATASETS[message](file["episode_0"], h5py)
    with pytest.raises(ValueError, match=message):
        list(read_episodes(tmp_path / "demos-v0"))


def nrrd(path, sizes, data, extra=""):
    head = f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: {sizes}\nencoding: gzip\n"
    head += (
        "space: left-posterior-superior\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n"
    )
    path.write_bytes(f"{head}{extra}\n".encode() + gzip.compress(data))


@pytest.mark.parametrize(
    ("sizes", "data", "extra", "message"),
    [
        ("2000 2000 2000", b"", "", "8,000 million voxels"),
        ("4 4 4", bytes(20_000_000), "", "more than the 64 voxels"),
        ("4 4 4", b"", "data file: /dev/zero\n", "in another file"),
    ],
)
def test_label_maps_that_grow_are_refused(tmp_path, sizes, data, extra, message):
    pytest.importorskip("nrrd")
    nrrd(tmp_path / "a.nrrd", sizes, data, extra)
    with pytest.raises(ValueError, match=f"a.nrrd.*{message}"):
        read_lumen(tmp_path / "a.nrrd")


def test_a_packed_nifti_that_grows_is_refused(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(np.zeros((4, 4, 4), np.uint8), np.eye(4))
    header = bytearray(image.to_bytes())
    header[42:48] = np.array([2000, 2000, 2000], "<i2").tobytes()
    (tmp_path / "a.nii.gz").write_bytes(gzip.compress(bytes(header)))
    with pytest.raises(ValueError, match="8,000 million voxels"):
        read_lumen(tmp_path / "a.nii.gz")


@pytest.mark.parametrize(
    "head",
    [
        "ply\nformat ascii 1.0\nelement vertex 90000000\nend_header\n",
        f'<?xml version="1.0"?>{" " * 9000}<Piece NumberOfPoints="900000000" '
        'NumberOfPolys="1">',
    ],
)
def test_meshes_that_announce_too_much_are_refused(tmp_path, head):
    path = tmp_path / ("a.ply" if head.startswith("ply") else "a.vtp")
    path.write_text(head)
    with pytest.raises(ValueError, match="million triangles"):
        read_lumen(path)


def test_an_anatomy_of_the_size_of_a_house_has_no_field(tmp_path):
    from test_bad_files import TREE

    tree = json.loads(json.dumps(TREE))
    bca = tree["vessels"]["bca"]
    bca["points_mm"] = [[0.0, 0, 60], [20, 20, 90], [1800, 1800, 1900]]
    (tmp_path / "a.json").write_text(json.dumps(tree))
    with pytest.raises(ValueError, match=r"box of .* may have 1 m³"):
        assert read_tree(tmp_path / "a.json").build().lumen
