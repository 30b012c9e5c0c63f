"""Vessel trees in JSON: centrelines, inlets and goals in millimetres.

```json
{
  "format": "cathsim-vessel-tree", "version": 1,
  "name": "arch", "units": "mm", "frame": "LPS", "note": "where from",
  "vessels": {
    "aorta": {"parent": null, "points_mm": [[0, 0, 0], ...], "radii_mm": [12.6, ...]},
    "bca": {"parent": "aorta", "points_mm": [...], "radii_mm": [...]}
  },
  "inlets": {
    "ascending": {"vessel": "aorta", "end": "first"},
    "descending": {"vessel": "aorta", "arc_length_mm": 180.0}
  },
  "goals": {
    "bca": {"vessel": "bca", "past_ostium_mm": 27.0},
    "other": {"vessel": "bca", "position_mm": [3.0, 11.0, 90.0]}
  }
}
```

The first vessel is the root; parents stand before their children. `note`, `inlets`
and `goals` may be left out.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.builder import VesselPlace
from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.curves import Curve, smooth_tree

FORMAT = "cathsim-vessel-tree"
FORMAT_VERSION = 1
_FRAMES = {"LPS": (1.0, 1.0, 1.0), "RAS": (-1.0, -1.0, 1.0)}
_MM = 1e-3
# A coordinate beyond this, mm, or a radius outside the range is another unit.
_FARTHEST = 2000.0
_RADII = (0.3, 60.0)
_MOST_POINTS = 20_000


@dataclass(frozen=True)
class InletPlace:
    """Where a device enters: a free end of a vessel, or a place to cut it at."""

    vessel: str
    end: str | None = None
    arc_length: float | None = None

    def place(self, tree: VesselTree) -> VesselPlace:
        """The same as an arc length on the built centreline."""
        arc = self.arc_length
        if arc is None:
            length = tree.vessel(self.vessel).centreline.length
            arc = 0.0 if self.end == "first" else length
        return VesselPlace(self.vessel, arc_length=arc)


@dataclass(frozen=True, eq=False)
class TreeFile:
    """Content of a tree file; lengths in metres, frame LPS.

    Attributes:
        name: of the anatomy.
        curves: centrelines by name, the root first.
        inlets: by name of the access; the first is the usual one.
        goals: by name; None for one in each branch.
        note: where the figures come from.
    """

    name: str
    curves: Mapping[str, Curve]
    inlets: Mapping[str, InletPlace]
    goals: Mapping[str, VesselPlace] | None = None
    note: str = field(default="", repr=False)

    def tree(self) -> VesselTree:
        """Smooth vessel tree through the centrelines."""
        return smooth_tree(self.curves)

    def build(self, access: str | None = None) -> Anatomy:
        """Anatomy that is entered by `access`, the first inlet if None.

        Raises:
            ValueError: if there is no such inlet, or the tree gives no valid lumen.
        """
        if access is None:
            access = next(iter(self.inlets))
        if access not in self.inlets:
            raise ValueError(
                f"access is {access!r}; choose one of {', '.join(self.inlets)}."
            )
        tree = self.tree()
        inlet = self.inlets[access].place(tree)
        return Anatomy.from_tree(tree, self.name, inlet=inlet, goals=self.goals)


def read_tree(path: str | os.PathLike[str]) -> TreeFile:
    """Read a tree file.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is damaged or anything in it is not as described; the
            message names the entry.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; give a vessel tree in JSON.")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON: {error}") from error
    try:
        return parse_tree(content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def parse_tree(content: Any) -> TreeFile:
    """Tree file from what JSON holds; see the module for the format.

    Raises:
        ValueError: names the entry that is wrong and what is allowed.
    """
    _entries(
        content,
        "the file",
        {"format", "version", "name", "units", "frame", "vessels"},
        {"note", "inlets", "goals"},
    )
    if content["format"] != FORMAT or content["version"] != FORMAT_VERSION:
        raise ValueError(
            f"format {content['format']!r}, version {content['version']!r}; this "
            f"reads {FORMAT!r}, version {FORMAT_VERSION}."
        )
    if content["units"] != "mm":
        raise ValueError(f"units is {content['units']!r}; give lengths in 'mm'.")
    name = content["name"]
    if not isinstance(name, str) or not name:
        raise ValueError(f"name is {name!r}; give a word.")
    frame = content["frame"]
    if not isinstance(frame, str) or frame not in _FRAMES:
        raise ValueError(f"frame is {frame!r}; choose one of {', '.join(_FRAMES)}.")
    flip = np.array(_FRAMES[frame])
    vessels = content["vessels"]
    if not isinstance(vessels, dict) or not vessels:
        raise ValueError("vessels is empty or no object; give name: centreline.")
    curves = {key: _curve(key, entry, flip) for key, entry in vessels.items()}
    _check_parents(curves)
    root = next(iter(curves))
    inlets = {
        key: _inlet(key, entry, curves, root)
        for key, entry in _object(content.get("inlets", {}), "inlets").items()
    } or {"first": InletPlace(root, end="first")}
    goals = content.get("goals")
    if goals is not None:
        goals = {
            key: _goal(key, entry, curves, flip)
            for key, entry in _object(goals, "goals").items()
        }
    note = content.get("note", "")
    if not isinstance(note, str):
        raise ValueError("note is no text.")
    return TreeFile(name, curves, inlets, goals, note)


def _object(value: Any, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{name} is {type(value).__name__}; give an object.")
    return value


def _entries(value: Any, name: str, needed: set[str], allowed: set[str]) -> None:
    """Check that an object has the entries it needs and no others."""
    keys = set(_object(value, name))
    if missing := needed - keys:
        raise ValueError(f"{name} lacks {', '.join(sorted(missing))}.")
    if unknown := keys - needed - allowed:
        raise ValueError(
            f"{name} has unknown entries {', '.join(sorted(unknown))}; there are "
            f"{', '.join(sorted(needed | allowed))}."
        )


def _numbers(value: Any, name: str, columns: int | None) -> np.ndarray:
    """Finite numbers (n,) or (n, columns)."""
    shape = "numbers" if columns is None else f"rows of {columns} numbers"
    if not isinstance(value, list) or not value or len(value) > _MOST_POINTS:
        raise ValueError(f"{name}: give 1 to {_MOST_POINTS} {shape}.")
    for index, row in enumerate(value):
        cells = [row] if columns is None else row
        if (
            not isinstance(cells, list)
            or (columns is not None and len(cells) != columns)
            or not all(bounds.is_number(cell) for cell in cells)
        ):
            raise ValueError(f"{name}[{index}] is {row!r}; give {shape}.")
    return np.array(value, dtype=np.float64)


def _length(value: Any, name: str) -> float:
    return bounds.number(name, value, 0.0, _FARTHEST, "mm") * _MM


def _curve(name: str, entry: Any, flip: np.ndarray) -> Curve:
    where = f"vessel {name!r}"
    _entries(entry, where, {"parent", "points_mm", "radii_mm"}, set())
    parent = entry["parent"]
    if parent is not None and not isinstance(parent, str):
        raise ValueError(f"{where}: parent is {parent!r}; give a name or null.")
    points = _numbers(entry["points_mm"], f"{where}: points_mm", 3)
    radii = _numbers(entry["radii_mm"], f"{where}: radii_mm", None)
    if len(points) != len(radii) or len(points) < 2:
        raise ValueError(
            f"{where} has {len(points)} points and {len(radii)} radii; give at least "
            "two points and one radius for each."
        )
    if np.abs(points).max() > _FARTHEST:
        raise ValueError(
            f"{where} has a coordinate of {np.abs(points).max():g} mm; allowed is "
            f"{_FARTHEST:g}. Are these millimetres?"
        )
    low, high = _RADII
    if radii.min() < low or radii.max() > high:
        raise ValueError(
            f"{where} has radii from {radii.min():g} to {radii.max():g} mm; allowed is "
            f"{low:g} to {high:g} mm. Are these millimetres, and no diameters?"
        )
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if steps.min() < 1e-3:
        index = int(steps.argmin())
        raise ValueError(f"{where}: points {index} and {index + 1} coincide; drop one.")
    return Curve(points * flip * _MM, radii * _MM, parent)


def _check_parents(curves: Mapping[str, Curve]) -> None:
    seen: list[str] = []
    for name, curve in curves.items():
        if (curve.parent is None) != (not seen):
            raise ValueError(
                f"vessel {name!r} has parent {curve.parent!r}; the first vessel, and "
                "only the first, has null."
            )
        if curve.parent is not None and curve.parent not in seen:
            raise ValueError(
                f"parent {curve.parent!r} of vessel {name!r} is not among those before "
                f"it: {', '.join(seen)}."
            )
        seen.append(name)


def _vessel(entry: dict[str, Any], where: str, curves: Mapping[str, Curve]) -> str:
    vessel = entry["vessel"]
    if not isinstance(vessel, str) or vessel not in curves:
        raise ValueError(
            f"{where}: no vessel {vessel!r}; there are {', '.join(curves)}."
        )
    return vessel


def _inlet(name: str, entry: Any, curves: Mapping[str, Curve], root: str) -> InletPlace:
    where = f"inlet {name!r}"
    _entries(entry, where, {"vessel"}, {"end", "arc_length_mm"})
    vessel = _vessel(entry, where, curves)
    if ("end" in entry) == ("arc_length_mm" in entry):
        raise ValueError(f"{where}: give one of end and arc_length_mm.")
    if "arc_length_mm" in entry:
        arc = _length(entry["arc_length_mm"], f"{where}: arc_length_mm")
        return InletPlace(vessel, arc_length=arc)
    ends = ("first", "last") if vessel == root else ("last",)
    if entry["end"] not in ends:
        raise ValueError(
            f"{where}: end is {entry['end']!r}; {vessel!r} has {', '.join(ends)}."
        )
    return InletPlace(vessel, end=entry["end"])


def _goal(
    name: str, entry: Any, curves: Mapping[str, Curve], flip: np.ndarray
) -> VesselPlace:
    where = f"goal {name!r}"
    ways = {"arc_length_mm", "past_ostium_mm", "position_mm"}
    _entries(entry, where, {"vessel"}, ways)
    vessel = _vessel(entry, where, curves)
    given = ways & set(entry)
    if len(given) != 1:
        raise ValueError(f"{where}: give one of {', '.join(sorted(ways))}.")
    (way,) = given
    if way == "position_mm":
        (position,) = _numbers([entry[way]], f"{where}: {way}", 3)
        return VesselPlace(vessel, position=position * flip * _MM)
    length = _length(entry[way], f"{where}: {way}")
    if way == "past_ostium_mm":
        return VesselPlace(vessel, past_ostium=length)
    return VesselPlace(vessel, arc_length=length)
