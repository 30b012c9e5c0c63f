"""`cathsim validate wall`: field against lumen, acting friction, convergence."""

import itertools
from collections.abc import Iterator

import numpy as np

from cathsim_dmc.anatomy import measures, phantoms
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.scan import topology
from cathsim_dmc.anatomy.scan.check import check_tree
from cathsim_dmc.anatomy.surface import sampled
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth
from cathsim_dmc.anatomy.tree_depth import TreeDepth
from cathsim_dmc.entities import devices
from cathsim_dmc.laws.field import BEHIND, FREE
from cathsim_dmc.validation import convergence, friction, pressed, s_bend
from cathsim_dmc.validation.checks import Check, Report

# Bounds (mm) on the error of the field, 99th percentile of points within 1 mm of the
# wall: for a union of tubes, and for a surface. The distance to a surface has edges at
# its edges, which a lattice rounds.
ERROR_TREE, ERROR_SURFACE = 0.02, 0.20
LARGEST_FIELD = 5.0  # MB
ARCHES = ("type1", "type2")
_NEAR_WALL = 1e-3  # m
_PLACES = 20_000  # sample points
# m around an inlet that is left out: its wall may be a cap.
_AT_INLET = 2e-3
_DEEPEST = -0.5e-3  # m, least depth of the points that are compared
# Error, m, and slope of the clearance, above which it is that of another wall. The
# slope of a distance is 1.
_OFF, _STEEPEST = 0.4e-3, 1.5
_HOLE = 2e-3  # m, radius of the hole that a sheath leaves in a cap

# Points (n, 3) m near a wall, and their exact depths (n,), m.
Places = tuple[np.ndarray, np.ndarray]


def field_error(anatomy: Anatomy, places: Places | None = None) -> np.ndarray:
    """Errors (n,), m, of the field at points within 1 mm of the wall."""
    points, exact = _near_wall(anatomy) if places is None else places
    found = anatomy.lumen(points, free=True)
    return np.abs(found - exact)[found < FREE]


def without_wall(anatomy: Anatomy, places: Places) -> int:
    """Number of points near the wall, away from the inlet, with a wrong wall.

    There the clearance of the simulation, with a cap that has a hole for the sheath,
    differs from the depth of the lumen or is steeper than a distance.
    """
    points, exact = places
    looked_at = exact > _DEEPEST
    for end in anatomy.ends:
        if end.open:
            local = points - end.position
            level = local @ end.direction
            across = np.linalg.norm(local - level[:, None] * end.direction, axis=1)
            behind = (-_AT_INLET < level) & (level < BEHIND)
            looked_at &= ~behind | (across > end.radius + _AT_INLET)
    points, exact = points[looked_at], exact[looked_at]
    capped = anatomy.lumen.with_hole(_HOLE)
    off = np.abs(capped(points, free=True) - exact) > _OFF
    off |= np.linalg.norm(capped.gradient(points), axis=1) > _STEEPEST
    return int(off.sum())


def _near_wall(anatomy: Anatomy) -> Places:
    """Random points (n, 3) m within 1 mm of the wall, and exact depths (n,), m."""
    points, normals = sampled(anatomy.surface, _PLACES)
    away = np.random.default_rng(0).uniform(-1.2e-3, 1.2e-3, (_PLACES, 1))
    points = points + away * normals
    if anatomy.scan:
        exact = SurfaceDepth(anatomy.surface, anatomy.ends)(points)
    else:
        exact = TreeDepth(anatomy.tree, anatomy.ends)(points)
    near = np.abs(exact) < _NEAR_WALL
    return points[near], exact[near]


def lumen_checks(anatomy: Anatomy) -> list[Check]:
    """Checks of surface, field, passage and goals of an anatomy."""
    surface, field = _surface_checks(anatomy), _field_checks(anatomy)
    return [*surface, *field, *_passage_checks(anatomy)]


