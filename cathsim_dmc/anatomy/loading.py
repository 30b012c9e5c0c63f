"""Checks of a saved anatomy: types, shapes, finite values, plausible places."""

from __future__ import annotations

import io
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import bounds, files

EXTENT = 2.5  # m, diagonal of the box around an anatomy
AROUND = 50e-3  # m, of places outside the lumen's box
OFF = 5e-3  # m, of inlet and goals off their centrelines, beside the radius
WIDEST = 0.1  # m, radius of a vessel; the largest aneurysms have half of it
LARGEST_TEXT = 20_000_000  # bytes of anatomy.json
LARGEST_ARRAYS = 2_000_000_000  # bytes of all arrays, unpacked


def _vector(name: str, value: Any) -> None:
    bounds.vector(name, value, 3)


def _parent(name: str, value: Any) -> None:
    if value is not None:
        bounds.text(name, value)


_NUMBER, _TEXT = bounds.number, bounds.text
_FIELDS: dict[str, dict[str, Callable[[str, Any], Any]]] = {
    "vessels": {"name": _TEXT, "parent": _parent, "ostium": _NUMBER},
    "inlet": {
        "vessel": _TEXT,
        "position": _vector,
        "direction": _vector,
        "radius": _NUMBER,
    },
    "goals": {
        "name": _TEXT,
        "vessel": _TEXT,
        "position": _vector,
        "arc_length": _NUMBER,
    },
    "ends": {
        "vessel": _TEXT,
        "position": _vector,
        "direction": _vector,
        "radius": _NUMBER,
        "open": bounds.switch,
    },
}


def read_regular(path: Path, most: int) -> bytes:
    """Bytes of a regular file, not of one that a symbolic link leads to.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is a link or no file, or larger than ``most`` bytes.
    """
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except FileNotFoundError:
        raise
    except OSError as error:
        if path.is_symlink():
            raise ValueError(
                f"{path} is a symbolic link, which is not followed; put the file "
                "itself there."
            ) from error
        raise
    with os.fdopen(handle, "rb") as stream:
        state = os.fstat(stream.fileno())
        if not stat.S_ISREG(state.st_mode):
            raise ValueError(f"{path} is no regular file.")
        if state.st_size > most:
            raise ValueError(
                f"{path} has {state.st_size:,} bytes, more than the {most:,} that an "
                "anatomy may have."
            )
        return stream.read()


def read_arrays(data: bytes, path: Path) -> dict[str, np.ndarray]:
    """Arrays of an npz file, nothing unpickled.

    Raises:
        ValueError: if it is damaged or its arrays would fill the memory.
    """
    try:
        return files.read_arrays(io.BytesIO(data), LARGEST_ARRAYS)
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}.") from error


def check_description(description: dict[str, Any], path: Path) -> None:
    """Checks the entries of ``anatomy.json``; ValueError names a wrong one."""
    for key, allowed in (("units", "m"), ("frame", "LPS")):
        if description.get(key) != allowed:
            raise ValueError(
                f"{path}: {key} is {description.get(key)!r}; an anatomy is saved in "
                f"{allowed!r} only. Write it again with Anatomy.save."
            )
    bounds.text(f"{path}: name", description.get("name"))
    bounds.switch(f"{path}: scanned", description.get("scanned"))
    for key, fields in _FIELDS.items():
        entries = description.get(key)
        if key == "inlet":
            entries = [entries]
        if not isinstance(entries, list):
            raise ValueError(f"{path}: {key} is {bounds.shown(entries)}; give a list.")
        for number, entry in enumerate(entries):
            where = key if key == "inlet" else f"{key}[{number}]"
            if not isinstance(entry, dict) or set(entry) != set(fields):
                raise ValueError(
                    f"{path}: {where} is {bounds.shown(entry)}; give an object with "
                    f"{', '.join(fields)}."
                )
            for name, check in fields.items():
                check(f"{path}: {where}.{name}", entry[name])
    for key in ("vessels", "goals"):
        names = [entry["name"] for entry in description[key]]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"{path}: {key} has {twice!r} twice.")


def check_arrays(arrays: dict[str, np.ndarray], vessels: int, path: Path) -> None:
    """Checks shapes, types and values of the arrays of an anatomy with ``vessels``."""
    _array(arrays, "surface_vertices", "f", (-1, 3), path)
    faces = _array(arrays, "surface_faces", "iu", (-1, 3), path)
    vertices = arrays["surface_vertices"]
    if not len(faces) or not len(vertices):
        raise ValueError(f"{path}: the surface has no triangles.")
    for index in range(vessels):
        points = _array(arrays, f"vessel_{index}_points", "f", (-1, 3), path)
        _array(arrays, f"vessel_{index}_radii", "f", (len(points),), path)


def check_places(anatomy: Any, path: Path) -> None:
    """Checks that inlet, goals and vessels lie where the lumen is."""
    vertices = anatomy.surface.vertices
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = float(np.linalg.norm(high - low))
    if not 1e-3 <= size <= EXTENT or np.abs(vertices).max() > bounds.FAR:
        raise ValueError(
            f"{path}: the surface is {size:.3g} m across and reaches "
            f"{np.abs(vertices).max():.3g} m from the origin (allowed 0.001 to "
            f"{EXTENT:g} m, {bounds.FAR:g} m); its unit is not the metre."
        )

    def near(points: np.ndarray, what: str) -> None:
        off = np.maximum(low - points, points - high).max()
        if off > AROUND:
            raise ValueError(
                f"{path}: {what} lies {off:.3g} m outside the box of the surface "
                f"(at most {AROUND:g} m)."
            )

    for vessel in anatomy.tree.vessels.values():
        near(vessel.centreline.points, f"vessel {vessel.name!r}")
        widest = float(vessel.centreline.radii.max())
        if widest > WIDEST:
            raise ValueError(
                f"{path}: vessel {vessel.name!r} has a radius of {widest:.3g} m (at "
                f"most {WIDEST:g} m); its unit is not the metre."
            )
    places = {"inlet": anatomy.inlet}
    places |= {f"goal {name!r}": goal for name, goal in anatomy.goals.items()}
    for what, place in places.items():
        line = anatomy.tree.vessel(place.vessel).centreline
        found = line.project(place.position)
        gap = float(found.distance - found.radius)
        if gap > OFF:
            raise ValueError(
                f"{path}: {what} lies {gap:.3g} m outside the vessel "
                f"{place.vessel!r} that it is in (at most {OFF:g} m)."
            )
    for goal in anatomy.goals.values():
        length = anatomy.tree.vessel(goal.vessel).centreline.length
        if not 0.0 <= goal.arc_length <= length + OFF:
            raise ValueError(
                f"{path}: goal {goal.name!r} has the arc length {goal.arc_length:.3g} "
                f"m; its vessel has 0 to {length:.3g} m."
            )
    for end in anatomy.ends:
        near(end.position[None], f"an end of {end.vessel!r}")


def _array(
    arrays: dict[str, np.ndarray],
    name: str,
    kinds: str,
    shape: tuple[int, ...],
    path: Path,
) -> np.ndarray:
    """The array of a name, of one of the numpy ``kinds``; -1 stands for any size."""
    if name not in arrays:
        raise ValueError(f"{path} lacks the array {name!r}.")
    return bounds.array(f"{path}: {name}", arrays[name], kinds, shape)
