"""The anatomy as the simulator sees it: lumen, inlet and goals.

Lengths are metres, positions are in the patient frame LPS.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cathsim_dmc import files
from cathsim_dmc.anatomy import builder, field_cache, loading
from cathsim_dmc.anatomy.builder import VesselPlace
from cathsim_dmc.anatomy.centreline import (
    Array,
    Centreline,
    Vessel,
    VesselTree,
)
from cathsim_dmc.anatomy.curves import Curve, smooth_tree
from cathsim_dmc.anatomy.field import Field
from cathsim_dmc.anatomy.parts import End, Goal, Inlet, Surface

FORMAT = "cathsim-anatomy"
FORMAT_VERSION = 2
_DESCRIPTION = "anatomy.json"
_READS = 50  # of a description that is replaced while it is read


@dataclass(frozen=True, eq=False, repr=False)
class Anatomy:
    """An anatomy ready for simulation.

    Attributes:
        name: what to call it.
        tree: centrelines and radii.
        surface: triangles of the lumen surface, closed.
        inlet: where the device enters.
        goals: places to reach, by name.
        ends: flat ends of the lumen, open or capped.
        scanned: whether the surface bounds the true lumen, as that of a scan; it is the
            union of the tree's tubes if not.
    """

    name: str
    tree: VesselTree
    surface: Surface
    inlet: Inlet
    goals: Mapping[str, Goal]
    ends: tuple[End, ...] = ()
    scanned: bool = False

    def __post_init__(self) -> None:
        for key, goal in self.goals.items():
            if key != goal.name:
                raise ValueError(f"goal {goal.name!r} is filed under {key!r}.")
            self.tree.vessel(goal.vessel)
        self.tree.vessel(self.inlet.vessel)
        object.__setattr__(self, "goals", dict(self.goals))
        object.__setattr__(self, "ends", tuple(self.ends))

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
        **smoothing: float,
    ) -> Anatomy:
        """Build lumen surface, inlet and goals around centrelines.

        Args:
            tree: measured centrelines (`anatomy.curves.Curve`) by name, parents
                before their children; or a finished vessel tree, taken as it is.
            name: what to call the anatomy.
            inlet: where the device enters; what lies behind is cut off. The first
                point of the root if None.
            goals: places to reach; if None one in each branch, see
                `anatomy.builder.default_goals`.
            **smoothing: `smoothing` and `flare` of `anatomy.curves.smooth_tree`, m.

        Raises:
            ValueError: if the centrelines give no valid lumen, or a place is not on
                its vessel; names the vessel.
        """
        from cathsim_dmc.anatomy.surface import lumen_surface

        if not isinstance(tree, VesselTree):
            tree = smooth_tree(tree, **smoothing)
        tree, ends, entry, places = builder.placed(tree, inlet, goals)
        return cls(name, tree, lumen_surface(tree), entry, places, ends)

    @cached_property
    def lumen(self) -> Field:
        """Signed depth to the wall, which a device touches.

        Built when first asked for, and kept in `field_cache.cache_folder()`.
        """
        if self.scanned:
            return field_cache.surface_field(self.surface, self.ends)
        return field_cache.tree_field(self.tree, self.ends)

    def depth(self, points: ArrayLike) -> Array:
        """Signed depth (...) of `points` (..., 3) in the lumen, metres, > 0 inside.

        Behind an open end it is minus the distance from the plane of the end.
        """
        return self.lumen(points)

    def goal(self, name: str) -> Goal:
        """Goal called `name`.

        Raises:
            ValueError: if there is none; the message lists the names.
        """
        try:
            return self.goals[name]
        except KeyError:
            raise ValueError(
                f"no goal {name!r}; there are {', '.join(self.goals) or 'none'}."
            ) from None

    def route(self, goal: str | Goal, spare: float = 0.0) -> Centreline:
        """Polyline with radii from the inlet to a goal, or `spare` (m) past it."""
        target = goal if isinstance(goal, Goal) else self.goal(goal)
        there = target.arc_length
        if spare:
            end = self.tree.vessel(target.vessel).centreline.length
            there = min(there + spare, end)
        line = self.tree.vessel(self.inlet.vessel).centreline
        start = float(line.project(self.inlet.position).arc_length)
        return self.tree.route(
            self.inlet.vessel,
            target.vessel,
            there,
            start_arc_length=start,
        )

    def save(self, directory: str | os.PathLike[str]) -> Path:
        """Write the anatomy into `directory` and return that path.

        The geometry goes into an npz named by its content, the description into
        `anatomy.json`, which is replaced last: a reader finds the old anatomy or
        the new one, never a mixture. Of processes that save into one directory at
        once, one waits for the other, and the last one's anatomy stays.
        """
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        arrays, description = _pack(self)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **arrays)
        data = buffer.getvalue()
        digest = hashlib.sha256(data).hexdigest()
        description["geometry"] = f"geometry-{digest[:16]}.npz"
        description["sha256"] = digest
        text = json.dumps(description, indent=2) + "\n"
        with _alone(directory) as alone:
            files.write_bytes(directory / description["geometry"], data)
            files.write_text(directory / _DESCRIPTION, text)
            # Others may be about to name what they have just written.
            if alone:
                stale = {*directory.glob("geometry-*.npz")}
                for path in stale - {directory / description["geometry"]}:
                    path.unlink(missing_ok=True)
        return directory

    @classmethod
    def load(cls, directory: str | os.PathLike[str]) -> Anatomy:
        """Read an anatomy that `save` wrote.

        Raises:
            FileNotFoundError: if `directory` holds no anatomy.
            ValueError: if a file is damaged, of another format, or holds what no
                anatomy does; names the file and the entry.
        """
        path = Path(directory) / _DESCRIPTION
        for _ in range(_READS):
            description, text = _read_description(path)
            # Only the bare file name counts: a description may not point elsewhere.
            geometry = path.parent / Path(str(description.get("geometry"))).name
            try:
                data = loading.read_regular(geometry, loading.LARGEST_ARRAYS)
                break
            except FileNotFoundError:
                # Replaced between the two reads, unless the description still stands.
                if _read_description(path)[1] == text:
                    raise ValueError(
                        f"{path} names {geometry.name}, which is missing."
                    ) from None
        else:
            raise ValueError(f"{path} was replaced {_READS} times while it was read.")
        if hashlib.sha256(data).hexdigest() != description.get("sha256"):
            raise ValueError(f"{geometry} is damaged: its checksum differs.")
        loading.check_description(description, path)
        arrays = loading.read_arrays(data, geometry)
        loading.check_arrays(arrays, len(description["vessels"]), geometry)
        try:
            anatomy = _unpack(description, arrays)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        loading.check_places(anatomy, path)
        return anatomy


def _read_description(path: Path) -> tuple[dict[str, Any], bytes]:
    """The description of an anatomy, and its text."""
    try:
        text = loading.read_regular(path, loading.LARGEST_TEXT)
    except FileNotFoundError:
        raise FileNotFoundError(
            f"no {_DESCRIPTION} in {path.parent}; give a directory that "
            "Anatomy.save wrote."
        ) from None
    try:
        description = json.loads(text)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if not isinstance(description, dict) or (
        description.get("format") != FORMAT
        or repr(description.get("version")) != repr(FORMAT_VERSION)  # True is no 1
    ):
        raise ValueError(
            f"{path} is not a {FORMAT} file of version {FORMAT_VERSION}; write it "
            "again with Anatomy.save."
        )
    return description, text


@contextlib.contextmanager
def _alone(directory: Path) -> Iterator[bool]:
    """Holds other processes' `save` off a directory; false where that is not known."""
    try:
        import fcntl

        handle = os.open(directory, os.O_RDONLY)
    except (ImportError, OSError):
        yield False
        return
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            locked = True
        except OSError:
            locked = False
        yield locked
    finally:
        os.close(handle)


