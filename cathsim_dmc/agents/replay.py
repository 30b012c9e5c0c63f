"""A ring of transitions in memory-mapped files that outlives the process."""

import json
import math
import os
import re
import shutil
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from cathsim_dmc import files

FORMAT = "cathsim-replay"
VERSION = 1
_DESCRIPTION = "replay.json"
# A description names an array of so many dimensions and entries at most.
_MAX_DIMENSIONS = 8
_MAX_BYTES = 2**50
_MAX_DESCRIPTION = 2**20  # bytes

_DTYPES = {
    "bool": torch.bool,
    "uint8": torch.uint8,
    "int64": torch.int64,
    "float32": torch.float32,
    "float64": torch.float64,
}
_NAMES = {dtype: name for name, dtype in _DTYPES.items()}
_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*")


# Key, with dots between the names of nested ones -> dtype and shape.
Entries = dict[str, tuple[torch.dtype, tuple[int, ...]]]


class ReplayError(ValueError):
    """The files of a replay are missing, damaged or not the ones asked for."""


class ReplayMemory:
    """The newest transitions, on disk, sampled uniformly.

    Transitions are written straight into memory-mapped files, so a checkpoint only
    has to note how far the ring was filled: nothing is copied, whatever its size.
    What a killed process wrote after its last checkpoint lies where the resumed run
    writes next, or replaces the oldest transitions by newer genuine ones.

    Each entry of a transition is one file of raw numbers, named by its key, and
    replay.json declares dtype and shape of each. Reading it back executes nothing.

    Args:
        directory: Folder of the files; made on the first `extend`.
        capacity: Largest number of transitions kept.
        max_bytes: Largest size of all files together in bytes; lowers the capacity if
            need be.
    """

    def __init__(self, directory: Path, capacity: int, max_bytes: int):
        self.directory = Path(directory)
        self.capacity = capacity
        self.max_bytes = max_bytes
        self.cursor = 0
        self.size = 0
        self._storage: TensorDictBase = TensorDict({}, [0])
        self._entries: Entries = {}

    def __len__(self) -> int:
        """Number of transitions that can be sampled."""
        return self.size

    def extend(self, transitions: TensorDictBase) -> None:
        """Append transitions (n,), over the oldest ones when the ring is full."""
        if not self._entries:
            self._allocate(transitions)
        count = len(transitions)
        if count > self.capacity:
            raise ValueError(
                f"{count} transitions do not fit into a replay of {self.capacity}: "
                f"raise replay_bytes or replay_frames."
            )
        index = (self.cursor + torch.arange(count)) % self.capacity
        self._storage[index] = transitions
        self.cursor = (self.cursor + count) % self.capacity
        self.size = min(self.size + count, self.capacity)

    def sample(self, count: int) -> TensorDictBase:
        """Draw transitions (count,) with replacement, from torch's generator."""
        return self._storage[torch.randint(self.size, (count,))]

    def state(self) -> dict[str, Any]:
        """How far the ring is filled, and what a transition is made of."""
        return {
            "cursor": self.cursor,
            "size": self.size,
            "capacity": self.capacity,
            "entries": _described(self._entries),
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Open the files of an earlier process at the state it had noted.

        Args:
            state: What `state` gave when the checkpoint was written.

        Raises:
            ReplayError: the files are missing, not as declared, or not the ones that
                were noted.
        """
        size, cursor, capacity = (
            _whole(state.get(name), f"the checkpoint's replay {name}", least)
            for name, least in (("size", 0), ("cursor", 0), ("capacity", 1))
        )
        if size > capacity or cursor >= capacity:
            raise ReplayError(
                f"the checkpoint notes a replay of {size} transitions, the next at "
                f"{cursor}, of {capacity}; it is damaged."
            )
        if size == 0:
            return
        path = self.directory / _DESCRIPTION
        held, entries = _read_description(path)
        if held != capacity:
            raise ReplayError(
                f"the replay in {self.directory} holds {held} transitions, the "
                f"checkpoint says {capacity}."
            )
        if _described(entries) != state.get("entries"):
            raise ReplayError(
                f"replay.json in {self.directory} tells of other transitions than the "
                f"checkpoint: {_described(entries)}, not {state.get('entries')}."
            )
        self._open(entries, capacity)
        self.cursor, self.size = cursor, size

    def _allocate(self, transitions: TensorDictBase) -> None:
        each = transitions[:1].bytes()
        self.capacity = min(self.capacity, max(1, self.max_bytes // each))
        shutil.rmtree(self.directory, ignore_errors=True)
        self.directory.mkdir(parents=True)
        free = shutil.disk_usage(self.directory).free
        if self.capacity * each > free:
            raise OSError(
                f"the replay needs {self.capacity * each / 1e9:.1f} GB in "
                f"{self.directory}, {free / 1e9:.1f} GB are free: lower replay_bytes."
            )
        entries = {
            ".".join(key if isinstance(key, tuple) else (key,)): (
                value.dtype,
                tuple(value.shape[1:]),
            )
            for key, value in transitions.items(True, True)
        }
        for key, (dtype, shape) in entries.items():
            size = self.capacity * _bytes(dtype, shape)
            _reserve(self.directory / f"{key}.raw", size)
        description = {
            "format": FORMAT,
            "version": VERSION,
            "capacity": self.capacity,
            "entries": _described(entries),
        }
        # Last: with a description the files are complete.
        files.write_text(
            self.directory / _DESCRIPTION, json.dumps(description, indent=2) + "\n"
        )
        self._open(entries, self.capacity)

    def _open(self, entries: Entries, capacity: int) -> None:
        storage = TensorDict({}, [capacity])
        for key, (dtype, shape) in entries.items():
            tensor = _map(self.directory / f"{key}.raw", (capacity, *shape), dtype)
            storage[tuple(key.split("."))] = tensor
        self._storage, self._entries, self.capacity = storage, entries, capacity


def _described(entries: Entries) -> dict[str, Any]:
    """Dtype and shape of every entry as JSON-able values."""
    return {
        key: {"dtype": _NAMES[dtype], "shape": list(shape)}
        for key, (dtype, shape) in entries.items()
    }


def _read_description(path: Path) -> tuple[int, Entries]:
    """Capacity, and dtype and shape of every entry, of a replay.json."""
    if not path.is_file():
        raise ReplayError(
            f"the replay files in {path.parent} are missing ({path.name} is not "
            "there); this run cannot be resumed. Its policy can still be evaluated."
        )
    if path.stat().st_size > _MAX_DESCRIPTION:
        raise ReplayError(f"{path} is too long for a description of a replay.")
    try:
        values = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise ReplayError(f"{path} is no JSON: {error}") from error
    if not isinstance(values, dict) or (
        (values.get("format"), values.get("version")) != (FORMAT, VERSION)
    ):
        raise ReplayError(f"{path} is no {FORMAT} description of version {VERSION}.")
    capacity = _whole(values.get("capacity"), f"{path}: capacity", 1)
    described = values.get("entries")
    if not isinstance(described, dict) or not described:
        raise ReplayError(f"{path}: entries is {described!r}; it must be an object.")
    entries = {}
    for key, entry in described.items():
        # The key names the file: no separators, so it cannot lead out of the folder.
        if not _KEY.fullmatch(key):
            raise ReplayError(f"{path}: {key!r} is no name of an entry.")
        if not isinstance(entry, dict) or entry.get("dtype") not in list(_DTYPES):
            raise ReplayError(
                f"{path}: {key} is {entry!r}; it must have a dtype out of "
                f"{', '.join(_DTYPES)} and a shape."
            )
        shape = entry.get("shape")
        if not isinstance(shape, list) or len(shape) > _MAX_DIMENSIONS:
            raise ReplayError(
                f"{path}: the shape of {key} is {shape!r}; it must be a list of at "
                f"most {_MAX_DIMENSIONS} positive integers."
            )
        shape = tuple(_whole(n, f"{path}: a size in shape of {key}", 1) for n in shape)
        entries[key] = (_DTYPES[entry["dtype"]], shape)
    nested = [key for key in entries if any(k.startswith(f"{key}.") for k in entries)]
    if nested:
        raise ReplayError(f"{path}: {nested} are both an entry and a group of them.")
    return capacity, entries


def _whole(value: object, name: str, least: int) -> int:
    if type(value) is not int or not least <= value <= _MAX_BYTES:
        raise ReplayError(f"{name} is {value!r}; it must be an integer >= {least}.")
    return value


def _bytes(dtype: torch.dtype, shape: tuple[int, ...]) -> int:
    return dtype.itemsize * math.prod(shape)


def _reserve(path: Path, size: int) -> None:
    """Make a file of zeros whose room on the disk is taken now, not when written.

    A memory-mapped write that finds the disk full would kill the process.
    """
    with open(path, "xb") as stream:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(stream.fileno(), 0, size)
        else:
            stream.truncate(size)


def _map(path: Path, shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
    """Map a file of raw numbers into memory; it must be of exactly that size."""
    size = _bytes(dtype, shape)
    try:
        # Not through a link, which could lead anywhere.
        descriptor = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
    except OSError as error:
        raise ReplayError(f"{path} cannot be opened: {error.strerror}.") from error
    with open(descriptor, "rb+") as stream:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or status.st_size != size:
            raise ReplayError(
                f"{path} has {status.st_size} bytes where {_DESCRIPTION} declares "
                f"{size}; the replay is damaged."
            )
        name = np.dtype(_NAMES[dtype])
        return torch.from_numpy(np.memmap(stream, name, "r+", shape=shape))
