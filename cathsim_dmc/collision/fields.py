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

# Impedance of all contacts with a field. It does not change with the depth, so the
# contact is a spring of one stiffness, and its rattle (docs/physics.md) has m = 0.
IMPEDANCE = 0.95
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
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
            raise ValueError(
                f"the bore's line has shape {points.shape}; give (n, 3), n >= 2"
            )
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
        from cathsim_dmc.collision import loops, native
        from cathsim_dmc.collision import table as words

        self._words = words.TABLE
        # The arrays whose addresses are in the table, for as long as the process.
        self._kept: dict[int, Any] = {}
        model = ("nuser_geom", "geom_user", "geom_size", "geom_bodyid")
        model += ("body_parentid",)
        self._words[:5] = native.offsets("mjModel", model)
        data = ("geom_xpos", "geom_xmat", "xpos")
        self._words[5:8] = native.offsets("mjData", data)
        moving = ("body_dofadr", "body_dofnum", "body_rootid", "dof_parentid")
        moving += ("opt.timestep",)
        self._words[16:21] = native.offsets("mjModel", moving)
        velocity = ("qvel", "cdof", "subtree_com")
        self._words[21:24] = native.offsets("mjData", velocity)
        more = native.offsets("mjModel", ("geom_solimp", "nuserdata", "geom_solref"))
        for place, offset in zip(
            (words.GEOM_SOLIMP, words.NUSERDATA, words.GEOM_SOLREF), more, strict=True
        ):
            self._words[place // 8] = offset
        user = native.offsets("mjData", ("userdata", "time"))
        self._words[words.USERDATA // 8 : words.TIME // 8 + 1] = user
        self._library = _mujoco_library()
        table = (ctypes.c_void_p * (_TYPES * _TYPES)).in_dll(
            self._library, "mjCOLLISIONFUNC"
        )
        error = ctypes.cast(self._library.mju_error, ctypes.c_void_p)
        self._message = ctypes.create_string_buffer(_MESSAGE)
        places = {_CAPSULE: words.OF_CAPSULE, _SPHERE: words.OF_SPHERE}
        for kind, place in places.items():
            self._words[place // 8] = table[kind * _TYPES + _BOX] or 0
        self._words[words.ERROR // 8] = error.value or 0
        self._words[words.MESSAGE // 8] = ctypes.addressof(self._message)
        table[_CAPSULE * _TYPES + _BOX] = loops.of_capsule.address
        table[_SPHERE * _TYPES + _BOX] = loops.of_sphere.address

    def put(
        self, key: int, kind: int, middle: np.ndarray, arrays: Sequence[np.ndarray]
    ) -> None:
        from cathsim_dmc.collision.table import CAPACITY, ENTRY, HEAD

        if key in self._kept:
            return
        if len(self._kept) >= CAPACITY // 2:
            raise MemoryError(
                f"a process can hold {CAPACITY // 2} fields; start another"
            )
        slot = key % CAPACITY
        while self._words[HEAD + ENTRY * slot]:
            slot = (slot + 1) % CAPACITY
        row = self._words[HEAD + ENTRY * slot :][:ENTRY]
        kept = [np.ascontiguousarray(array) for array in (middle, *arrays)]
        self._kept[key] = kept
        row[1] = kind
        row[2 : 2 + len(kept)] = [array.ctypes.data for array in kept]
        row[0] = key  # last: threads may look for other entries meanwhile

    def move(self, key: int, lattice: np.ndarray) -> None:
        """Gives the field of an entry a motion, for simulations that have one."""
        from cathsim_dmc.collision.table import ENTRY, HEAD, MOTION_ENTRY

        rows = self._words[HEAD:].reshape(-1, ENTRY)
        row = rows[np.flatnonzero(rows[:, 0] == key)[0]]
        self._kept[key].append(lattice)
        row[MOTION_ENTRY // 8] = lattice.ctypes.data

    def knows(self, key: int) -> bool:
        return key in self._kept


_table: _Table | None = None


def _get_table() -> _Table:
    global _table
    if _table is None:
        _table = _Table()
    return _table


def register(field: Field | Bore) -> tuple[float, ...]:
    """Makes a field known to this process's collisions, for as long as it lives.

    Args:
        field: wall that touches from its inside.

    Returns:
        What the `geom_user` of its carrier is to hold.
    """
    from cathsim_dmc.collision.table import BORE, LUMEN, MARK, PART

    digest = _digest(field)
    parts = [int.from_bytes(digest[3 * k : 3 * k + 3], "big") % PART for k in range(3)]
    parts[0] = parts[0] or 1  # a key of 0 is none
    kind = BORE if isinstance(field, Bore) else LUMEN
    low, high = field.box
    _get_table().put(_key(parts), kind, (low + high) / 2, field.arrays)
    return (MARK, *map(float, parts))


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


def check(model: mujoco.MjModel) -> None:
    """Refuses a model with carriers that cannot do what they are for.

    Raises:
        ValueError: if a carrier's field is unknown, or something other than capsules
            and spheres can touch it; names the geoms.
    """
    from cathsim_dmc.collision.table import MARK, USER

    if model.nuser_geom < USER:
        return
    for geom in np.flatnonzero(model.geom_user[:, 0] == MARK):
        name = model.geom(geom).name or geom
        parts = [int(part) for part in model.geom_user[geom, 1:USER]]
        if not _get_table().knows(_key(parts)):
            raise ValueError(
                f"geom {name!r} carries a field that this process does not know; "
                "register it, or load the task anew"
            )
        touching = (model.geom_contype & model.geom_conaffinity[geom]) | (
            model.geom_conaffinity & model.geom_contype[geom]
        )
        body = model.geom_bodyid[geom]
        wrong = (touching != 0) & ~np.isin(model.geom_type, (_CAPSULE, _SPHERE))
        wrong &= model.geom_bodyid != body
        if wrong.any() or model.geom_type[geom] != _BOX:
            other = np.flatnonzero(wrong)[0] if wrong.any() else geom
            raise ValueError(
                f"geom {model.geom(other).name or other!r} cannot touch the field that "
                f"geom {name!r} carries; a carrier is a box that capsules and spheres "
                "touch: change its type, or its contype and conaffinity"
            )


def springs(
    model: mujoco.MjModel, geoms: np.ndarray, stiffness: float, relaxation: float
) -> np.ndarray:
    """`geom_solref` that makes contacts with the world springs of one stiffness.

    MuJoCo's contact is a spring in N/m only for one inverse inertia: at a depth r and
    with an impedance d that does not change with it, its force at rest is
    |solref₀| r / ((1 - d) A), A the inverse weight of the link, `body_invweight0`.

    Args:
        model: compiled, with the masses that count.
        geoms: (n,) numbers of the geoms, each on a body of its own.
        stiffness: N/m.
        relaxation: s, within which a contact without load returns: damping over
            stiffness.

    Returns:
        (n, 2), for an impedance of `IMPEDANCE`, see `solimp`.
    """
    weight = model.body_invweight0[model.geom_bodyid[geoms], 0]
    scaled = stiffness * (1 - IMPEDANCE) * weight
    return -np.stack([scaled, relaxation * scaled], axis=-1)


def solimp() -> tuple[float, ...]:
    """`geom_solimp` of a contact whose impedance does not change with its depth."""
    return (IMPEDANCE, IMPEDANCE, 1e-3, 0.5, 2)


def _key(parts: Sequence[int]) -> int:
    from cathsim_dmc.collision.table import PART

    return (parts[0] * PART + parts[1]) * PART + parts[2]


def _digest(field: Field | Bore) -> bytes:
    if isinstance(field, Field):
        return field.digest
    import hashlib

    return hashlib.sha256(field.arrays[0].tobytes()).digest()


def _mujoco_library() -> ctypes.CDLL:
    folder = Path(mujoco.__path__[0])
    for path in sorted(folder.glob("*mujoco*")):
        if path.suffix != ".py" and any(
            part in path.name for part in (".so", ".dylib", ".dll")
        ):
            return ctypes.CDLL(str(path))
    raise RuntimeError(f"no MuJoCo library in {folder}; install the wheel of mujoco")
