"""Damaged recordings, dumps and datasets: refused, by path, nothing is written."""

import json

import numpy as np
import pytest
from bad_values import ERRORS, damaged_json, try_all, try_bytes, try_json
from hypothesis import strategies as st
from recording_samples import make_episode, make_tube

from cathsim_dmc.recording import dataset, viewer
from cathsim_dmc.recording.dataset_reader import read_episodes
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.rerun_log import write_rrd
from cathsim_dmc.tasks import physics_errors
from cathsim_dmc.tasks.snapshot import Snapshot


def write_demonstrations(path):
    """A small dataset of two episodes, as `cathsim demos` writes them."""
    pytest.importorskip("minari")
    from gymnasium import spaces
    from minari.data_collector import EpisodeBuffer

    from cathsim_dmc.simulation.gymnasium import env_spec

    random, buffers = np.random.default_rng(0), []
    for seed, steps in enumerate((4, 6)):
        numbers = random.normal(size=(steps + 1, 3)).astype(np.float32)
        success = np.arange(steps + 1) == steps
        buffers.append(
            EpisodeBuffer(
                seed=seed,
                observations={"position": numbers},
                actions=random.uniform(-1, 1, (steps, 2)).astype(np.float32),
                rewards=random.normal(size=steps).tolist(),
                terminations=success[1:].tolist(),
                truncations=[False] * steps,
                infos={"success": success, "distance": np.ones(steps + 1)},
            )
        )
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
    make_episode().save(folder / "episode.npz")
    write_rrd(make_episode(), make_tube(), folder / "episode.rrd")
    write_demonstrations(folder / "demos-v0")
    start = Snapshot({"goal": "bca"}, {"state": np.ones((1, 9))})
    dump = physics_errors.dump("tried", start, np.ones((3, 2)), folder)
    dump.rename(folder / "dump.npz")
    return folder


def try_archive(tally, entry, path, load, examples):
    """Damages the arrays of an archive one by one, and loads it."""
    good = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)
    kinds = {
        "nan": lambda v: np.full_like(v, np.nan, dtype=np.float64),
        "inf": lambda v: np.full_like(v, np.inf, dtype=np.float64),
        "text": lambda v: np.full(v.shape, "x"),
        "axis": lambda v: v[None],
        "complex": lambda v: np.full(v.shape, 1j),
        "one": lambda v: np.float64(1.0),
    }

    def check(damage):
        name, kind = damage
        held = dict(arrays)
        if kind == "missing":
            del held[name]
        else:
            held[name] = kinds[kind](arrays[name])
        with path.open("wb") as stream:
            np.savez_compressed(stream, **held)
        tally.refused(f"{entry}, arrays", load, [path.name], ERRORS, note=damage)

    damages = [
        (name, kind)
        for name, value in arrays.items()
        for kind in [*kinds, "missing"]
        # Text has none of these.
        if value.dtype.kind != "U" or kind in ("missing", "one")
    ]
    try:
        tally.draw(st.sampled_from(sorted(damages)), examples, check)
    finally:
        path.write_bytes(good)


def try_header(tally, entry, path, name, load, examples, harmless):
    """Damages the JSON that is an array of an archive, and loads it."""
    good = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)

    def check(damaged):
        text, where = damaged
        with path.open("wb") as stream:
            np.savez_compressed(stream, **{**arrays, name: np.array(text)})
        tally.refused(f"{entry}, {name}", load, [path.name], ERRORS, note=where)

    document = json.loads(str(arrays[name][()]))
    try:
        tally.draw(damaged_json(document, harmless), examples, check)
    finally:
        path.write_bytes(good)


def try_episodes(tally, store, examples):
    path, good = store / "episode.npz", Episode.load(store / "episode.npz")
    read = lambda: Episode.load(path)  # noqa: E731
    try_bytes(tally, "episode", path, read, examples, good.equals)
    try_archive(tally, "episode", path, read, examples)

    def harmless(where, value):
        if where == ("seed",):
            return value is None or isinstance(value, int) and value is not True
        return where == ("task",) and isinstance(value, str) and value != "left out"

    try_header(tally, "episode", path, "header", read, examples, harmless)


def try_dumps(tally, store, examples):
    dump = store / "dump.npz"
    first = physics_errors.load(dump)

    def same(other):
        reason, start, actions = other
        return (
            reason == first[0]
            and start.task == first[1].task
            and np.array_equal(start.arrays["state"], first[1].arrays["state"])
            and np.array_equal(actions, first[2])
        )

    read = lambda: physics_errors.load(dump)  # noqa: E731
    try_bytes(tally, "dump of an error", dump, read, examples, same)
    try_archive(tally, "dump of an error", dump, read, examples)

    never = lambda where, value: False  # noqa: E731
    try_header(tally, "dump of an error", dump, "meta", read, examples, never)


def try_rerun_files(tally, store, examples):
    rrd = store / "broken.rrd"
    whole = (store / "episode.rrd").read_bytes()

    def check(data):
        rrd.write_bytes(data)
        tally.refused("rerun file", lambda: viewer.check_recording(rrd), [rrd.name])

    no_rrd = st.binary(max_size=100).filter(lambda data: not data.startswith(b"RRF2"))
    cut = st.integers(1, len(whole) - 1).map(lambda n: whole[:n])
    emptied = st.integers(12, len(whole)).map(lambda n: whole[:-n] + bytes(n))
    tally.draw(no_rrd | cut | emptied, examples, check)
    rrd.unlink()


def try_datasets(tally, store, examples):
    folder = store / "demos-v0" / "data"

    def load():
        return list(read_episodes(folder))

    def harmless(path, value):
        return path[0] not in ("data_format", "jpeg_encoding")

    metadata, arrays = folder / "metadata.json", folder / "main_data.hdf5"
    try_json(tally, "dataset", metadata, load, examples, harmless)
    # HDF5 has no checksums: other numbers are read as what they are.
    try_bytes(tally, "dataset", arrays, load, examples, lambda _: True)


EVERYTHING = (try_episodes, try_dumps, try_rerun_files, try_datasets)


@pytest.mark.parametrize("examples", [8, pytest.param(80, marks=pytest.mark.slow)])
def test_damaged_recordings_are_refused_by_name(store, examples):
    try_all(EVERYTHING, store, examples, 6 * examples)
