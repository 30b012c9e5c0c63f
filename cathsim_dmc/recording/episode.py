"""One recorded episode: states, actions, rewards and contact forces.

The record is independent of any scene: it holds world-frame arrays and a JSON
dictionary, so statistics, heatmaps and Rerun files can be made from it long after
the environment is gone, on a machine that has neither MuJoCo nor Rerun.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc.files import atomic_path, read_arrays

FORMAT = "cathsim-episode"
FORMAT_VERSION = 1
SUFFIX = ".npz"
_LARGEST = 4_000_000_000  # bytes of all arrays, unpacked
TERMINATIONS = ("success", "truncated", "physics_error")

# A unit quaternion out of MuJoCo's float64 arithmetic is off by rounding only; this
# admits float32 sources and still catches swapped or unnormalised ones.
QUATERNION_TOLERANCE = 1e-4

# Leading axis of every array: "state" has T+1 rows, "step" has T, "contact" has K.
_AXES: dict[str, tuple[str, tuple[int | str, ...]]] = {
    "time": ("state", ()),
    "qpos": ("state", ("nq",)),
    "catheter": ("state", ("L+1", 3)),
    "body_pos": ("state", ("nbody", 3)),
    "body_quat": ("state", ("nbody", 4)),
    "insertion": ("state", ()),
    "action": ("step", ("A",)),
    "reward": ("step", ()),
    "wall_force_sum": ("step", ()),
    "wall_force_max": ("step", ()),
    "push_force": ("step", ()),
    "contact_step": ("contact", ()),
    "contact_position": ("contact", (3,)),
    "contact_force": ("contact", (3,)),
}
_NON_NEGATIVE = ("wall_force_sum", "wall_force_max")


@dataclass(frozen=True, eq=False)
class Episode:
    """T control steps and the state they started from; arrays are read-only copies.

    Lengths in metres, forces in newtons, time in seconds, all positions in the world
    frame (patient frame LPS), quaternions wxyz. Row ``t`` of a state array precedes
    action ``t`` and row ``t + 1`` follows it; row ``t`` of a step array other than
    ``action`` was measured at state ``t + 1``.

    Attributes:
        task: Registered name of the task.
        seed: Seed the episode was reset with, or None if it was not seeded.
        meta: JSON dictionary; ``success`` (bool) and ``termination`` are required.
        time: (T+1,) simulated time, strictly increasing.
        qpos: (T+1, nq) generalised positions.
        catheter: (T+1, L+1, 3) joints of the catheter, proximal to distal, then head.
        body_pos: (T+1, nbody, 3) origins of the body frames.
        body_quat: (T+1, nbody, 4) orientations of the body frames, wxyz.
        action: (T, A) as given to the environment.
        reward: (T,).
        insertion: (T+1,) position of the insertion joint.
        wall_force_sum: (T,) sum of contact force magnitudes over the wall.
        wall_force_max: (T,) largest single contact force magnitude.
        push_force: (T,) force at the base of the device, signed as the task says.
        contact_step: (K,) int64, index of the step, non-decreasing.
        contact_position: (K, 3).
        contact_force: (K, 3) force on the wall by the device.

    Raises:
        ValueError: on a wrong shape, a value that is not finite, time that does not
            advance, a quaternion that is not a unit one, contacts out of order, or
            metadata that JSON cannot hold.
    """

    task: str
    seed: int | None
    meta: dict[str, Any] = field(repr=False)
    time: np.ndarray = field(repr=False)
    qpos: np.ndarray = field(repr=False)
    catheter: np.ndarray = field(repr=False)
    body_pos: np.ndarray = field(repr=False)
    body_quat: np.ndarray = field(repr=False)
    action: np.ndarray = field(repr=False)
    reward: np.ndarray = field(repr=False)
    insertion: np.ndarray = field(repr=False)
    wall_force_sum: np.ndarray = field(repr=False)
    wall_force_max: np.ndarray = field(repr=False)
    push_force: np.ndarray = field(repr=False)
    contact_step: np.ndarray = field(repr=False)
    contact_position: np.ndarray = field(repr=False)
    contact_force: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.task, str) or not self.task:
            raise ValueError(f"task must be a non-empty string, got {self.task!r}")
        if self.seed is not None:
            if not _is_whole(self.seed):
                raise ValueError(f"seed must be an integer or None, got {self.seed!r}")
            object.__setattr__(self, "seed", int(self.seed))
        object.__setattr__(self, "meta", _checked_meta(self.meta))
        for name in _AXES:
            dtype = np.int64 if name == "contact_step" else np.float64
            object.__setattr__(self, name, _frozen(name, getattr(self, name), dtype))
        self._check_shapes()
        self._check_values()

    def _check_shapes(self) -> None:
        if self.time.ndim != 1 or self.time.size == 0:
            raise ValueError(
                f"time must have shape (T+1,) with T >= 0, got {self.time.shape}"
            )
        rows = {
            "state": self.time.size,
            "step": self.time.size - 1,
            "contact": np.atleast_1d(self.contact_step).shape[0],
        }
        sizes: dict[str, int] = {}
        for name, (axis, tail) in _AXES.items():
            shape = getattr(self, name).shape
            wanted = (
                rows[axis],
                *(sizes.get(n, n) if isinstance(n, str) else n for n in tail),
            )
            fits = len(shape) == len(wanted) and all(
                isinstance(want, str) or have == want
                for have, want in zip(shape, wanted, strict=True)
            )
            if not fits:
                spelled = ", ".join(str(w) for w in wanted)
                raise ValueError(
                    f"{name} must have shape ({spelled}) because time has "
                    f"{rows['state']} entries and contact_step {rows['contact']}; "
                    f"got {shape}"
                )
            for have, want in zip(shape[1:], tail, strict=True):
                if isinstance(want, str):
                    sizes[want] = have
        if sizes["L+1"] < 2:
            raise ValueError(
                "catheter needs at least one joint and the head, so shape "
                f"(T+1, >=2, 3); got {self.catheter.shape}"
            )

    def _check_values(self) -> None:
        for name in _AXES:
            array = getattr(self, name)
            if not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0, 0])
                raise ValueError(
                    f"{name} is not finite in row {row}; leave a diverged step out of "
                    "the record and set meta['termination'] to 'physics_error'"
                )
        for name in _NON_NEGATIVE:
            if (getattr(self, name) < 0).any():
                raise ValueError(f"{name} is a magnitude and must not be negative")
        if (np.diff(self.time) <= 0).any():
            row = int(np.argmax(np.diff(self.time) <= 0)) + 1
            raise ValueError(f"time must increase strictly; it does not at row {row}")
        norm = np.linalg.norm(self.body_quat, axis=-1)
        if norm.size and np.abs(norm - 1).max() > QUATERNION_TOLERANCE:
            raise ValueError(
                "body_quat must hold unit quaternions (wxyz); norms range from "
                f"{norm.min():.6g} to {norm.max():.6g}"
            )
        steps = self.contact_step
        if steps.size and (steps.min() < 0 or steps.max() >= self.steps):
            raise ValueError(
                f"contact_step must lie in [0, {self.steps}), got "
                f"{steps.min()} to {steps.max()}"
            )
        if (np.diff(steps) < 0).any():
            raise ValueError("contact_step must not decrease; sort contacts by step")

    @property
    def steps(self) -> int:
        """Number of control steps T."""
        return self.time.size - 1

    @property
    def success(self) -> bool:
        """Whether the task counted the episode as a success."""
        return self.meta["success"]

    @property
    def termination(self) -> str:
        """Why the episode ended, one of ``TERMINATIONS``."""
        return self.meta["termination"]

    @property
    def head(self) -> np.ndarray:
        """(T+1, 3) position of the distal end of the catheter, world frame, metres."""
        return self.catheter[:, -1]

    @property
    def contact_counts(self) -> np.ndarray:
        """(T,) int64 number of contacts with the wall in every step."""
        return np.bincount(self.contact_step, minlength=self.steps)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the episode to ``path`` (``.npz``), whole or not at all.

        Raises:
            ValueError: if the name does not end in ``.npz``.
            FileNotFoundError: if the directory does not exist.
        """
        with atomic_path(path, SUFFIX) as temporary:
            self.write(temporary)
        return Path(path)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write what `save` does, whatever the name, over what is there."""
        header = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "task": self.task,
            "seed": self.seed,
            "meta": self.meta,
        }
        arrays = {name: getattr(self, name) for name in _AXES}
        with open(path, "wb") as stream:
            np.savez_compressed(stream, header=np.array(json.dumps(header)), **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Episode:
        """Read an episode that ``save`` wrote; nothing in the file is executed.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not an episode, is damaged, or is of a later
                version.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"no episode at {path}")
        try:
            arrays = read_arrays(path, _LARGEST, ("header", *_AXES))
            header = json.loads(str(arrays.pop("header")))
        except (ValueError, RecursionError) as error:
            raise ValueError(
                f"{path} is not an episode written by Episode.save: {error}"
            ) from error
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise ValueError(f"{path} is an archive of another kind, not an episode")
        if repr(header.get("version")) != repr(FORMAT_VERSION):  # True is no 1
            raise ValueError(
                f"{path} has episode format {header.get('version')!r}; this version "
                f"reads {FORMAT_VERSION}: record it again or use the version of "
                "cathsim_dmc that wrote it"
            )
        try:
            return cls(header["task"], header["seed"], header["meta"], **arrays)
        except KeyError as error:
            raise ValueError(f"{path} lacks the entry {error}") from error
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def equals(self, other: Episode) -> bool:
        """Whether both hold the same values, bit for bit."""
        return all(
            np.array_equal(getattr(self, f.name), getattr(other, f.name))
            if f.name in _AXES
            else getattr(self, f.name) == getattr(other, f.name)
            for f in fields(self)
        )


