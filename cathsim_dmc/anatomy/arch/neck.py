"""The arteries of the neck and the arms, beyond the branches of an arch.

Directions are those of the patient frame LPS: x to the left, y to the back, z up.
"""

from dataclasses import dataclass, replace

import numpy as np

from cathsim_dmc.anatomy.arch.draws import Random, normal
from cathsim_dmc.anatomy.builder import GOAL_DEPTH
from cathsim_dmc.anatomy.centreline import Array, Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.curves import check_septa, ostium_of

_STEP = 2e-3  # m, between points of a centreline
_TURNS = 11  # steps over which a course turns into its next heading
_RIGHT, _BACK, _UP = -np.eye(3)[0], np.eye(3)[1], np.eye(3)[2]
_SHAKE = 0.15  # standard deviation of each coordinate of a unit heading
# Lumen radii, m, mean and deviation: of the common carotid away from its origin (the
# mean is that of the sampler's LCCA), of the subclavian artery past the vertebral one,
# and of the vertebral arteries. They are assumptions within the usual ranges, as all
# lengths and courses are.
_CAROTID, _ARM, _VERTEBRAL = (3.15e-3, 0.35e-3), (3.6e-3, 0.4e-3), (1.8e-3, 0.2e-3)
_THINNEST = 1.3e-3  # m
_ATTEMPTS = 20


@dataclass(frozen=True)
class Course:
    """The course of a new artery, or the extension of an existing one.

    Attributes:
        name: name of the artery.
        parent: vessel that the artery leaves; None to extend the artery `name`.
        place: arc length on the parent at which the artery starts, m.
        first: heading (3,) at the start; None for an extension.
        ways: sections, each a heading (3,), of any norm, and a length, m. Along a
            section the artery turns from the heading before into this one.
        radii: lumen radii, m, equally spaced from start to end. An extension leaves
            out the first, which is the radius at the end of the artery.
    """

    name: str
    ways: tuple[tuple[tuple[float, ...], float], ...]
    radii: tuple[float, ...]
    parent: str | None = None
    place: float = 0.0
    first: tuple[float, ...] | None = None


def with_courses(tree: VesselTree, courses: tuple[Course, ...]) -> VesselTree:
    """The tree with the arteries of `courses` added in their order."""
    vessels = dict(tree.vessels)
    for course in courses:
        if course.parent is None:
            old = vessels[course.name]
            line = _going_on(old.centreline, course)
            vessels[course.name] = replace(old, centreline=line)
            continue
        parent = vessels[course.parent]
        start = parent.centreline.at(course.place).position
        line = _line(start, np.array(course.first), course, course.radii)
        ostium = ostium_of(course.name, line, parent)
        vessels[course.name] = Vessel(course.name, line, course.parent, ostium)
    return VesselTree(vessels)


def _going_on(line: Centreline, course: Course) -> Centreline:
    last = line.at(line.length)
    radii = (float(last.radius), *course.radii)
    more = _line(last.position, last.tangent, course, radii)
    points = np.concatenate([line.points, more.points[1:]])
    return Centreline(points, np.concatenate([line.radii, more.radii[1:]]))


def _line(
    start: Array, heading: Array, course: Course, radii: tuple[float, ...]
) -> Centreline:
    """Centreline from `start` (3,), m, that turns into each heading of a course."""
    points = [start]
    for way, length in course.ways:
        target = np.array(way) / np.linalg.norm(way)
        for share in np.linspace(0.0, 1.0, _TURNS + 1)[1:]:
            mixed = (1.0 - share) * heading + share * target
            step = length / _TURNS * mixed / np.linalg.norm(mixed)
            points.append(points[-1] + step)
        heading = target
    line = Centreline(np.array(points), np.ones(len(points))).resampled(_STEP)
    share = line.arc_length / line.length
    along = np.linspace(0.0, 1.0, len(radii))
    return Centreline(line.points, np.interp(share, along, radii))