def _pack(anatomy: Anatomy) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    arrays: dict[str, np.ndarray] = {
        "surface_vertices": anatomy.surface.vertices,
        "surface_faces": anatomy.surface.faces,
    }
    vessels = []
    for index, vessel in enumerate(anatomy.tree.vessels.values()):
        arrays[f"vessel_{index}_points"] = vessel.centreline.points
        arrays[f"vessel_{index}_radii"] = vessel.centreline.radii
        vessels.append(
            {"name": vessel.name, "parent": vessel.parent, "ostium": vessel.ostium}
        )
    description = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "units": "m",
        "frame": "LPS",
        "name": anatomy.name,
        "scanned": anatomy.scanned,
        "vessels": vessels,
        "inlet": {
            "vessel": anatomy.inlet.vessel,
            "position": anatomy.inlet.position.tolist(),
            "direction": anatomy.inlet.direction.tolist(),
            "radius": float(anatomy.inlet.radius),
        },
        "goals": [
            {
                "name": goal.name,
                "vessel": goal.vessel,
                "position": goal.position.tolist(),
                "arc_length": float(goal.arc_length),
            }
            for goal in anatomy.goals.values()
        ],
        "ends": [
            {
                "vessel": end.vessel,
                "position": end.position.tolist(),
                "direction": end.direction.tolist(),
                "radius": float(end.radius),
                "open": bool(end.open),
            }
            for end in anatomy.ends
        ],
    }
    return arrays, description


def _unpack(description: dict[str, Any], arrays: dict[str, np.ndarray]) -> Anatomy:
    vessels = {}
    for index, entry in enumerate(description["vessels"]):
        line = Centreline(
            arrays[f"vessel_{index}_points"], arrays[f"vessel_{index}_radii"]
        )
        vessels[entry["name"]] = Vessel(
            entry["name"], line, entry["parent"], entry["ostium"]
        )
    return Anatomy(
        name=description["name"],
        tree=VesselTree(vessels),
        surface=Surface(arrays["surface_vertices"], arrays["surface_faces"]),
        inlet=Inlet(**description["inlet"]),
        goals={entry["name"]: Goal(**entry) for entry in description["goals"]},
        ends=tuple(End(**entry) for entry in description["ends"]),
        scanned=description["scanned"],
    )
