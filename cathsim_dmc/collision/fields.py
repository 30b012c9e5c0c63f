"""Contact with a field, through MuJoCo's collision table.

The wall of a lumen, or of a bore, is one box geom, its carrier, which encloses it and
names its field in `geom_user`. MuJoCo asks the collision table what a capsule or a
sphere does to a box; the functions here answer for carriers, and hand every other box
to the function that stood there before. They are compiled and know the process's fields
by their keys: a model may be copied, saved and run on any thread.

A carrier whose field this process does not know ends the step with MuJoCo's error. In
a process without this package it is a solid box around the device, which is thrown out
of it at once. What a carrier is to `mj_geomDistance` and to rays is that box, too.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import re
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from cathsim_dmc.anatomy.field import Field

_MESSAGE = (
    b"geom %d carries a field that this process does not know; register it "
    b"(cathsim_dmc.collision.fields.register) or load the task anew"
)
_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
_TYPES = int(mujoco.mjtGeom.mjNGEOMTYPES)

_EXCURSION = 40e-3  # m, by which a moving wall may leave the box of its field


class Bore:
    """A round bore along a line, open at both ends: the inside of a sheath."""

    def __init__(self, points: np.ndarray, radii: np.ndarray | float):
        """Makes the bore.

        Args:
            points: (n, 3) of its axis, m.
            radii: (n,) or one for all, m.

        Raises:
            ValueError: if the line repeats a point, or a radius is not positive.
        """
        points = np.asarray(points, dtype=np.float64)
        radii = np.broadcast_to(np.asarray(radii, dtype=np.float64), len(points))
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if not (steps.min() > 0 and radii.min() > 0 and np.isfinite(points).all()):
            raise ValueError(
                f"the bore's points are {steps.min():g} m apart and its radii "
                f"{radii.min():g} m at the least; both must be above 0"
            )
        rows = np.column_stack([points, radii])
        self.arrays = (np.concatenate([[len(rows)], rows.ravel()]),)
        self.box = ((points - radii[:, None]).min(0), (points + radii[:, None]).max(0))


class _Table:
    """The process's fields, by their keys, where compiled functions find them."""

    def __init__(self):
        from cathsim_dmc.collision import loops, table

        # The arrays whose addresses are in the table, for as long as the process.
        self._kept: dict[int, list[np.ndarray]] = {}
        self._lattices: dict[int, list[np.ndarray]] = {}
        self._words, self._message = table.TABLE, ctypes.create_string_buffer(_MESSAGE)
        self._library = _mujoco_library()
        self._functions = (ctypes.c_void_p * (_TYPES * _TYPES)).in_dll(
            self._library, "mjCOLLISIONFUNC"
        )
        for kind, place in (_CAPSULE, table.OF_CAPSULE), (_SPHERE, table.OF_SPHERE):
            before = self._functions[kind * _TYPES + _BOX]
            self._words[place // 8] = before or 0
        error = ctypes.cast(self._library.mju_error, ctypes.c_void_p).value
        self._words[table.ERROR // 8] = error or 0
        self._words[table.MESSAGE // 8] = ctypes.addressof(self._message)
        self._collide_by(loops)
        self._rows = self._words[table.HEAD :].reshape(-1, table.ENTRY)
        self._motion = table.MOTION_ENTRY // 8

    def put(
        self, key: int, kind: int, middle: np.ndarray, arrays: Sequence[np.ndarray]
    ) -> None:
        if key in self._kept:
            return
        most = len(self._rows) // 2
        if len(self._kept) >= most:
            raise MemoryError(f"a process can hold {most} fields; start another")
        slot = key % len(self._rows)
        while self._rows[slot, 0]:
            slot = (slot + 1) % len(self._rows)
        row = self._rows[slot]
        kept = [np.ascontiguousarray(array) for array in (middle, *arrays)]
        row[1 : 2 + len(kept)] = kind, *(array.ctypes.data for array in kept)
        # Last: threads may look for other entries meanwhile.
        self._kept[key], row[0] = kept, key

    def at(self, key: int) -> tuple[int, list[np.ndarray]]:
        """Kind and arrays of an entry; KeyError for a key that is not there."""
        kept = self._kept[key]
        row = self._rows[np.flatnonzero(self._rows[:, 0] == key)[0]]
        return int(row[1]), kept

    def move(self, key: int, lattice: np.ndarray) -> None:
        """Gives the field of an entry a motion, for simulations that have one."""
        self._lattices.setdefault(key, []).append(lattice)
        row = self._rows[np.flatnonzero(self._rows[:, 0] == key)[0]]
        row[self._motion] = lattice.ctypes.data
        from cathsim_dmc.collision import moving

        self._collide_by(moving)

    def _collide_by(self, module: types.ModuleType) -> None:
        # The functions of `moving` do what those of `loops` do, and more.
        self._functions[_CAPSULE * _TYPES + _BOX] = module.of_capsule.address
        self._functions[_SPHERE * _TYPES + _BOX] = module.of_sphere.address


_get_table = functools.cache(_Table)


def register(field: Field | Bore) -> tuple[float, ...]:
    """Makes a field known to this process's collisions, for as long as it lives.

    Args:
        field: wall that touches from its inside.

    Returns:
        What the `geom_user` of its carrier is to hold.
    """
    from cathsim_dmc.collision.table import BORE, LUMEN, MARK, PART

    whole = isinstance(field, Field)
    digest = (
        field.digest if whole else hashlib.sha256(bytes(field.arrays[0].data)).digest()
    )
    parts = [int.from_bytes(digest[3 * k : 3 * k + 3], "big") % PART for k in range(3)]
    parts[0] = parts[0] or 1  # a key of 0 is none
    (low, high), kind = field.box, LUMEN if whole else BORE
    _get_table().put(_key(parts), kind, (low + high) / 2, field.arrays)
    return (MARK, *map(float, parts))


def registered(
    user: Sequence[float],
) -> tuple[bool, np.ndarray, list[np.ndarray]] | None:
    """The wall that a carrier's `geom_user` names, as this process knows it.

    Returns:
        Whether it is a bore; place (3,) m of the carrier's middle in the frame of the
        wall; its arrays. None for a geom that carries no wall.

    Raises:
        KeyError: if the process does not know the wall.
    """
    from cathsim_dmc.collision.table import BORE, MARK, USER

    if len(user) < USER or user[0] != MARK:
        return None
    kind, (middle, *arrays) = _get_table().at(
        _key([int(part) for part in user[1:USER]])
    )
    return kind == BORE, middle, arrays


def carrier(field: Field | Bore, motion: np.ndarray | None = None) -> dict[str, Any]:
    """Attributes of the geom that carries a field, unseen, on a body with its frame.

    Args:
        field: wall that touches from its inside.
        motion: lattice of `anatomy.motion.Motion`, by which it moves in simulations
            with `physics.motion.Moving`; None for a wall at rest.
    """
    low, high = field.box
    user, around = register(field), 0.0
    if motion is not None:
        around = _EXCURSION
        _get_table().move(_key([int(part) for part in user[1:]]), motion)
    return {
        "type": "box",
        "pos": (low + high) / 2,
        "size": (high - low) / 2 + around,
        "user": user,
        "mass": 0,
        "group": 5,
        "rgba": (0, 0, 0, 0),
    }


def _key(parts: Sequence[int]) -> int:
    from cathsim_dmc.collision.table import PART

    return (parts[0] * PART + parts[1]) * PART + parts[2]


def _mujoco_library() -> ctypes.CDLL:
    folder = Path(mujoco.__path__[0])
    for path in sorted(folder.glob("*mujoco*")):
        if re.search(r"\.(so|dylib|dll)", path.name):
            return ctypes.CDLL(str(path))
    raise RuntimeError(f"no MuJoCo library in {folder}; install the wheel of mujoco")