def sample_neck(random_state: Random, tree: VesselTree) -> tuple[Course, ...]:
    """Random arteries of neck and arms for an arch; equal states give equal arteries.

    The BCA divides into the right carotid (`rcca`) and the right subclavian artery
    (`rsa`), from which the right vertebral artery (`rva`) leaves; the LCCA and the LSA
    are extended, and the left vertebral artery (`lva`) leaves the LSA.

    Raises:
        ValueError: if the arch lacks BCA, LCCA or LSA, or if in every attempt arteries
            intersect or a branch is too short past its ostium for its goal.
    """
    if not {"bca", "lcca", "lsa"} <= tree.vessels.keys():
        raise ValueError(
            "a neck needs an arch with bca, lcca and lsa; this one has "
            f"{', '.join(tree.vessels)}"
        )
    attempts = _ATTEMPTS
    while True:
        courses = _drawn(random_state, tree)
        try:
            grown = with_courses(tree, courses)
            check_septa(grown)
            _check_depths(grown)
        except ValueError:
            attempts -= 1
            if not attempts:
                raise
        else:
            return courses


def _check_depths(tree: VesselTree) -> None:
    """Raises ValueError if a branch is too short past its ostium for its goal."""
    for name, vessel in tree.vessels.items():
        past = vessel.centreline.length - vessel.ostium
        if vessel.parent is not None and past < GOAL_DEPTH:
            raise ValueError(f"{name} ends {1e3 * past:.1f} mm past its ostium")


def _drawn(source: Random, tree: VesselTree) -> tuple[Course, ...]:
    """Draws the arteries.

    The right subclavian artery rises over the lung and falls to the arm; the vertebral
    arteries leave the backs and tops of both subclavian arteries and climb.
    """

    def way(heading: Array, shortest: float, longest: float):
        moved = heading / np.linalg.norm(heading) + source.normal(0.0, _SHAKE, 3)
        return tuple(moved.tolist()), source.uniform(shortest, longest)

    def radius(spread: tuple[float, float]) -> float:
        return max(normal(source, spread), _THINNEST)

    bca, lsa = (tree.vessel(name).centreline for name in ("bca", "lsa"))
    wide, end = float(bca.radii[-1]), bca.at(bca.length).tangent
    beyond = source.uniform(0.5e-3, 2e-3)
    carotid, arm = min(radius(_CAROTID), 0.8 * wide), min(radius(_ARM), 0.75 * wide)
    rise = source.uniform(0.3, 1.2)
    steep, climb = _RIGHT + rise * _UP, _UP + source.uniform(0.0, 0.3) * _RIGHT
    # The first cross-sections of both, of at most 0.8 of its radius, lie in the BCA.
    leans = [
        np.linalg.norm(np.cross(end, x)) / np.linalg.norm(x) for x in (steep, climb)
    ]
    fork = bca.length - 0.8 * wide * float(max(leans)) - beyond
    rsa = Course(
        "rsa",
        (way(steep, 22e-3, 32e-3), way(_RIGHT + 0.2 * _UP, 20e-3, 30e-3),
         way(_RIGHT - 0.4 * _UP, 25e-3, 35e-3)),
        (max(0.75 * wide, arm), arm, arm, 0.9 * arm), "bca", fork,
        first=tuple(steep.tolist()),
    )  # fmt: skip
    rcca = Course(
        "rcca", (way(climb, 25e-3, 35e-3), way(_UP, 50e-3, 65e-3)),
        (0.8 * wide, carotid, carotid), "bca", fork, first=tuple(climb.tolist()),
    )  # fmt: skip
    left = min(radius(_ARM), float(lsa.radii[-1]))
    more = (
        Course("lcca", (way(_UP, 50e-3, 65e-3),), (min(carotid, 3.15e-3),)),
        Course(
            "lsa", (way(-_RIGHT + 0.4 * _UP, 25e-3, 35e-3),
                    way(-_RIGHT - 0.3 * _UP, 35e-3, 45e-3)), (left, 0.9 * left),
        ),
    )  # fmt: skip
    branches = []
    for name, parent, side, place in (
        ("rva", "rsa", 0.2 * _RIGHT, source.uniform(20e-3, 32e-3)),
        ("lva", "lsa", -0.1 * _RIGHT, lsa.length - source.uniform(2e-3, 12e-3)),
    ):
        thin = radius(_VERTEBRAL)
        start = _UP + source.uniform(0.2, 0.6) * _BACK + side
        ways = (way(start, 20e-3, 28e-3), way(_UP + 0.1 * _BACK, 40e-3, 50e-3))
        branches.append(
            Course(name, ways, (1.1 * thin, thin, 0.95 * thin), parent, place,
                   first=tuple(start.tolist()))
        )  # fmt: skip
    return (rsa, rcca, *more, *branches)
