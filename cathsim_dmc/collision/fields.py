"""Registration of distance fields as walls in MuJoCo's collision table.

One box geom, the carrier, encloses the wall of a lumen or a bore; its `geom_user` holds
the key of the field. Compiled functions replace those of capsule–box and sphere–box
contact in the collision table: they compute the contacts of carriers and call the
replaced function for every other box. They find fields by key, so a model may be
copied, saved and run on any thread.

MuJoCo stops with an error at a carrier whose field is not registered in the process.
Without this package a carrier is a solid box that overlaps the device and expels it.
`mj_geomDistance` and rays always see the box.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import re
import threading
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.field import Field

_MESSAGE = (
    b"geom %d carries a field that is not registered in this process; register it "
    b"(cathsim_dmc.collision.fields.register) or load the task anew"
)
_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
_TYPES = int(mujoco.mjtGeom.mjNGEOMTYPES)

_EXCURSION = 40e-3  # m, largest displacement of a wall beyond the box of its field
_LOCK = threading.Lock()  # held while the table is made or written


class Bore:
    """Circular bore along a polyline, open at both ends: the lumen of a sheath."""

    def __init__(self, points: np.ndarray, radii: np.ndarray | float):
        """Initialises the bore.

        Args:
            points: (n, 3), vertices of the axis, m.
            radii: (n,) or scalar, m.

        Raises:
            ValueError: if there are fewer than two points, consecutive ones coincide,
                or a radius is not positive.
        """
        points = bounds.array("points of a bore", points, shape=(-1, 3))
        if len(points) < 2:
            bounds.refuse("points of a bore", points, "two or more, of shape (n, 3)")
        radii = bounds.array("radii of a bore", radii)
        if radii.shape not in ((), (len(points),)):
            bounds.refuse("radii of a bore", radii, f"a number, or {len(points)}")
        radii = np.broadcast_to(radii.astype(np.float64), len(points))
        points = points.astype(np.float64)
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if not (steps.min() > 0 and radii.min() > 0):
            raise ValueError(
                f"the bore's points are {steps.min():g} m apart and its radii "
                f"{radii.min():g} m at the least; both must be above 0"
            )
        rows = np.column_stack([points, radii])
        self.arrays = (np.concatenate([[len(rows)], rows.ravel()]),)
        self.box = ((points - radii[:, None]).min(0), (points + radii[:, None]).max(0))


class _Table:
    """Table of the process's fields by key, which compiled functions read."""

    def __init__(self):
        from cathsim_dmc.collision import loops, table

        # Owners of the arrays in the table; never freed.
        self._kept: dict[int, list[np.ndarray]] = {}
        self._lattices: dict[int, np.ndarray] = {}
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
        # The key is written last: other threads search the table concurrently.
        self._kept[key], row[0] = kept, key

    def at(self, key: int) -> tuple[int, list[np.ndarray], np.ndarray | None]:
        """Kind, arrays and lattice of an entry; KeyError if there is none."""
        kept = self._kept[key]
        row = self._rows[np.flatnonzero(self._rows[:, 0] == key)[0]]
        return int(row[1]), kept, self._lattices.get(key)

    def move(self, key: int, lattice: np.ndarray) -> None:
        """Adds a motion lattice to an entry, for simulations of a moving vessel."""
        if key in self._lattices:
            return
        from cathsim_dmc.collision import moving

        # Before the lattice is kept: an interrupt may end this compilation.
        self._collide_by(moving)
        self._lattices[key] = lattice
        row = self._rows[np.flatnonzero(self._rows[:, 0] == key)[0]]
        row[self._motion] = lattice.ctypes.data

    def _collide_by(self, module: types.ModuleType) -> None:
        # The function of `moving` handles walls at rest, too.
        address = module.of_link.address  # 0 for no contacts
        for kind in (_CAPSULE, _SPHERE):
            self._functions[kind * _TYPES + _BOX] = address


_made_table = functools.cache(_Table)


def _get_table() -> _Table:
    """The table of the process, also for threads that first ask at the same time."""
    with _LOCK:
        return _made_table()


def register(
    field: Field | Bore, motion: np.ndarray | None = None
) -> tuple[float, ...]:
    """Registers a field for collisions in this process; it is never removed.

    Args:
        field: Wall whose inner side is in contact.
        motion: See `carrier`.

    Returns:
        Values of `geom_user` of its carrier.

    Raises:
        MemoryError: if the table of the process is full.
    """
    from cathsim_dmc.collision.table import BORE, LUMEN, MARK, PART

    whole = isinstance(field, Field)
    digest = (
        field.digest if whole else hashlib.sha256(bytes(field.arrays[0].data)).digest()
    )
    if motion is not None:  # equal walls with different motions have own entries
        motion = np.ascontiguousarray(motion)
        digest = hashlib.sha256(digest + motion.tobytes()).digest()
    parts = [int.from_bytes(digest[3 * k : 3 * k + 3], "big") % PART for k in range(3)]
    parts[0] = parts[0] or 1  # a key of 0 marks a free slot
    (low, high), kind = field.box, LUMEN if whole else BORE
    known, key = _get_table(), _key(parts)
    with _LOCK:
        known.put(key, kind, (low + high) / 2, field.arrays)
        if motion is not None:
            known.move(key, motion)
    return (MARK, *map(float, parts))


class Registered(NamedTuple):
    """A wall in the table.

    Attributes:
        is_bore: Whether the wall is a bore.
        middle: (3,) m, centre of the carrier in the frame of the wall.
        arrays: Arrays of the field, or the line of the bore.
        lattice: Lattice of its motion; None for a wall at rest.
    """

    is_bore: bool
    middle: np.ndarray
    arrays: Sequence[np.ndarray]
    lattice: np.ndarray | None


def registered(user: Sequence[float]) -> Registered | None:
    """The registered wall that a carrier's `geom_user` names.

    Returns:
        The wall; None for a geom that is no carrier.

    Raises:
        KeyError: if the wall is not registered in this process.
    """
    from cathsim_dmc.collision.table import BORE, MARK, USER

    if len(user) < USER or user[0] != MARK:
        return None
    key = _key([int(part) for part in user[1:USER]])
    kind, (middle, *arrays), lattice = _get_table().at(key)
    return Registered(kind == BORE, middle, arrays, lattice)


def carrier(field: Field | Bore, motion: np.ndarray | None = None) -> dict[str, Any]:
    """MJCF attributes of the invisible carrier of a field, in the field's frame.

    Args:
        field: Wall whose inner side is in contact.
        motion: Lattice of `anatomy.motion.Motion`, which displaces the wall in
            simulations with `physics.motion.Moving`; None for a wall at rest.
    """
    low, high = field.box
    around = 0.0 if motion is None else _EXCURSION
    return {
        "type": "box",
        "pos": (low + high) / 2,
        "size": (high - low) / 2 + around,
        "user": register(field, motion),
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
