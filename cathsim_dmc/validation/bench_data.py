"""Guidewires measured in a phantom, read from a folder: mesh, wires and landmarks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.parts import End, Inlet, Surface
from cathsim_dmc.anatomy.scan.mesh import read_triangles
from cathsim_dmc.anatomy.scan.places import cut_open
from cathsim_dmc.anatomy.scan.topology import merged, used
from cathsim_dmc.recording.geometry import along

MESH, WIRES = "phantom.stl", "wires.json"
KINDS = ("straight", "angled")
ARCH = "arch"  # tip region of a wire whose tip is in no branch
# Total turning angle of a wire from the entry to the tip, rad, above which it is folded
# or buckled: a wire that follows an arch into a branch turns by less.
FOLDED = np.radians(150.0)
_CHORD = 6e-3  # m, over which directions are taken
_STEP = 1e-3  # m
_WITHIN = 6e-3  # m past an ostium, beyond which an operator sees a tip in the branch
_AROUND = 3e-3  # m, tolerance around a branch: landmarks are coarse
_CUTS = (0.0, 0.5e-3, 1e-3, 1.5e-3, 2e-3, 3e-3)  # m into the lumen, tried in turn
_SIDES = {"superior": "inferior", "left_about": "right", "posterior_about": "front"}


@dataclass(frozen=True, eq=False)
class Wire:
    """A measured guidewire."""

    name: str  # run and frame
    kind: str  # one of `KINDS`
    vessel: str  # vessel of the tip
    recommended: bool  # whether the comparison uses it
    points: np.ndarray  # (n, 3) m, from the entry to the tip
    direction: np.ndarray  # (3,) unit vector towards the tip, at the entry

    @property
    def length(self) -> float:
        """Inserted length, m."""
        return float(arc_lengths(self.points)[-1])

    @property
    def folded(self) -> bool:
        """Whether the wire turns by more than `FOLDED`: folded back or buckled."""
        line = along(self.points, np.arange(0.0, self.length, _CHORD))
        steps = np.diff(line, axis=0)
        steps /= np.linalg.norm(steps, axis=1)[:, None]
        cosine = np.clip(np.vecdot(steps[1:], steps[:-1]), -1.0, 1.0)
        return bool(np.arccos(cosine).sum() > FOLDED)


class Branch(NamedTuple):
    """A branch of the phantom, given by landmarks."""

    pieces: np.ndarray  # (n, 2, 3) m, ends of straight pieces, first the ostium
    radius: float  # m

    def has(self, point: np.ndarray) -> bool:
        """Whether a place (3,), m, is in the branch, `_WITHIN` past its ostium."""
        start, way = self.pieces[:, 0], np.diff(self.pieces, axis=1)[:, 0]
        length = np.linalg.norm(way, axis=1)
        along_it = np.vecdot(point - start, way) / length
        foot = start + (along_it / length)[:, None] * way
        near = np.linalg.norm(point - foot, axis=1) < 3.0 * self.radius + _AROUND
        first = np.where(np.arange(len(length)) == 0, _WITHIN, 0.0)
        inside = (first < along_it) & (along_it < length + _AROUND)
        return bool((near & inside).any())


@dataclass(frozen=True, eq=False)
class Bench:
    """A phantom and the wires that were measured in it."""

    surface: Surface  # of the lumen, m, cut off and flat at the entry
    entry: End  # where the wires enter; its direction points out
    ends: Mapping[str, np.ndarray]  # (3,) m, end of each vessel by tip region
    branches: Mapping[str, Branch]
    down: Mapping[str, np.ndarray]  # (3,) unit directions of gravity by name
    wires: tuple[Wire, ...]  # as measured

    def is_astray(self, wire: Wire, tip: np.ndarray) -> bool:
        """Whether a tip (3,), m, is in a branch that the measured one is not in."""
        return any(
            one.has(tip) for name, one in self.branches.items() if name != wire.vessel
        )

    def field(self, scale: float = 1.0) -> Field:
        """Field of the lumen, scaled about the entry."""
        middle, vertices = self.entry.position, self.surface.vertices
        surface = Surface(middle + scale * (vertices - middle), self.surface.faces)
        return Field.of(surface, [self.entry])


def distances(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Distances (k,), m, of two lines (n, 3), (m, 3), m, at each mm of arc length."""
    length = min(arc_lengths(one)[-1], arc_lengths(other)[-1])
    at = np.arange(0.0, length + 1e-9, _STEP)
    return np.linalg.norm(along(one, at) - along(other, at), axis=1)


