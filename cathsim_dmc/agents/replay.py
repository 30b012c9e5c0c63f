"""A ring buffer of transitions in memory-mapped .npy files."""

import hashlib
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from numpy.lib.format import open_memmap
from tensordict import TensorDict, TensorDictBase

from cathsim_dmc import files

_DIGEST = "first.sha256"  # file with the digest of the first transitions, see `load`


class ReplayError(ValueError):
    """The files of a replay are missing, damaged or not those of the run."""


class ReplayMemory:
    """Replay buffer of the newest transitions, on disk, sampled uniformly.

    Transitions are written into memory-mapped files, one .npy for each key, so a
    checkpoint stores only the fill level of the ring. Transitions that a killed process
    wrote after its last checkpoint lie where the resumed run writes next, or replace
    the oldest ones; they are valid too. Reading the files executes nothing.

    Args:
        directory: Folder of the files; made on the first `extend`.
        keys: Entries of a transition, nested ones as tuples.
        capacity: Largest number of transitions.
        max_bytes: Largest size of all files together; lowers the capacity if need be.
        expected: Largest number of transitions of the run; disk space is reserved for
            no more.
    """

    def __init__(
        self,
        directory: Path,
        keys: Sequence[Any],
        capacity: int,
        max_bytes: int,
        expected: int,
    ):
        self.directory, self.capacity, self.expected = directory, capacity, expected
        self.max_bytes, self.cursor, self.size = max_bytes, 0, 0
        names = {key: key if isinstance(key, str) else ".".join(key) for key in keys}
        self._paths = {key: self.directory / f"{n}.npy" for key, n in names.items()}
        self._storage: TensorDictBase | None = None
        self._digest: str | None = None

    @classmethod
    def of(cls, config: Any, directory: Path, keys: Sequence[Any]) -> "ReplayMemory":
        """Memory of a run in its directory, with the limits of its settings."""
        most, size = config.replay_frames, config.replay_bytes
        expected = config.total_frames + config.frames_per_batch
        return cls(directory / "replay", keys, most, size, expected)

    def __len__(self) -> int:
        """Number of transitions that can be sampled."""
        return self.size

    def extend(self, transitions: TensorDictBase) -> None:
        """Append transitions (n,), which overwrite the oldest if the ring is full."""
        storage = self._storage
        if storage is None:
            each = transitions[:1].bytes()
            self.capacity = min(self.capacity, max(1, self.max_bytes // each))
            storage = self._storage = self._create(transitions)
        count = len(transitions)
        if count > self.capacity:
            raise ValueError(
                f"{count} transitions do not fit into a replay of {self.capacity}: "
                f"raise replay_bytes or replay_frames."
            )
        index = (self.cursor + torch.arange(count)) % self.capacity
        storage[index] = transitions
        self.cursor = (self.cursor + count) % self.capacity
        self.size = min(self.size + count, self.capacity)

    def sample(self, count: int) -> TensorDictBase:
        """Draw transitions (count,) with replacement, from torch's generator."""
        assert self._storage is not None
        return self._storage[torch.randint(self.size, (count,))]

    def state(self) -> dict[str, Any]:
        """Return cursor, size, capacity and digest, which identifies the files."""
        own = {"cursor": self.cursor, "size": self.size, "capacity": self.capacity}
        return {**own, "digest": self._digest}

    def load(self, state: Mapping[str, Any]) -> None:
        """Open the files of an earlier process; ReplayError if missing or damaged."""
        size, cursor, capacity = state["size"], state["cursor"], state["capacity"]
        if size == 0:
            return
        storage, digest = TensorDict({}, [capacity]), self.directory / _DIGEST
        self._digest = state.get("digest")  # which a checkpoint may lack
        for key, path in self._paths.items():
            text = (
                f"the replay of {size:,} transitions is lost: {path} is missing, "
                "damaged or of another checkpoint. Resume without it "
                "(without_replay=True, --resume --without-replay): the run keeps its "
                "networks and collects new transitions. What was found"
            )
            wrong = OSError, ValueError, TypeError, RuntimeError, EOFError
            with files.refused(ReplayError, text, wrong):
                # "r+" would extend a file that is too short.
                open_memmap(path, mode="r")
                storage[key] = torch.from_numpy(open_memmap(path, mode="r+"))
                # A process that started without this replay has replaced the files.
                if self._digest and self._digest != files.read_text(digest):
                    raise ValueError("they are those of another process")
        self._storage, self.capacity = storage, capacity
        self.cursor, self.size = cursor, size
        self._reserve(storage)

    def _create(self, like: TensorDictBase) -> TensorDictBase:
        """Create files for `capacity` transitions, with disk space for `expected`."""
        needed = min(self.capacity, self.expected) * like[:1].bytes()
        shutil.rmtree(self.directory, ignore_errors=True)
        self.directory.mkdir(parents=True)
        free = shutil.disk_usage(self.directory).free
        if needed > free:
            raise OSError(
                f"the replay needs {needed / 1e9:.1f} GB in {self.directory}, "
                f"{free / 1e9:.1f} GB are free: lower replay_bytes."
            )
        storage, digest = TensorDict({}, [self.capacity]), hashlib.sha256()
        for key, path in self._paths.items():
            example = like[key]
            digest.update(example.cpu().numpy().tobytes())
            shape = (self.capacity, *example.shape[1:])
            dtype = example[:0].cpu().numpy().dtype
            with files.naming(path):
                array = open_memmap(path, mode="w+", dtype=dtype, shape=shape)
            storage[key] = torch.from_numpy(array)
        self._reserve(storage)
        self._digest = digest.hexdigest()
        files.write_text(self.directory / _DIGEST, self._digest)
        return storage

    def _reserve(self, storage: TensorDictBase) -> None:
        """Reserve the disk space of `expected` transitions; the rest stays a hole."""
        if not hasattr(os, "posix_fallocate"):
            return
        beyond = max(0, self.capacity - self.expected)
        for key, path in self._paths.items():
            rows = storage[key][:beyond]
            size = path.stat().st_size - rows.numel() * rows.element_size()
            with files.naming(path), open(path, "rb+") as stream:
                os.posix_fallocate(stream.fileno(), 0, size)