def _surface_checks(anatomy: Anatomy) -> Iterator[Check]:
    faces = anatomy.surface.faces.astype(np.int64)
    if not anatomy.scan:  # scans have rings of vessels, which are handles
        name = f"{anatomy.name}: handles of the surface"
        note = "tubes that touch beyond the place where they part"
        yield Check.at_most(name, topology.handles(faces), 0, "", note)
    loose = int((topology.edge_counts(faces)[1] != 2).sum())
    name = f"{anatomy.name}: edges of the surface without two triangles"
    note = f"{len(faces)} triangles, {1e6 * anatomy.surface.volume:.0f} ml"
    yield Check.at_most(name, loose, 0, "", note)
    parts = int(topology.parts(faces).max()) + 1
    yield Check.at_most(f"{anatomy.name}: separate parts of the surface", parts, 1)


def _field_checks(anatomy: Anatomy) -> Iterator[Check]:
    places = _near_wall(anatomy)
    error = 1e3 * field_error(anatomy, places)
    worst = float(np.percentile(error, 99))
    bound = ERROR_SURFACE if anatomy.scan else ERROR_TREE
    name = f"{anatomy.name}: error of the field, 99th percentile"
    note = f"mean {error.mean():.4f} mm, at most {error.max():.3f} mm, at "
    note += f"{len(error)} places within {1e3 * _NEAR_WALL:g} mm of the wall"
    yield Check.at_most(name, worst, bound, "mm", note)
    name = f"{anatomy.name}: places at the wall where a device meets another"
    yield Check.at_most(name, without_wall(anatomy, places), 0)
    name, size = f"{anatomy.name}: memory of the field", anatomy.lumen.nbytes / 1e6
    yield Check.at_most(name, size, LARGEST_FIELD, "MB")


def _passage_checks(anatomy: Anatomy) -> Iterator[Check]:
    radius = devices.get("steerable_5f").outer_radius
    # Number of points, 0.5 mm apart, on the route to each goal that are too narrow.
    narrow, astray = {}, []
    for goal in anatomy.goals.values():
        route = anatomy.route(goal.name)
        s = np.arange(1.5 * radius, route.length - 1.5 * radius, 0.5e-3)
        depth = anatomy.lumen(route.at(s).position, free=True)
        narrow[goal.name] = int((depth < radius).sum())
        own = float(anatomy.tree.depths(goal.position)[goal.vessel])
        if not min(float(anatomy.lumen(goal.position)), own) > radius:
            astray.append(goal.name)
    name = f"{anatomy.name}: places of the centrelines that the device does not pass"
    note = f"radius {1e3 * radius:.2f} mm"
    if blocked := ", ".join(one for one, count in narrow.items() if count):
        note += f", blocked: {blocked}"
    yield Check.at_most(name, sum(narrow.values()), 0, "", note)
    name = f"{anatomy.name}: goals that the device cannot reach in their vessel"
    note = f"of {', '.join(anatomy.goals) or 'none'}"
    if astray:
        note += f", astray: {', '.join(astray)}"
    yield Check.at_most(name, len(astray), 0, "", note)


def validate_anatomy(anatomy: Anatomy) -> Report:
    """Checks and measures an anatomy: generated, measured or imported."""
    checks = lumen_checks(anatomy)
    for check, wrong in check_tree(anatomy).items():
        name = f"{anatomy.name}: {check}, violations"
        checks.append(Check.at_most(name, int(bool(wrong)), 0, "", wrong))
    findings = {anatomy.name: {"measures": measures.measure(anatomy.tree)}}
    return Report(f"anatomy of {anatomy.name}", checks, findings)


def validate_wall() -> Report:
    """Runs every check of the wall."""
    anatomies = [*map(phantoms.load, ARCHES)]
    studies = convergence.studies()
    pulled: list[friction.Capstan] = []
    checks = itertools.chain(
        itertools.chain.from_iterable(map(lumen_checks, anatomies)),
        friction.checks(pulled),
        s_bend.checks(),
        pressed.push_checks(),
        convergence.checks(studies),
        convergence.judged_checks(),
    )
    data = {"anatomies": anatomies, "capstans": pulled, "studies": studies}
    step = f"{1e3 * convergence.FINEST:g} ms"
    findings = {
        "convergence": studies,
        f"largest force of full pushes, over that at {step}": convergence.peaks(),
        "friction in round lumens, excess by clearance, %": friction.narrow_lumens(),
        **s_bend.findings(),
    }
    return Report("wall", list(checks), findings, data)
