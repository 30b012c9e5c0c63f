"""A ring buffer of transitions in memory-mapped .npy files."""

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from numpy.lib.format import open_memmap
from tensordict import TensorDict, TensorDictBase

from cathsim_dmc import files

# Key of an entry of a transition, nested ones as tuples.
Key = str | tuple[str, ...]


class ReplayError(ValueError):
    """The files of a replay are missing, damaged or not the ones asked for."""


class ReplayMemory:
    """The newest transitions, on disk, sampled uniformly.

    Transitions are written straight into memory-mapped files, so a checkpoint only
    has to note how far the ring was filled: nothing is copied, whatever its size.
    What a killed process wrote after its last checkpoint lies where the resumed run
    writes next, or replaces the oldest transitions by newer genuine ones.

    Each entry of a transition is one .npy file named by its key. Reading one executes
    nothing.

    Args:
        directory: Folder of the files; made on the first `extend`.
        keys: Keys of the entries of a transition.
        capacity: Largest number of transitions kept.
        max_bytes: Largest size of all files together in bytes; lowers the capacity if
            need be.
    """

    def __init__(
        self, directory: Path, keys: Sequence[Key], capacity: int, max_bytes: int
    ):
        self.directory = Path(directory)
        self.capacity = capacity
        self.max_bytes = max_bytes
        self.cursor = 0
        self.size = 0
        names = {key: key if isinstance(key, str) else ".".join(key) for key in keys}
        self._paths = {key: self.directory / f"{n}.npy" for key, n in names.items()}
        self._storage: TensorDictBase | None = None

    def __len__(self) -> int:
        """Number of transitions that can be sampled."""
        return self.size

    def extend(self, transitions: TensorDictBase) -> None:
        """Append transitions (n,), over the oldest ones when the ring is full."""
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
        """How far the ring is filled, and what a transition is made of.

        Files that were removed while the process runs are written again.
        """
        held = self._storage
        if held is None:
            return {"cursor": 0, "size": 0, "capacity": self.capacity}
        if not all(path.exists() for path in self._paths.values()):
            self._storage = self._create(held).copy_(held)
        entries = {path.name: _kind(held[key]) for key, path in self._paths.items()}
        return {
            "cursor": self.cursor,
            "size": self.size,
            "capacity": self.capacity,
            "entries": entries,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Open the files of an earlier process at the state it had noted.

        Args:
            state: What `state` gave when the checkpoint was written.

        Raises:
            ReplayError: the files are missing, damaged, or not the ones that were
                noted.
        """
        noted = [state.get(name) for name in ("size", "cursor", "capacity")]
        whole = [number for number in noted if type(number) is int]
        if len(whole) < 3 or not (0 <= whole[0] <= whole[2] > whole[1] >= 0):
            raise ReplayError(
                f"the checkpoint notes a replay of {noted[0]!r} transitions, the next "
                f"at {noted[1]!r}, of {noted[2]!r}; it is damaged."
            )
        size, cursor, capacity = whole
        if size == 0:
            return
        storage = TensorDict({}, [capacity])
        for key, path in self._paths.items():
            try:
                # "r+" would extend a file that is too short.
                open_memmap(path, mode="r")
                tensor = torch.from_numpy(open_memmap(path, mode="r+"))
                if len(tensor) != capacity:
                    raise ValueError(f"{len(tensor)} transitions, not {capacity}")
                if _kind(tensor) != state["entries"][path.name]:
                    raise ValueError(f"its transitions are {_kind(tensor)}")
            except (OSError, ValueError, TypeError, KeyError, EOFError) as error:
                line = " ".join(str(error).split())[:200]
                raise ReplayError(
                    f"the replay of {size:,} transitions is lost: {path} is missing, "
                    f"damaged or of another checkpoint ({line}). Resume without it "
                    "(without_replay=True, --without-replay): the run keeps its "
                    "networks and collects new transitions."
                ) from error
            storage[key] = tensor
        self._storage, self.capacity = storage, capacity
        self.cursor, self.size = cursor, size

    def _create(self, like: TensorDictBase) -> TensorDictBase:
        """Files for `capacity` transitions, which take their room on the disk now.

        A memory-mapped write that finds the disk full would kill the process.
        """
        needed = self.capacity * like[:1].bytes()
        shutil.rmtree(self.directory, ignore_errors=True)
        self.directory.mkdir(parents=True)
        free = shutil.disk_usage(self.directory).free
        if needed > free:
            raise OSError(
                f"the replay needs {needed / 1e9:.1f} GB in {self.directory}, "
                f"{free / 1e9:.1f} GB are free: lower replay_bytes."
            )
        storage = TensorDict({}, [self.capacity])
        for key, path in self._paths.items():
            example = like[key]
            shape = (self.capacity, *example.shape[1:])
            dtype = example[:0].cpu().numpy().dtype
            with files.naming(path):
                array = open_memmap(path, mode="w+", dtype=dtype, shape=shape)
                if hasattr(os, "posix_fallocate"):
                    with open(path, "rb+") as stream:
                        os.posix_fallocate(stream.fileno(), 0, path.stat().st_size)
            storage[key] = torch.from_numpy(array)
        return storage


def _kind(tensor: torch.Tensor) -> str:
    """Dtype and shape of an entry of one transition."""
    return f"{tensor.dtype} {tuple(tensor.shape[1:])}"
