"""The state of simulations in the middle of their episodes, exact to the bit."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import files
from cathsim_dmc.physics.effects import Effect
from cathsim_dmc.tasks.scene import Scene

_FORMAT = 1
_LARGEST = 2_000_000_000  # bytes, unpacked
_META, _DIGEST = "meta", "sha256"


@dataclasses.dataclass(frozen=True, eq=False)
class Snapshot:
    """State of N simulations of a task, with their random states and image history.

    Attributes:
        task: Description of the task, JSON-able: another task refuses the snapshot.
        arrays: Arrays (N, ...) by name.
    """

    task: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        """N."""
        return len(next(iter(self.arrays.values())))

    def __getitem__(self, rows: Any) -> Snapshot:
        """The snapshot of some simulations, by a slice, numbers or a mask."""
        arrays = {name: array[rows] for name, array in self.arrays.items()}
        return Snapshot(self.task, arrays)

    def part(self, prefix: str) -> dict[str, np.ndarray]:
        """Arrays whose names begin with `prefix.`, by the rest of their names."""
        start = f"{prefix}."
        return {
            name.removeprefix(start): array
            for name, array in self.arrays.items()
            if name.startswith(start)
        }

    def require(self, other: Snapshot) -> None:
        """Raises ValueError unless the snapshot fits simulations that `other` is of."""
        for key, own in other.task.items():
            if self.task.get(key) != own:
                raise ValueError(
                    f"the snapshot is of another task: its {key} is "
                    f"{self.task.get(key)!r}, here it is {own!r}"
                )
        if len(self) != len(other):
            raise ValueError(
                f"the snapshot is of {len(self)} simulations, {len(other)} are to be "
                "restored; choose some with snapshot[...]"
            )
        if odd := sorted(set(self.arrays) ^ set(other.arrays)):
            whose = "it has" if odd[0] in self.arrays else "it lacks"
            raise ValueError(
                f"the snapshot is of a task with other options: {whose} {odd[0]}; make "
                "the task with the same observation, randomisation and effects"
            )
        for name, array in other.arrays.items():
            mine = self.arrays[name]
            if (mine.shape, mine.dtype) != (array.shape, array.dtype):
                raise ValueError(
                    f"the snapshot is of another model: {name} is {mine.dtype} of "
                    f"shape {mine.shape}, here it is {array.dtype} of {array.shape}"
                )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the snapshot, an .npz file without pickles; returns its path."""
        meta = json.dumps({"format": _FORMAT, "task": self.task})
        held = {_META: np.array(meta), **self.arrays}
        buffer = io.BytesIO()
        digest = np.array(_digest(held))
        np.savez_compressed(buffer, allow_pickle=False, **{_DIGEST: digest}, **held)
        return files.write_bytes(path, buffer.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Snapshot:
        """Reads a file that `save` has written.

        Raises:
            ValueError: the file is damaged or something else.
        """
        try:
            held = files.read_arrays(Path(path), _LARGEST)
            if str(held.pop(_DIGEST, "")) != _digest(held):
                raise ValueError("its checksum is wrong")
            meta = json.loads(str(held.pop(_META)))
            if meta["format"] != _FORMAT:
                raise ValueError(f"its format is {meta['format']!r}, not {_FORMAT}")
            if len({array.shape[:1] for array in held.values()}) != 1:
                raise ValueError("its arrays are of different numbers of simulations")
            return cls(dict(meta["task"]), held)
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} is no snapshot: {error}") from error


def _digest(held: Mapping[str, np.ndarray]) -> str:
    total = hashlib.sha256()
    for name, array in sorted(held.items()):
        total.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def describe(scenes: Sequence[Scene], effects: Sequence[Effect]) -> dict[str, Any]:
    """What the task of a snapshot has in common with the one that takes it."""
    first = scenes[0]
    return {
        "goal": first.goal.name,
        "anatomies": [scene.anatomy.name for scene in scenes],
        "starts_mm": [np.round(1e3 * s.placement.start, 2).tolist() for s in scenes],
        "devices": [device.name for device in first.catheter.devices],
        "actions": list(first.catheter.action_names),
        "effects": [type(effect).__name__ for effect in effects],
    }


def named(prefix: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays under names that begin with `prefix.`."""
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def merged(old: Any, new: Any, rows: np.ndarray) -> Any:
    """A named tuple of arrays (N, ...) with `new` in some rows; `old` stays."""
    values = []
    for before, now in zip(old, new, strict=True):
        array = before.copy()
        array[rows] = now
        values.append(array)
    return type(old)._make(values)


# A source of randomness as arrays.

_KEY_LENGTH = 624


def random_arrays(
    random_states: list[np.random.RandomState],
) -> dict[str, np.ndarray]:
    """The states of K sources of randomness, arrays (K, ...)."""
    states = [state.get_state(legacy=False) for state in random_states]
    words = [state["state"]["key"] for state in states]
    rest = [
        (state["state"]["pos"], state["has_gauss"], state["gauss"]) for state in states
    ]
    return {"words": np.array(words), "rest": np.array(rest, dtype=np.float64)}


def set_random(
    random_states: Sequence[np.random.RandomState], arrays: Mapping[str, np.ndarray]
) -> None:
    """Puts K sources of randomness to the states of `random_arrays`."""
    places = arrays["rest"][:, 0]
    if not ((places >= 0) & (places <= _KEY_LENGTH)).all():  # numpy reads there
        raise ValueError(f"the snapshot's sources of randomness stand at {places}")
    for source, words, rest in zip(
        random_states, arrays["words"], arrays["rest"].tolist(), strict=True
    ):
        place, has_gauss, gauss = rest
        source.set_state(("MT19937", words, int(place), int(has_gauss), gauss))
