"""State of simulations between two control steps, exact to the bit, and its file.

`mujoco.mj_getState` is not enough, because effects, image sensors and `Rollout` keep
state in Python. Every object that does so declares the names of those attributes in
`state`; `packed` and `restored` convert their values to arrays (K, ...) and back.
"""

import dataclasses
import hashlib
import io
import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc import __version__, bounds, files

Arrays = Mapping[str, np.ndarray]
_FORMAT = 1
_META, _DIGEST = "meta", "sha256"
# Suffix of the names of arrays whose second axis differs between episodes; they are
# padded with NaN.
_RAGGED = "*"
_TEXT = "<U64"
_WORDS = 624  # of a RandomState
_KINDS = "fiubU"


class NotCopied:
    """Base class of simulations: pickling and copying raise TypeError."""

    def __reduce_ex__(self, protocol):
        raise TypeError(
            f"{type(self).__name__} cannot be pickled or copied; make one where it is "
            "needed, by a function that another process is given, and put it to this "
            "state by restore(snapshot()): a snapshot can be pickled"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Snapshot:
    """State of K simulations of a task, random states and images included.

    Attributes:
        task: What a task must share to restore it, JSON-able; see
            `restorable.describe`.
        arrays: Arrays (K, ...) by name.
        versions: Versions of the packages that took it; others may round differently.
    """

    task: Mapping[str, Any]
    arrays: Arrays
    versions: Mapping[str, str] = dataclasses.field(default_factory=lambda: versions())

    def __repr__(self) -> str:
        """Number of simulations, control steps done, goal, devices and anatomies."""
        steps = np.ravel(self.arrays.get("rollout.steps", ())).tolist()
        told = {name: self.task.get(name) for name in ("goal", "devices")}
        told["anatomies"] = [*self.task.get("anatomies", ())]
        text = ", ".join(f"{name} {bounds.shown(one)}" for name, one in told.items())
        done = f"after {bounds.shown(steps)} control steps"
        plural = "s" if len(self) > 1 else ""
        return f"<Snapshot of {len(self)} simulation{plural} {done}, {text}>"

    @property
    def digest(self) -> str:
        """SHA-256 of its task and its arrays, in hexadecimal digits."""
        task = np.array(json.dumps(self.task, sort_keys=True))
        return _digest({_META: task, **self.arrays})

    def __len__(self) -> int:
        """Number K of simulations."""
        return len(next(iter(self.arrays.values())))

    def __getitem__(self, rows: Any) -> "Snapshot":
        """The snapshot of some simulations, by a slice, numbers or a mask."""
        rows = np.atleast_1d(np.arange(len(self))[rows])
        if not len(rows):
            raise ValueError(f"no simulation of {len(self)} is chosen; choose one")
        arrays = {name: array[rows] for name, array in self.arrays.items()}
        return dataclasses.replace(self, arrays=arrays)

    def repeat(self, count: int) -> "Snapshot":
        """The snapshot of `count` simulations in the state of this single one.

        Raises:
            ValueError: if it is of several simulations, or `count` is out of range.
        """
        count = bounds.whole("count", count, 1, bounds.MOST_SIMULATIONS)
        if len(self) != 1:
            raise ValueError(
                f"the snapshot is of {len(self)} simulations; choose the one to repeat "
                "with snapshot[i]"
            )
        return self[np.zeros(count, int)]

    def part(self, name: str) -> dict[str, np.ndarray]:
        """Arrays whose names begin with `name` and a dot, by the rest of the name."""
        return _below(self.arrays, name)

    def require(self, other: "Snapshot") -> None:
        """Checks that the snapshot fits some simulations.

        Args:
            other: Present snapshot of those simulations.

        Raises:
            ValueError: if they are of another task, model or number, or the snapshot's
                state is not finite.
        """
        for key, own in other.task.items():
            if self.task.get(key) != own:
                mine, own, where = _apart(self.task.get(key), own)
                raise ValueError(
                    f"the snapshot is of another task: its {key}{where} is "
                    f"{bounds.shown(mine)}, here it is {bounds.shown(own)}"
                )
        if len(self) != len(other):
            raise ValueError(
                f"the snapshot is of {len(self)} simulations, {len(other)} are to be "
                "restored; choose some with snapshot[...], or repeat one with "
                "snapshot[i].repeat(n)"
            )
        if odd := sorted(set(self.arrays) ^ set(other.arrays)):
            whose = "it has" if odd[0] in self.arrays else "it lacks"
            raise ValueError(
                f"the snapshot is of a task with other options: {whose} {odd[0]}; make "
                "the task with the same observation, randomisation, vessel and effects"
            )
        for name, array in other.arrays.items():
            mine = _shape(name, self.arrays[name])
            if mine != _shape(name, array):
                raise ValueError(
                    f"the snapshot is of another model: {name} is {mine[0]} of shape "
                    f"{mine[1]}, here it is {array.dtype} of {array.shape}"
                )
        if not np.isfinite(self.arrays["stepper.state"]).all():
            raise ValueError("the snapshot is of a simulation that has diverged")

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes an .npz file without pickles; returns its path.

        Raises:
            ValueError: if the name does not end in .npz, or the unpacked file would be
                larger than `load` accepts.
            OSError: if it cannot be written.
        """
        meta = {"task": self.task, "versions": self.versions}
        return write_arrays(path, "snapshot", meta, self.arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Snapshot":
        """Reads a file that `save` has written.

        Raises:
            OSError: if there is no such file, or it is a directory.
            ValueError: if the file is damaged or holds no snapshot.
        """
        files.require_source(path, "a file that Snapshot.save wrote")
        meta, arrays = read_arrays(path, "snapshot")
        return cls.of(path, meta, arrays)

    @classmethod
    def of(
        cls, path: str | os.PathLike[str], meta: Mapping[str, Any], arrays: Arrays
    ) -> "Snapshot":
        """Makes a snapshot of what `read_arrays` returns; ValueError if it is none."""
        text = f"{path} holds no snapshot"
        with files.refused(ValueError, text, (KeyError, TypeError, AttributeError)):
            counts = {array.shape[:1] for array in arrays.values()}
            if len(counts) != 1 or not min(counts)[0]:
                raise TypeError("its arrays are of different numbers of simulations")
            return cls(dict(meta["task"]), dict(arrays), dict(meta["versions"]))


def versions() -> dict[str, str]:
    """Versions of this package and of MuJoCo."""
    return {"cathsim_dmc": __version__, "mujoco": mujoco.__version__}


# Files.


def write_arrays(
    path: str | os.PathLike[str], kind: str, meta: Mapping[str, Any], arrays: Arrays
) -> Path:
    """Writes arrays, their description (JSON-able) and a checksum; see `save`."""
    text = np.array(json.dumps({"kind": kind, "format": _FORMAT, **meta}))
    held, buffer = {_META: text, **arrays}, io.BytesIO()
    digest = np.array(_digest(held))
    np.savez_compressed(buffer, allow_pickle=False, **{_DIGEST: digest}, **held)
    with zipfile.ZipFile(buffer) as archive:
        unpacked = sum(one.file_size for one in archive.infolist())
    with files.refused(
        ValueError, "too many simulations for a file; save some of them", ValueError
    ):
        files.require_room(unpacked, buffer.tell())
    with files.atomic_path(path, ".npz") as temporary:
        temporary.write_bytes(buffer.getvalue())
    return Path(path)


def read_arrays(
    path: str | os.PathLike[str], kind: str
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Returns description and arrays of a file; ValueError if it is of another kind."""
    wrong = ValueError, KeyError, TypeError, RecursionError
    with files.refused(ValueError, f"{path} is no file of a {kind}", wrong):
        held = files.read_arrays(path)
        if any(array.dtype.kind not in _KINDS for array in held.values()):
            raise ValueError("it holds something other than numbers and texts")
        if _DIGEST not in held:
            raise ValueError("it has no checksum, so it is a file of another kind")
        if str(held.pop(_DIGEST)) != _digest(held):
            raise ValueError("its checksum is wrong")
        meta = dict(json.loads(str(held.pop(_META))))
        found = meta["kind"], meta["format"]
        if found != (kind, _FORMAT):
            wanted = f"{kind} of format {_FORMAT}"
            raise ValueError(f"it is a {found[0]} of format {found[1]}, not a {wanted}")
    return meta, held


def _digest(held: Arrays) -> str:
    total = hashlib.sha256()
    for name, array in sorted(held.items()):
        total.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def _apart(mine: Any, own: Any) -> tuple[Any, Any, str]:
    """Returns two unequal values, of lists what follows their equal beginning."""
    if not (isinstance(mine, list) and isinstance(own, list)):
        return mine, own, ""
    same = len(os.path.commonprefix([mine, own]))
    return mine[same:], own[same:], f" from number {same} on" if same else ""


def _shape(name: str, array: np.ndarray) -> tuple[np.dtype, tuple[int, ...]]:
    ragged = name.endswith(_RAGGED) and array.ndim > 1
    return array.dtype, (-1, *array.shape[2:]) if ragged else array.shape[1:]


def _below(arrays: Arrays, name: str) -> dict[str, np.ndarray]:
    start = f"{name}."
    found = arrays.items()
    return {n.removeprefix(start): a for n, a in found if n.startswith(start)}


# Values of attributes as arrays.


def packed(name: str, value: Any, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Converts an attribute of some simulations to arrays (K, ...) by name.

    Args:
        name: Name of the attribute.
        value: An array (N, ...), a named tuple or dictionary of values, or a list of N
            sources of randomness, dataclasses or arrays, or a tuple of texts or None.
            None, and a list that contains None, give no array.
        rows: (K,) numbers of the simulations.

    Raises:
        TypeError: if it is another kind of value.
    """
    if value is None:
        return {}
    if isinstance(value, np.ndarray):
        return {name: value[rows]}
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        pairs = [packed(f"{name}.{key}", one, rows) for key, one in value.items()]
        return {key: array for pair in pairs for key, array in pair.items()}
    if isinstance(value, list | tuple):
        chosen = [value[row] for row in rows]
        if isinstance(chosen[0], np.random.RandomState):
            return {f"{name}.{k}": one for k, one in _random_arrays(chosen).items()}
        if isinstance(value, tuple):
            return {name: np.array([one or "" for one in chosen], _TEXT)}
        if any(one is None for one in chosen):
            return {}
        if not dataclasses.is_dataclass(chosen[0]):
            return _ragged(name, chosen)
        fields = [field.name for field in dataclasses.fields(chosen[0])]
        values = {f: [getattr(one, f) for one in chosen] for f in fields}
        pairs = [_ragged(f"{name}.{f}", each) for f, each in values.items()]
        return {key: array for pair in pairs for key, array in pair.items()}
    raise TypeError(
        f"{name} is a {type(value).__name__}, which a snapshot cannot keep; keep state "
        "in arrays with a leading axis N"
    )


def _ragged(name: str, values: Sequence[Any]) -> dict[str, np.ndarray]:
    """Numbers as an array (K,), arrays (P, ...) as one (K, P, ...) padded with NaN."""
    if not isinstance(values[0], np.ndarray):
        return {name: np.array(values)}
    longest = max(map(len, values))
    padded = np.full((len(values), longest, *values[0].shape[1:]), np.nan)
    for row, value in zip(padded, values, strict=True):
        row[: len(value)] = value
    return {f"{name}{_RAGGED}": padded}


def restored(name: str, old: Any, arrays: Arrays, rows: np.ndarray) -> Any:
    """Returns a copy of `old` with some simulations taken from `packed` arrays.

    Args:
        name: Name of the attribute.
        old: Value for N simulations; sources of randomness are put back in place.
        arrays: Arrays (K, ...) by name.
        rows: (K,) numbers of the simulations.
    """
    if old is None:
        return None
    if isinstance(old, np.ndarray):
        new = old.copy()
        new[rows] = arrays[name]
        return new
    if hasattr(old, "_asdict"):
        pairs = old._asdict().items()
        values = (restored(f"{name}.{k}", one, arrays, rows) for k, one in pairs)
        return type(old)._make(values)
    if isinstance(old, Mapping):
        pairs = old.items()
        new = {k: restored(f"{name}.{k}", one, arrays, rows) for k, one in pairs}
        kind: Any = type(old)
        return kind(new)
    new = list(old)
    first = old[rows[0]]
    if isinstance(first, np.random.RandomState):
        _set_random([old[row] for row in rows], _below(arrays, name))
    elif isinstance(old, tuple):
        for row, text in zip(rows.tolist(), arrays[name].tolist(), strict=True):
            new[row] = text or None
    elif isinstance(first, np.ndarray):
        for row, array in zip(rows, arrays[f"{name}{_RAGGED}"], strict=True):
            new[row] = _unpadded(array)
    elif first is not None:
        own = {f.removesuffix(_RAGGED): a for f, a in _below(arrays, name).items()}
        for k, row in enumerate(rows):
            fields = {field: _unpadded(array[k]) for field, array in own.items()}
            new[row] = dataclasses.replace(first, **fields)
    return type(old)(new)


def _unpadded(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value.item()
    gone = np.isnan(value).any(axis=tuple(range(1, value.ndim)))
    return value[~gone]


def _random_arrays(sources: Sequence[np.random.RandomState]) -> dict[str, np.ndarray]:
    states: list[Any] = [source.get_state(legacy=False) for source in sources]
    rest = [(s["state"]["pos"], s["has_gauss"], s["gauss"]) for s in states]
    words = np.array([state["state"]["key"] for state in states])
    return {"words": words, "rest": np.array(rest, dtype=np.float64)}


def _set_random(sources: Sequence[np.random.RandomState], arrays: Arrays) -> None:
    rest = arrays["rest"]
    # numpy reads its words at this place, without a check of bounds.
    if not ((rest[:, 0] >= 0) & (rest[:, 0] <= _WORDS)).all():
        raise ValueError(
            f"the snapshot's random states have the positions {rest[:, 0].tolist()}"
        )
    pairs = zip(sources, arrays["words"], rest.tolist(), strict=True)
    for source, words, (place, has_gauss, gauss) in pairs:
        source.set_state(("MT19937", words, int(place), int(has_gauss), gauss))
