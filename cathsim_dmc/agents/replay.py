"""A ring of transitions in memory-mapped files that outlives the process."""

import shutil
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase


class ReplayMemory:
    """The newest transitions, on disk, sampled uniformly.

    Transitions are written straight into memory-mapped files, so a checkpoint only
    has to note how far the ring was filled: nothing is copied, whatever its size.
    What a killed process wrote after its last checkpoint lies where the resumed run
    writes next, or replaces the oldest transitions by newer genuine ones.

    Args:
        directory: where the files lie; made on the first `extend`.
        capacity: most transitions kept.
        max_bytes: most bytes of all files; lowers the capacity if need be.
    """

    def __init__(self, directory: Path, capacity: int, max_bytes: int):
        self.directory = Path(directory)
        self.capacity = capacity
        self.max_bytes = max_bytes
        self.cursor = 0
        self.size = 0
        self._storage: TensorDictBase | None = None

    def __len__(self) -> int:
        """Number of transitions that can be sampled."""
        return self.size

    def extend(self, transitions: TensorDictBase) -> None:
        """Append transitions (n,), over the oldest ones when the ring is full."""
        if self._storage is None:
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

    def state(self) -> dict[str, int]:
        """How far the ring is filled."""
        return {"cursor": self.cursor, "size": self.size, "capacity": self.capacity}

    def load(self, state: dict[str, Any]) -> None:
        """Open the files of an earlier process at the state it had noted.

        Raises:
            FileNotFoundError: the files are gone.
            ValueError: they are not the ones that were noted.
        """
        if state["size"] == 0:
            return
        if not (self.directory / "meta.json").exists():
            raise FileNotFoundError(
                f"the replay files in {self.directory} are missing; this run cannot "
                f"be resumed. Its policy can still be evaluated."
            )
        storage = TensorDict.load_memmap(self.directory)
        if len(storage) != state["capacity"]:
            raise ValueError(
                f"the replay in {self.directory} holds {len(storage)} transitions, "
                f"the checkpoint says {state['capacity']}."
            )
        self._storage = storage
        self.capacity = state["capacity"]
        self.cursor = state["cursor"]
        self.size = state["size"]

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
        template = transitions[0].expand(self.capacity)
        self._storage = template.memmap_like(self.directory)
