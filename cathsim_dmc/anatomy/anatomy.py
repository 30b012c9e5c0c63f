"""Anatomies for simulation: lumen, inlet and goals, in metres, patient frame LPS."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import bounds, files
from cathsim_dmc.anatomy import builder, field_cache
from cathsim_dmc.anatomy.builder import VesselPlace
from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.circulation import Circulation
from cathsim_dmc.anatomy.curves import Curve, smooth_tree
from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.motion import Motion
from cathsim_dmc.anatomy.parts import End, FileFrame, Goal, Inlet, Surface

_FORMAT = {"format": "cathsim-anatomy", "version": 3, "units": "m", "frame": "LPS"}
_FILE = "anatomy.npz"
_LEAST_ROOM = 0.5e-3  # m, around a goal
# Largest difference of a goal's arc length from that of its position, m.
_MOST_GAP = 2e-3


@dataclass(frozen=True, eq=False, repr=False)
class Anatomy:
    """An anatomy ready for simulation.

    Attributes:
        name: name of the anatomy.
        tree: centrelines and radii.
        inlet: where the device enters.
        goals: places to reach, by name.
        ends: flat ends of the lumen, open or capped.
        scan: closed surface of the imported lumen; None if the lumen is the union of
            the tree's tubes.
        file: unit and frame of the imported file; None for metres in LPS.
    """

    name: str
    tree: VesselTree
    inlet: Inlet
    goals: Mapping[str, Goal]
    ends: tuple[End, ...] = ()
    scan: Surface | None = None
    file: FileFrame | None = None

    def __post_init__(self) -> None:
        bounds.text("name", self.name)
        for key, goal in self.goals.items():
            if key != goal.name:
                raise ValueError(f"goal {goal.name!r} is filed under {key!r}.")
            self.tree.vessel(goal.vessel)
        self.tree.vessel(self.inlet.vessel)
        vars(self).update(goals=dict(self.goals), ends=tuple(self.ends))

    def __repr__(self) -> str:
        """Name, vessels, size, goals and inlet in one line."""
        box = 1e3 * np.ptp(self.surface.vertices, axis=0)
        return (
            f"<Anatomy {self.name!r}: vessels {', '.join(self.tree.vessels)}; "
            f"{' x '.join(f'{side:.0f}' for side in box)} mm; goals "
            f"{', '.join(self.goals) or 'none'}; inlet in {self.inlet.vessel}>"
        )

    @classmethod
    def from_tree(
        cls,
        tree: VesselTree | Mapping[str, Curve],
        name: str = "tree",
        *,
        inlet: VesselPlace | None = None,
        goals: Mapping[str, VesselPlace] | None = None,
    ) -> "Anatomy":
        """Build lumen surface, inlet and goals around centrelines.

        Args:
            tree: measured centrelines (`anatomy.curves.Curve`) by name, parents
                before their children; or a finished vessel tree, taken as it is.
            inlet: where the device enters; the lumen behind it is cut off. None for
                the first point of the root.
            goals: places to reach; None for one in each branch, see
                `anatomy.builder.default_goals`.

        Raises:
            ValueError: if the centrelines give no valid lumen, or a place is not on
                its vessel; names the vessel.
        """
        if not isinstance(tree, VesselTree):
            tree = smooth_tree(tree)
        tree, ends, entry, places = builder.placed(tree, inlet, goals)
        return cls(name, tree, entry, places, ends)

    @cached_property
    def lumen(self) -> Field:
        """Signed depth field of the lumen: distance to the wall, m, > 0 inside.

        Built at the first access and cached in `field_cache.cache_folder()`.
        """
        return field_cache.field_of(self.scan or self.tree, self.ends)

    @cached_property
    def digest(self) -> str:
        """Eight hexadecimal digits that identify the lumen."""
        return field_cache.shipped_name(self.scan or self.tree, self.ends)[:8]

    @cached_property
    def surface(self) -> Surface:
        """Closed triangle mesh of the lumen surface."""
        from cathsim_dmc.anatomy.surface import lumen_surface

        return self.scan or lumen_surface(self.tree)

    @cached_property
    def circulation(self) -> Circulation:
        """Distribution of the inflow among the vessels."""
        if self.scan is not None:
            return self.murray_circulation
        return Circulation.of(self.tree)

    @cached_property
    def murray_circulation(self) -> Circulation:
        """Distribution of the inflow among all vessels by Murray's law."""
        return Circulation.of(self.tree, murray=True)

    @cached_property
    def motion(self) -> Motion:
        """Displacement of the anatomy by heart and breathing."""
        return Motion.of(self.lumen.box, self.tree, self.ends, self.circulation)

    def goal(self, name: str) -> Goal:
        """Goal called `name`; ValueError lists the known names."""
        return self.goals[bounds.choice("goal", name, self.goals)]

    def goal_at(self, place: ArrayLike) -> Goal:
        """Goal at a place (3,) of the lumen, in the unit and frame of the file.

        Without a `file` the place is in metres, LPS. Raises ValueError outside the
        lumen.
        """
        given = np.array(bounds.vector("goal", place, 3))
        unit = "m" if self.file is None else self.file.unit
        position = given if self.file is None else self.file.to_lps @ given
        name = "(" + ", ".join(f"{x:g}" for x in given) + f") {unit}"
        self.check_inside(f"goal {name}", position)
        depths = self.tree.depths(position)
        own = []
        for key, vessel in self.tree.vessels.items():
            arc = vessel.centreline.locate(position)
            if vessel.parent is None or arc >= vessel.ostium:
                own.append((float(depths[key]), key, arc))
        _, key, arc = max(own)
        return Goal(name, key, position, arc)

    def check_goal(self, goal: Goal) -> None:
        """Raises ValueError unless a goal is a place of this anatomy."""
        name, at = bounds.instance("goal", goal, Goal).name, goal.position
        place = f"goal {name!r} at {np.round(at, 4).tolist()} m"
        self.check_inside(place, at)
        arc = self.tree.vessel(goal.vessel).centreline.locate(at)
        if abs(arc - goal.arc_length) > _MOST_GAP:
            raise ValueError(
                f"{place} has an arc_length of {1e3 * goal.arc_length:.1f} mm, but the "
                f"place is at {1e3 * arc:.1f} mm of {goal.vessel!r} in {self.name!r}; "
                f"give a goal of this anatomy, one of {', '.join(self.goals)}, or "
                "Anatomy.goal_at(position)"
            )

    def check_inside(self, what: str, position: np.ndarray) -> None:
        """Raises ValueError if a position (3,), m, LPS, is outside the lumen."""
        depth = float(self.lumen(position))
        if not depth > 0.0:
            low, high = self._box_of_file()
            unit = "m" if self.file is None else self.file.unit
            raise ValueError(
                f"{what} lies {-depth * 1e3:.1f} mm outside the lumen of "
                f"{self.name!r}, which reaches from {low} to {high} {unit}; give a "
                f"point inside, or one of the goals {', '.join(self.goals)}"
            )

    def _box_of_file(self) -> list[str]:
        """Two corners of the lumen in the unit and frame of the file, as text."""
        points = self.surface.vertices
        if self.file is not None:
            points = np.linalg.solve(self.file.to_lps, points.T).T
        corners = points.min(axis=0), points.max(axis=0)
        return ["(" + ", ".join(f"{x:.3g}" for x in corner) + ")" for corner in corners]

    def goal_room(self, goal: Goal) -> float:
        """Largest radius (m) of a goal: the arc length to the nearest mark before it.

        Marks are the ostium of its vessel and, for a named goal, the other goals in
        the same vessel. At least 0.5 mm; infinite without a mark.
        """
        vessel = self.tree.vessel(goal.vessel)
        before = [vessel.ostium] if vessel.parent is not None else []
        if self.goals.get(goal.name) is goal:
            before += [
                other.arc_length
                for other in self.goals.values()
                if other.vessel == goal.vessel and other.arc_length < goal.arc_length
            ]
        room = goal.arc_length - max(before, default=-np.inf)
        return max(room, _LEAST_ROOM)

    def route(self, goal: str | Goal, spare: float = 0.0) -> Centreline:
        """Polyline with radii from the inlet to a goal, or `spare` (m) past it."""
        target = goal if isinstance(goal, Goal) else self.goal(goal)
        end = self.tree.vessel(target.vessel).centreline.length
        there = min(target.arc_length + spare, end)
        entered = self.inlet.vessel
        start = self.tree.vessel(entered).centreline.locate(self.inlet.position)
        return self.tree.route(entered, target.vessel, there, start_arc_length=start)

    def save(self, directory: str | os.PathLike[str]) -> Path:
        """Write the anatomy into `directory` and return that path.

        The write is atomic: a concurrent reader finds the old or the new anatomy.
        """
        directory = files.require_folder(directory, make=True)
        arrays = {
            "surface_vertices": self.surface.vertices,
            "surface_faces": self.surface.faces,
        }
        vessels = []
        for index, vessel in enumerate(self.tree.vessels.values()):
            own = dict(vars(vessel))
            line = own.pop("centreline")
            arrays[f"vessel_{index}_points"] = line.points
            arrays[f"vessel_{index}_radii"] = line.radii
            vessels.append(own)
        header = {
            **_FORMAT,
            "name": self.name,
            "scanned": self.scan is not None,
            "vessels": vessels,
            "inlet": _plain(self.inlet),
            "goals": [_plain(goal) for goal in self.goals.values()],
            "ends": [_plain(end) for end in self.ends],
        }
        if self.file is not None:
            header["file"] = _plain(self.file)
        text = np.array(json.dumps(header))
        with files.atomic_path(directory / _FILE) as path, open(path, "wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, header=text, **arrays)
        return directory

    @classmethod
    def load(cls, directory: str | os.PathLike[str]) -> "Anatomy":
        """Read an anatomy that `save` wrote.

        Raises:
            FileNotFoundError: if `directory` holds no anatomy.
            ValueError: if the file is damaged, of another format, or has an invalid
                entry; names the file and the entry.
        """
        path = files.as_path("directory", directory) / _FILE
        if not path.is_file():
            raise FileNotFoundError(
                f"no {_FILE} in {path.parent}; give a directory written by `cathsim "
                "phantom import`, `build` or `generate`, or by Anatomy.save"
            )
        try:
            return _unpack(files.read_arrays(path))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: {error}") from error


def _plain(part: Goal | Inlet | End | FileFrame) -> dict[str, Any]:
    return {name: np.asarray(value).tolist() for name, value in vars(part).items()}


def _unpack(arrays: dict[str, np.ndarray]) -> Anatomy:
    """Anatomy from the arrays of a file; ValueError names an invalid entry."""
    try:
        header = json.loads(str(arrays["header"]))
        kept = {key: header[key] for key in ("format", "version", "units", "frame")}
        if repr(kept) != repr(_FORMAT):  # by repr: True == 1
            raise ValueError(f"it is {kept}, not {_FORMAT}; write it again")
        vessels = []
        for index, entry in enumerate(_listed(header, "vessels")):
            points, radii = (arrays[f"vessel_{index}_{k}"] for k in ("points", "radii"))
            vessels.append(Vessel(centreline=Centreline(points, radii), **entry))
        goals = [Goal(**entry) for entry in _listed(header, "goals")]
        for kind, parts in (("vessels", vessels), ("goals", goals)):
            if len({part.name for part in parts}) < len(parts):
                raise ValueError(f"{kind} has a name twice")
        surface = Surface(arrays["surface_vertices"], arrays["surface_faces"])
        return Anatomy(
            name=bounds.text("name", header["name"]),
            tree=VesselTree({vessel.name: vessel for vessel in vessels}),
            inlet=Inlet(**header["inlet"]),
            goals={goal.name: goal for goal in goals},
            ends=tuple(End(**entry) for entry in _listed(header, "ends")),
            scan=surface if bounds.switch("scanned", header["scanned"]) else None,
            file=FileFrame(**header["file"]) if "file" in header else None,
        )
    except KeyError as error:
        raise ValueError(f"it lacks the entry {error}") from error
    except TypeError as error:  # not an object, or unknown entries
        raise ValueError(f"an entry is wrong: {error}") from error


def _listed(header: dict[str, Any], name: str) -> list[Any]:
    return bounds.instance(name, header[name], list)
