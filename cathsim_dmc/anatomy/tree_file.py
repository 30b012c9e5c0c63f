"""Vessel trees in JSON; docs/anatomy_files.md describes the format."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cathsim_dmc import bounds, files
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.builder import VesselPlace
from cathsim_dmc.anatomy.curves import Curve

FORMAT = "cathsim-vessel-tree"
FORMAT_VERSION = 1
_MM = 1e-3
_FRAMES = {"LPS": (1.0, 1.0, 1.0), "RAS": (-1.0, -1.0, 1.0)}  # factors to LPS
_FARTHEST, _RADII = 2000.0, (0.3, 60.0)  # mm; values outside have another unit
_MOST_POINTS = 20_000
_WAYS = {  # keys that give the place of inlets and goals
    "inlets": ("end", "arc_length_mm"),
    "goals": ("arc_length_mm", "past_ostium_mm", "position_mm"),
}


@dataclass(frozen=True, eq=False)
class TreeFile:
    """Content of a tree file; lengths in metres, frame LPS."""

    name: str
    curves: Mapping[str, Curve]  # the root first
    inlets: Mapping[str, VesselPlace]  # by access; the first is the default
    goals: Mapping[str, VesselPlace] | None = None  # None for one in each branch

    def build(self, access: str | None = None) -> Anatomy:
        """Anatomy with the inlet of `access`; by default the first one."""
        if access is None:
            access = next(iter(self.inlets))
        inlet = self.inlets[bounds.choice("access", access, self.inlets)]
        return Anatomy.from_tree(self.curves, self.name, inlet=inlet, goals=self.goals)


def read_tree(path: str | os.PathLike[str]) -> TreeFile:
    """Read a tree file; ValueError names an invalid entry, OSError a missing file."""
    files.require_source(path, "a tree of centrelines (docs/anatomy_files.md)")
    try:
        content = json.loads(files.read_text(path))
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"{path} cannot be read as JSON in UTF-8: {error}. It must be a tree of "
            "centrelines (docs/anatomy_files.md)."
        ) from error
    try:
        return parse_tree(content)
    except (ValueError, RecursionError) as error:  # of its entries
        raise ValueError(f"{path}: {error}") from error


def parse_tree(content: Any) -> TreeFile:
    """Tree file from parsed JSON; ValueError names an invalid entry."""
    needed = ("format", "version", "name", "units", "frame", "vessels")
    _entries("the file", content, needed, ("note", "inlets", "goals"))
    fixed = {"format": FORMAT, "version": FORMAT_VERSION}
    for key, value in {**fixed, "units": "mm"}.items():
        if content[key] is True or content[key] != value:  # True equals 1
            bounds.refuse(key, content[key], repr(value))
    signs = np.array(_FRAMES[bounds.choice("frame", content["frame"], _FRAMES)])
    curves: dict[str, Curve] = {}
    for key, entry in _parts(content, "vessels"):
        curves[key] = _curve(f"vessel {key!r}", entry, list(curves))
    if not curves:
        bounds.refuse("vessels", {}, "a mapping with at least one vessel")
    root = next(iter(curves))
    inlets, goals = (
        {
            key: _place(f"{kind[:-1]} {key!r}", entry, ways, curves)
            for key, entry in _parts(content, kind)
        }
        for kind, ways in _WAYS.items()
    )
    bounds.instance("note", content.get("note", ""), str)
    curves = {k: replace(one, points=signs * one.points) for k, one in curves.items()}
    for key, place in goals.items():
        if place.position is not None:
            goals[key] = replace(place, position=signs * place.position)
    return TreeFile(
        bounds.text("name", content["name"]),
        curves,
        inlets or {"first": VesselPlace(root)},
        goals if "goals" in content else None,
    )


def _parts(content: Mapping[str, Any], name: str):
    return bounds.instance(name, content.get(name, {}), dict).items()


def _entries(name: str, value: Any, needed: tuple, more: tuple = ()) -> None:
    """Check that an object has the entries it needs and no others."""
    bounds.mapping(name, value, (*needed, *more))
    if missing := set(needed) - set(value):
        raise ValueError(f"{name} lacks {', '.join(sorted(missing))}.")


def _curve(where: str, entry: Any, before: list[str]) -> Curve:
    _entries(where, entry, ("parent", "points_mm", "radii_mm"))
    parent = entry["parent"]
    if parent not in (before or [None]):
        wanted = f"one of those before it: {', '.join(before)}" if before else "null"
        bounds.refuse(f"parent of {where}", parent, wanted)
    points = _numbers(f"{where}: points_mm", entry["points_mm"], 3)
    radii = _numbers(f"{where}: radii_mm", entry["radii_mm"], 1)[:, 0]
    far, (low, high) = np.abs(points).max(), _RADII
    if far > _FARTHEST or radii.min() < low or radii.max() > high:
        raise ValueError(
            f"{where} has coordinates up to {far:g} and radii from {radii.min():g} to "
            f"{radii.max():g}; allowed are {_FARTHEST:g}, and {low:g} to {high:g}: are "
            "these millimetres, and no diameters?"
        )
    curve = {"points": points * _MM, "radii": radii * _MM, "parent": parent}
    return bounds.made(where, curve, Curve)


def _numbers(name: str, value: Any, columns: int) -> np.ndarray:
    if not isinstance(value, list) or not 0 < len(value) <= _MOST_POINTS:
        bounds.refuse(name, value, f"a list of 1 to {_MOST_POINTS} entries")
    rows = [[row] if columns == 1 else row for row in value]
    return np.array(
        [bounds.vector(f"{name}[{k}]", row, columns) for k, row in enumerate(rows)]
    )


def _place(
    where: str, entry: Any, ways: tuple, curves: Mapping[str, Curve]
) -> VesselPlace:
    _entries(where, entry, ("vessel",), ways)
    given = [way for way in ways if way in entry]
    if len(given) != 1:
        raise ValueError(f"{where}: give one of {', '.join(ways)}.")
    vessel = bounds.choice(f"vessel of {where}", entry["vessel"], curves)
    way, name = given[0], f"{where}: {given[0]}"
    value = entry[way]
    if way == "end":
        ends = {"first": 0.0, "last": math.inf}
        if curves[vessel].parent is not None:
            del ends["first"]
        return VesselPlace(vessel, ends[bounds.choice(name, value, ends)])
    if way == "position_mm":
        position = np.array(bounds.vector(name, value, 3)) * _MM
        return VesselPlace(vessel, position=position)
    length = bounds.number(name, value, 0.0, _FARTHEST, "mm") * _MM
    return VesselPlace(vessel, length, way == "past_ostium_mm")