def _frozen(name: str, value: Any, dtype: type) -> np.ndarray:
    try:
        given = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name} must be an array, not ragged lists") from error
    if given.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be numeric, got dtype {given.dtype}")
    if dtype is np.int64 and given.dtype.kind == "f" and given.size:
        raise ValueError(f"{name} must hold integers, got dtype {given.dtype}")
    array = np.array(given, dtype=dtype)
    array.setflags(write=False)
    return array


def _is_whole(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    return bool(np.isfinite(value)) and int(value) == value


def _plain(value: Any) -> Any:
    """Numpy values as JSON values; TypeError for all others."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} ({value!r}) has no JSON form")


def _checked_meta(meta: Any) -> dict[str, Any]:
    if not isinstance(meta, dict):
        raise ValueError(f"meta must be a dict, got {type(meta).__name__}")
    try:
        plain = json.loads(json.dumps(meta, default=_plain, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"meta must be plain JSON (finite numbers, text, lists, dicts): {error}"
        ) from error
    if not isinstance(plain.get("success"), bool):
        raise ValueError(
            f"meta['success'] must be true or false, got {plain.get('success')!r}"
        )
    if plain.get("termination") not in TERMINATIONS:
        raise ValueError(
            f"meta['termination'] must be one of {', '.join(TERMINATIONS)}; got "
            f"{plain.get('termination')!r}"
        )
    if plain["success"] != (plain["termination"] == "success"):
        raise ValueError(
            f"meta['success'] is {plain['success']} but meta['termination'] is "
            f"{plain['termination']!r}"
        )
    return plain