def read(folder: str | Path) -> Bench:
    """Reads a folder of measured wires.

    The folder has `MESH` (mm) and `WIRES`, which holds "wires", a list of objects with
    "run", "frame", "wire" (one of `KINDS`), "tip_region", "recommended",
    "inserted_length_mm", "entry_point_mm", "entry_direction" and "centreline_mm",
    points from the tip on and beyond the entry; and "landmarks": "entry" (point_mm,
    outward_normal, radius_mm), the far end "ascending_aorta_root_mm", the
    "patient_axes", and branches (ostium_mm, radius_mm, end_mm or fork_mm, and what
    ends in _end_mm beyond a fork).

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if one is not as stated.
    """
    folder = Path(folder)
    for path in (folder / MESH, folder / WIRES):
        if not path.is_file():
            raise FileNotFoundError(
                f"no file {path}; give a folder with {MESH} and {WIRES}"
            )
    vertices, faces = read_triangles(folder / MESH)
    vertices, faces = merged(vertices / 1e3, faces)
    try:
        found = json.loads((folder / WIRES).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"{folder / WIRES} cannot be read as JSON in UTF-8: {error}; write it "
            "again, as `bench_data.read` describes"
        ) from error
    try:
        marks, rows = found["landmarks"], found["wires"]
        entry = marks["entry"]
        where, out = _vector(entry, "point_mm") / 1e3, _unit(entry, "outward_normal")
        radius = 1e-3 * float(entry["radius_mm"])
        surface, where = _opened(vertices, faces, Inlet("entry", where, -out, radius))
        ends = {ARCH: _vector(marks, "ascending_aorta_root_mm") / 1e3}
        branches = {}
        for name, mark in marks.items():
            if isinstance(mark, Mapping) and "ostium_mm" in mark:
                end = "end_mm" if "end_mm" in mark else "fork_mm"
                ends[name] = _vector(mark, end) / 1e3
                branches[name] = _branch(mark, ends[name])
        # Directions to the six sides of the patient, and zero.
        down = {"none": np.zeros(3)}
        for key, opposite in _SIDES.items():
            axis = _unit(marks["patient_axes"], key)
            down[key.removesuffix("_about")], down[opposite] = axis, -axis
        wires = tuple(_wire(row, ends) for row in rows)
    except (KeyError, TypeError) as error:
        raise ValueError(
            f"{folder / WIRES} is not as `bench_data.read` describes: {error!r}"
        ) from error
    except ValueError as error:
        raise ValueError(f"{folder / WIRES}: {error}") from error
    end = End("entry", where, out, 2.0 * radius, True)
    return Bench(surface, end, ends, branches, down, wires)


def _branch(mark: Mapping[str, Any], end: np.ndarray) -> Branch:
    beyond = [_vector(mark, key) / 1e3 for key in mark if key.endswith("_end_mm")]
    pieces = [(_vector(mark, "ostium_mm") / 1e3, end), *((end, one) for one in beyond)]
    return Branch(np.array(pieces), 1e-3 * float(mark["radius_mm"]))


def _opened(
    vertices: np.ndarray, faces: np.ndarray, inlet: Inlet
) -> tuple[Surface, np.ndarray]:
    """The surface cut open at the inlet, and the place (3,), m, of the cut.

    The cut is farther in if the end is uneven.
    """
    volume = Surface(vertices, faces).volume
    for inwards in _CUTS:
        place = inlet.position + inwards * inlet.direction
        try:
            at = replace(inlet, position=place)
            points, shell, cap = cut_open(vertices, faces, at)
        except ValueError:
            continue
        corners, triangles = used(points, np.concatenate([shell, cap]))
        surface = Surface(corners, triangles)
        if surface.volume > 0.5 * volume:
            return surface, place
    raise ValueError(
        f"{MESH} cannot be opened at the entry {np.round(1e3 * inlet.position, 1)} mm "
        f"nor up to {1e3 * _CUTS[-1]:g} mm farther in; give a point in the lumen near "
        "its end, and a normal out of it"
    )


def _wire(row: Mapping[str, Any], ends: Mapping[str, Any]) -> Wire:
    name = f"{row['run']}, {row['frame']}"
    points = np.array(row["centreline_mm"], dtype=np.float64) / 1e3
    length = 1e-3 * float(row["inserted_length_mm"])
    inside = along(points, np.append(np.arange(0.0, length, _STEP), length))[::-1]
    inside[0] = _vector(row, "entry_point_mm") / 1e3
    return Wire(
        name,
        bounds.choice(f"wire of {name}", row["wire"], KINDS),
        bounds.choice(f"tip_region of {name}", row["tip_region"], ends),
        bounds.switch(f"recommended of {name}", row["recommended"]),
        inside,
        _unit(row, "entry_direction"),
    )


def _vector(found: Mapping[str, Any], key: str) -> np.ndarray:
    return np.array(bounds.vector(key, found[key], 3))


def _unit(found: Mapping[str, Any], key: str) -> np.ndarray:
    vector = _vector(found, key)
    return vector / np.linalg.norm(vector)
