"""Distribution of the aortic inflow among the branches; see docs/vessel_model.md."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.centreline import Array, Centreline, VesselTree
from cathsim_dmc.anatomy.parts import End

# Mean shares of the inflow, from the resistances of ADAN56 (Boileau 2015).
SHARES = {"bca": 0.120, "lcca": 0.069, "lsa": 0.050}
_SPACING = 3e-3  # m, of the places along a vessel
_AT_END = 1e-6  # m


class Course(NamedTuple):
    """Blood flow through a vessel."""

    begin: float  # path length from the heart to where blood enters the vessel, m
    reverse: bool  # whether blood goes towards the first point of the centreline
    outlet: float  # share of the inflow that leaves through the vessel's own free end
    branches: Array  # (B, 2), path length to each ostium, m, and its share

    def share(self, way: Array) -> Array:
        """Share (n,) of the inflow at path lengths (n,), m, from where blood enters."""
        ahead = self.branches[:, 0] > np.asarray(way)[..., None]
        return self.outlet + (ahead * self.branches[:, 1]).sum(axis=-1)


class Segments(NamedTuple):
    """The S segments of a `Circulation`, with the shapes and units given there."""

    ends: Array
    radii: Array
    shares: Array
    ways: Array
    vessel: np.ndarray


@dataclass(frozen=True, eq=False)
class Circulation:
    """Distribution of the inflow along the vessels, in S straight segments."""

    courses: dict[str, Course]  # by vessel
    radius: float  # of the lumen at the heart, m
    ends: Array  # (S, 2, 3), m
    radii: Array  # (S, 2), of the lumen, m
    shares: Array  # (S, 2), of the inflow; negative for flow against the segment
    ways: Array  # (S, 2), path length from the heart, m
    vessel: np.ndarray  # (S,) int64, index of the vessel

    @classmethod
    def of(cls, tree: VesselTree, murray: bool = False) -> "Circulation":
        """Circulation of a tree; blood enters at the wider end of the root.

        BCA, LCCA and LSA get the shares of `SHARES`; with `murray`, or if one of them
        is missing, Murray's law gives all shares.
        """
        root = tree.root.centreline
        reverse = bool(root.radii[-1] > root.radii[0])
        courses = _courses(tree, reverse, murray)
        columns = [
            _along(vessel.centreline, courses[name], number)
            for number, (name, vessel) in enumerate(tree.vessels.items())
        ]
        joined = {
            name: np.concatenate([getattr(column, name) for column in columns])
            for name in Segments._fields
        }
        return cls(courses, float(root.radii[-1 if reverse else 0]), **joined)

    def check(self, name: str, tree: VesselTree, ends: Sequence[End]) -> None:
        """Raises ValueError unless blood can enter at the heart's end and leave."""
        root = tree.root
        heart = root.centreline.points[-1 if self.courses[root.name].reverse else 0]
        distances = [np.linalg.norm(end.position - heart) for end in ends]
        if min(distances, default=np.inf) > _AT_END or len(ends) < 2:
            raise ValueError(
                f"anatomy {name!r} has no flow: it has {len(ends)} free ends, "
                f"and needs one at the wider end of {root.name!r}, for the inflow, and "
                "an outlet; import it with its ends cut open, or leave flow out"
            )

    @property
    def segments(self) -> Segments:
        """The segments, for compiled loops."""
        return Segments(self.ends, self.radii, self.shares, self.ways, self.vessel)


def _along(line: Centreline, course: Course, number: int) -> Segments:
    count = max(2, round(line.length / _SPACING) + 1)
    s = np.linspace(0.0, line.length, count)
    way, sign = (line.length - s, -1.0) if course.reverse else (s, 1.0)
    place = line.at(s)
    values = place.position, place.radius, sign * course.share(way), course.begin + way
    pairs = [np.stack([value[:-1], value[1:]], axis=1) for value in values]
    ends, radii, shares, ways = pairs
    return Segments(ends, radii, shares, ways, np.full(count - 1, number))


def _courses(tree: VesselTree, reverse: bool, murray: bool) -> dict[str, Course]:
    outlets = _outlets(tree, reverse, murray)
    taken, begins, root = dict(outlets), {tree.root.name: 0.0}, tree.root
    branches: dict[str, list] = {name: [] for name in tree.vessels}
    below = [vessel for vessel in tree.vessels.values() if vessel.parent is not None]
    for vessel in reversed(below):  # branches before their parents
        taken[str(vessel.parent)] += taken[vessel.name]
    for vessel in below:
        parent, way = str(vessel.parent), tree.origin(vessel.name)
        if reverse and parent == root.name:
            way = root.centreline.length - way
        begins[vessel.name] = begins[parent] + way
        branches[parent].append((way, taken[vessel.name]))
    return {
        name: Course(
            begins[name],
            reverse and name == root.name,
            outlets[name],
            np.array(own).reshape(-1, 2),
        )
        for name, own in branches.items()
    }


def _outlets(tree: VesselTree, reverse: bool, murray: bool) -> dict[str, float]:
    """Share of the inflow that leaves through the free end of each vessel."""
    shares = {} if murray or not set(SHARES) <= set(tree.vessels) else SHARES
    artery: dict[str | None, str] = {None: ""}
    cubes: dict[str, float] = {}
    summed = dict.fromkeys((*shares, ""), 0.0)
    for name, vessel in tree.vessels.items():
        artery[name] = name if name in shares else artery[vessel.parent]
        first = reverse and vessel.parent is None
        cubes[name] = float(vessel.centreline.radii[0 if first else -1]) ** 3
        summed[artery[name]] += cubes[name]
    totals = {**shares, "": 1.0 - sum(shares.values())}
    return {
        n: totals[artery[n]] * cube / summed[artery[n]] for n, cube in cubes.items()
    }
