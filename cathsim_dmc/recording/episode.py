"""One recorded episode: states, actions, rewards and contact forces.

It holds world-frame arrays and a JSON dictionary, and needs neither scene nor MuJoCo.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.files import atomic_path, read_arrays, refused, require_source

FORMAT = "cathsim-episode"
FORMAT_VERSION = 1
SUFFIX = ".npz"
TERMINATIONS = ("success", "truncated", "physics_error", "given_up", "failed")
# 5F diagnostic catheter, 1.67 mm outer diameter; used when the record has no radii.
CATHETER_RADIUS = 0.835e-3
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
        time: (T+1,) simulated time.
        qpos: (T+1, nq) generalised positions.
        catheter: (T+1, L+1, 3) joints of the catheter, proximal to distal, then head.
        body_pos: (T+1, nbody, 3) origins of the body frames.
        body_quat: (T+1, nbody, 4) orientations of the body frames, wxyz.
        action: (T, A) as given to the environment.
        reward: (T,).
        insertion: (T+1,) position of the insertion joint.
        wall_force_sum: (T,) sum of contact force magnitudes over the wall at the end
            of the control step; ``meta`` has means and peaks within it.
        wall_force_max: (T,) largest single contact force magnitude, likewise.
        push_force: (T,) force of the base on the device, positive forward.
        contact_step: (K,) int64, index of the step, non-decreasing.
        contact_position: (K, 3).
        contact_force: (K, 3) force on the wall by the device.

    Raises:
        ValueError: on a wrong shape, a value that is not finite, contacts out of order,
            or metadata that JSON cannot represent.
    """

    task: str
    seed: int | None
    meta: dict[str, Any]
    time: np.ndarray
    qpos: np.ndarray
    catheter: np.ndarray
    body_pos: np.ndarray
    body_quat: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    insertion: np.ndarray
    wall_force_sum: np.ndarray
    wall_force_max: np.ndarray
    push_force: np.ndarray
    contact_step: np.ndarray
    contact_position: np.ndarray
    contact_force: np.ndarray

    def __post_init__(self) -> None:
        if not isinstance(self.task, str) or not self.task:
            raise ValueError(f"task must be a non-empty string, got {self.task!r}")
        if self.seed is not None:
            object.__setattr__(self, "seed", bounds.whole("seed", self.seed))
        object.__setattr__(self, "meta", _checked_meta(self.meta))
        states = np.size(self.time)
        sizes = {"state": states, "step": states - 1}
        sizes["contact"] = np.size(self.contact_step)
        for name, (axis, tail) in _AXES.items():
            kinds, dtype = "biuf", np.float64
            if name == "contact_step":
                kinds, dtype = "iu", np.int64
            shape = (sizes[axis], *(-1 if isinstance(n, str) else n for n in tail))
            given = bounds.array(name, getattr(self, name), kinds, shape)
            array = np.array(given, dtype)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        steps = self.contact_step
        order = np.diff(steps, prepend=0, append=self.steps - 1)
        if steps.size and (order < 0).any():
            raise ValueError(
                f"contact_step must not decrease and lie in [0, {self.steps}), got "
                f"{steps}"
            )

    def __repr__(self) -> str:
        """Task, seed, length and end of the episode."""
        return (
            f"<Episode of {self.task!r}, seed {self.seed}, {self.steps} control steps, "
            f"{self.termination}>"
        )

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
    def radii(self) -> np.ndarray:
        """(L,) radii of the links, metres: ``meta['catheter_radius']``, or a 5F's."""
        given = self.meta.get("catheter_radius", CATHETER_RADIUS)
        return np.broadcast_to(np.float64(given), (self.catheter.shape[1] - 1,))

    @property
    def contact_counts(self) -> np.ndarray:
        """(T,) int64 number of contacts with the wall in every step."""
        return np.bincount(self.contact_step, minlength=self.steps)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the episode to a ``.npz``, whole or not at all."""
        header = {"format": FORMAT, "version": FORMAT_VERSION, "task": self.task}
        header |= {"seed": self.seed, "meta": self.meta}
        arrays = {name: getattr(self, name) for name in _AXES}
        arrays["header"] = np.array(json.dumps(header))
        with atomic_path(path, SUFFIX) as temporary, open(temporary, "wb") as stream:
            np.savez_compressed(stream, **arrays)
        return Path(path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Episode":
        """Read an episode that ``save`` wrote; nothing in the file is executed.

        Raises:
            OSError: if there is no such file, or it is a directory.
            ValueError: if the file is not an episode, is damaged, or is of a later
                version.
        """
        way = "a .npz file of `cathsim record`, `cathsim play` or Episode.save"
        path = require_source(path, way)
        text = f"{path} is not an episode written by Episode.save"
        wrong = KeyError, TypeError, ValueError, RecursionError
        with refused(ValueError, text, wrong):
            arrays = read_arrays(path, ("header", *_AXES))
            header = json.loads(str(arrays.pop("header")))
            if header["format"] != FORMAT:
                raise ValueError("it is of another kind")
            if repr(header["version"]) != repr(FORMAT_VERSION):  # True is no 1
                raise ValueError(
                    f"it has format {header['version']!r} and this version reads "
                    f"{FORMAT_VERSION}: record it again or use the version of "
                    "cathsim_dmc that wrote it"
                )
            return cls(header["task"], header["seed"], header["meta"], **arrays)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} ({value!r}) has no JSON form")


def _checked_meta(meta: Any) -> dict[str, Any]:
    try:
        plain = json.loads(json.dumps(meta, default=_plain, allow_nan=False))
        success, termination = plain["success"], plain["termination"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            "meta must be a dict of plain JSON (finite numbers, text, lists, dicts) "
            f"with success and termination: {error!r}"
        ) from error
    if termination not in TERMINATIONS or success is not (termination == "success"):
        raise ValueError(
            f"meta['termination'] is {termination!r} and must be one of "
            f"{', '.join(TERMINATIONS)}; meta['success'] is {success!r}, true for "
            "'success' but false for the others"
        )
    return plain
