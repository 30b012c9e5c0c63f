"""Checks of a vessel tree against the surface of its lumen."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy import geodesic
from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import CentrelinePoint
from cathsim_dmc.anatomy.parts import Goal
from cathsim_dmc.anatomy.reach import unreachable
from cathsim_dmc.anatomy.scan import units
from cathsim_dmc.anatomy.scan.aorta import MISPLACED, TURN, Bend, mirrored
from cathsim_dmc.anatomy.scan.lumen import enlargement
from cathsim_dmc.anatomy.scan.naming import ARCH_BRANCHES
from cathsim_dmc.anatomy.scan.places import resized
from cathsim_dmc.anatomy.scan.topology import groups
from cathsim_dmc.anatomy.scan.tree import END_TRIM, TAIL, TAIL_RADIUS
from cathsim_dmc.anatomy.scan.units import enlarged, mm, shown
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth
from cathsim_dmc.anatomy.tree_depth import on_walls, rings_of

SLACK = 0.3e-3  # m, by which a triangulated surface may cut into a tube
STEP = 0.5e-3  # m, between the places of a centreline that are tested
FREE = 12e-3  # m, allowed length of lumen beyond the end of a vessel, or radii:
FREE_RADII = 4.0
NARROW_END = 1.35  # in `TAIL_RADIUS`; the thin tail of a narrower end was cut off
JOINS = 15e-3  # m of lumen between the end of a vessel and another that it joins
PASSABLE = 0.6e-3  # m, least depth of a lumen that counts as continuing
BESIDE = 15e-3  # m that two vessels may run in one lumen beyond their fork
VOLUME = (0.02e-6, 2e-3)  # m^3 of a lumen
WIDE = 90.0  # percentile of the radii of a tree for its wide vessels
RADII = (0.3e-3, 30e-3)  # m, allowed median of a vessel: arteriole, aneurysm
WIDEST = 45e-3  # m
RIM_SLACK = 0.05e-3  # m, by which the first cross-section of a branch may lie outside
ARMS = 60e-3  # m, horizontal distance of the arteries of the arms that shows sides
LEFT = 0.5  # least cosine between +x and the direction from right to left arm
ONE_OSTIUM = 3e-3  # m along the aorta; nearer ostia count as one


def check_tree(anatomy: Anatomy) -> dict[str, str]:
    """Checks the tree of an anatomy against its closed surface; see docs/scans.md.

    Returns what is wrong and where, by the name of the check; empty where it passes.
    """
    surface = anatomy.surface
    radii = [vessel.centreline.radii for vessel in anatomy.tree.vessels.values()]
    wide = float(np.percentile(np.concatenate(radii), WIDE))
    scale = enlargement(wide, surface.volume)
    found = {name: "; ".join(look(anatomy)) for name, look in _UNSCALED.items()}
    # A small tree is checked enlarged, as it was imported, so that the limits suit it.
    with enlarged(scale):
        large = _enlarged(anatomy, scale)
        measure = SurfaceDepth(large.surface)
        found |= {k: "; ".join(look(large, measure)) for k, look in _CHECKS.items()}
    return found


def _enlarged(anatomy: Anatomy, scale: float) -> Anatomy:
    """The anatomy scaled by `scale`; without its ends if it is scaled."""
    if scale == 1.0:
        return anatomy
    tree, inlet, surface = resized(anatomy.tree, anatomy.inlet, anatomy.surface, scale)
    goals = {
        key: Goal(key, goal.vessel, scale * goal.position, scale * goal.arc_length)
        for key, goal in anatomy.goals.items()
    }
    return Anatomy(anatomy.name, tree, inlet, goals, (), surface)


def _inside(anatomy: Anatomy, measure: SurfaceDepth) -> Iterator[str]:
    for key, vessel in anatomy.tree.vessels.items():
        line = vessel.centreline
        # At the ends of the line the flat cap is arbitrarily near.
        margin = min(0.5 * float(line.radii[-1]), 0.2 * line.length)
        first = margin if vessel.parent is None else 0.0
        # The points are dense, so that no part between them leaves the lumen.
        s = np.arange(first, line.length - margin, STEP)
        place = line.at(s)
        depth = measure(place.position)
        floor = np.minimum(0.25 * place.radius, SLACK)
        worst = int((depth - floor).argmin())
        if depth[worst] < min(floor[worst], 0.1e-3) - SLACK * 0.5:
            yield (
                f"{key} leaves the lumen {mm(s[worst]):.0f} mm from its start, at "
                f"{shown(place.position[worst])}, by {mm(-depth[worst]):.1f} mm"
            )


def _own_lumen(anatomy: Anatomy, _: SurfaceDepth) -> Iterator[str]:
    vessels = list(anatomy.tree.vessels.values())
    for vessel in vessels:
        line = vessel.centreline
        own = line.at(np.arange(vessel.ostium, line.length, STEP))
        for other in vessels:
            if other is vessel or other.parent == vessel.name:
                continue
            place = other.centreline.project(own.position)
            beside = place.distance < 0.5 * np.minimum(place.radius, own.radius)
            if other.parent is not None:
                beside &= place.arc_length > other.ostium
            if (length := STEP * int(beside.sum())) > BESIDE:
                yield (
                    f"{vessel.name} runs {mm(length):.0f} mm in the lumen of "
                    f"{other.name}, around {shown(own.position[beside.argmax()])}"
                )


def _parents(anatomy: Anatomy, _: SurfaceDepth) -> Iterator[str]:
    for key, vessel in anatomy.tree.vessels.items():
        if vessel.parent is None:
            continue
        parent = anatomy.tree.vessel(vessel.parent)
        place = parent.centreline.project(vessel.centreline.points[0])
        if place.distance > place.radius:
            yield (
                f"{key} starts {mm(place.distance):.1f} mm from the centreline of "
                f"{parent.name}, outside of it"
            )
        if parent.parent is not None and place.arc_length < parent.ostium - 2e-3:
            yield (
                f"{key} leaves {parent.name} {mm(place.arc_length):.0f} mm from its "
                f"start, before that has an ostium ({mm(parent.ostium):.0f} mm)"
            )


def _sides(anatomy: Anatomy, _: SurfaceDepth) -> Iterator[str]:
    """Errors in the order of the arch's branches, and in the side it leads to."""
    tree = anatomy.tree
    root = tree.root
    vessels = [tree.vessels[key] for key in ARCH_BRANCHES if key in tree.vessels]
    vessels = [vessel for vessel in vessels if vessel.parent == root.name]
    if len(vessels) < 2:
        return
    ostia = [vessel.mouth.position for vessel in vessels]
    along = np.diff(root.centreline.project(np.array(ostia)).arc_length)
    # Branches with one ostium, as in a bovine arch, have no order.
    apart = along[np.abs(along) > ONE_OSTIUM]
    if (apart > 0).any() and (apart < 0).any():
        names = ", ".join(vessel.name for vessel in vessels)
        yield f"{names} do not leave {root.name} in this order"
    bend = Bend.of(root.centreline.points, [v.centreline.points for v in vessels])
    if _right_sided(anatomy):
        return
    if bend.turn > TURN and (text := mirrored(bend.azimuth(bool(along.sum() < 0)))):
        yield text
    elif bend.turn > TURN and bend.upright:
        yield from _arms(anatomy)


def _arms(anatomy: Anatomy) -> Iterator[str]:
    """Error if the subclavian arteries of an upright scan lead to the wrong sides.

    This finds exchanged axes, with which the arch still leads to the back and left.
    """
    arms = [anatomy.tree.vessels.get(key) for key in ("rsa", "lsa")]
    ends = [arm.centreline.points[-1] for arm in arms if arm is not None]
    if len(ends) < len(arms):
        return
    across = (ends[1] - ends[0])[:2]
    wide = float(np.linalg.norm(across))
    if wide > ARMS and across[0] < LEFT * wide:
        off = np.degrees(np.arccos(across[0] / wide))
        yield (
            f"the way from the end of the rsa at {shown(ends[0])} to that of the lsa "
            f"at {shown(ends[1])} leads {off:.0f} degrees off the patient's left: "
            f"{MISPLACED}"
        )


def _right_sided(anatomy: Anatomy) -> bool:
    """Whether the carotid arteries leave as those of a right-sided arch: left first."""
    tree = anatomy.tree
    vessels = [tree.vessels.get(key) for key in ("lcca", "rcca", "lsa")]
    own = [v for v in vessels if v is not None and v.parent == tree.root.name]
    if len(own) < len(vessels):
        return False
    ostia = np.array([vessel.mouth.position for vessel in own])
    left, right, arm = tree.root.centreline.project(ostia).arc_length
    return bool((right - left) * (arm - left) > 0.0)


def _free_ends(anatomy: Anatomy, measure: SurfaceDepth) -> Iterator[str]:
    vessels = anatomy.tree.vessels
    for key, vessel in vessels.items():
        line = vessel.centreline
        branches = [name for name, other in vessels.items() if other.parent == key]
        if any(anatomy.tree.origin(name) > line.length - 2e-3 for name in branches):
            continue  # the vessel ends in its branches
        end = line.at(line.length)
        tail = line.radii[line.arc_length > line.length - 30e-3]
        wide = float(max(tail.max(), end.radius))
        ahead = _lumen_beyond(measure, end, wide)
        gap = np.linalg.norm(ahead - end.position, axis=1)
        beyond = float(gap.max(initial=0.0))
        # A tail that no device can follow was cut off, and is not missing.
        thin = end.radius < NARROW_END * TAIL_RADIUS * units.enlargement()
        cut = TAIL + END_TRIM if thin else 0.0
        if beyond <= max(FREE, FREE_RADII * wide, cut):
            continue
        # A vessel may also end in another one, where a ring of vessels closes.
        near = ahead[gap < JOINS + wide]
        others = [v.centreline for v in vessels.values() if v is not vessel]
        places = [other.project(near) for other in others]
        if not any((place.distance < 0.7 * place.radius).any() for place in places):
            yield (
                f"{key} ends at {shown(end.position)}, but its lumen goes on for "
                f"{mm(beyond):.0f} mm or more"
            )


def _lumen_beyond(
    depth: SurfaceDepth, end: CentrelinePoint, radius: float
) -> np.ndarray:
    """Lattice points (n, 3) m of the passable lumen ahead of an end, within 60 mm."""
    reach = (FREE_RADII + 1.5) * radius
    narrow = float(end.radius) / 3.0
    spacing = float(np.clip(max(narrow, reach / 40.0), 0.5e-3, 2.0e-3))
    shape = np.full(3, 2 * round(max(24 * spacing, reach) / spacing) + 1)
    low = end.position - 0.5 * (shape - 1) * spacing
    # Lattice points lie off the middle, and tails are cut off at `TAIL_RADIUS`.
    scale = units.enlargement()
    deep = max(PASSABLE * scale, TAIL_RADIUS * scale - 0.5 * spacing)
    ijk, _ = geodesic.inside(depth, low, shape, spacing, deep)
    local = low + spacing * ijk - end.position
    along = local @ end.tangent
    aside = np.linalg.norm(local - along[:, None] * end.tangent, axis=1)
    behind = (along < 0.0) & (along > -2.0 * spacing) & (aside < 1.6 * radius + 2e-3)
    local, along = local[~behind], along[~behind]
    gap = np.where(along < -1e-9, np.inf, np.linalg.norm(local, axis=1))
    if gap.min(initial=np.inf) > radius + 2.0 * spacing:
        return np.empty((0, 3))
    pairs = cKDTree(local).query_pairs(1.8 * spacing, output_type="ndarray")
    label = groups(len(local), pairs)
    return local[label == label[gap.argmin()]] + end.position


def _goals(anatomy: Anatomy, measure: SurfaceDepth) -> Iterator[str]:
    for name, goal in anatomy.goals.items():
        line = anatomy.tree.vessel(goal.vessel).centreline
        off = float(np.linalg.norm(line.at(goal.arc_length).position - goal.position))
        if off > 1e-3:
            yield f"{name} lies {mm(off):.1f} mm from its place in {goal.vessel}"
        depths = anatomy.tree.depths(goal.position)
        best = max(depths, key=lambda key: float(depths[key]))
        if float(depths[goal.vessel]) < float(depths[best]) - 0.5e-3:
            yield f"{name} lies in {best}, not in {goal.vessel}"
        if not float(measure(goal.position)) > 0.0:
            yield f"{name} lies outside the lumen"


def _sizes(anatomy: Anatomy) -> Iterator[str]:
    volume = anatomy.surface.volume
    if not VOLUME[0] <= volume <= VOLUME[1]:
        yield (
            f"the lumen holds {volume * 1e6:.2g} ml (allowed {VOLUME[0] * 1e6:g} to "
            f"{VOLUME[1] * 1e6:g}): the unit is wrong"
        )
    unlikely = False
    for key, vessel in anatomy.tree.vessels.items():
        own = vessel.centreline.radii[vessel.centreline.arc_length >= vessel.ostium]
        middle = float(np.median(own))
        if not RADII[0] <= middle <= RADII[1] or own.max() > WIDEST:
            yield (
                f"{key} has a radius of {mm(middle):.3g} mm (median; allowed "
                f"{mm(RADII[0]):g} to {mm(RADII[1]):g})"
            )
            unlikely = True
    if unlikely:
        yield "the unit may be another one (--units)"


def _inlet(anatomy: Anatomy, measure: SurfaceDepth) -> Iterator[str]:
    inlet = anatomy.inlet
    place = anatomy.tree.vessel(inlet.vessel).centreline.project(inlet.position)
    if place.distance > place.radius:
        away = f"{mm(place.distance):.0f} mm from the centreline of {inlet.vessel}"
        yield f"it lies {away}"
    s = np.linspace(1e-3, max(2e-3, 0.5 * inlet.radius), 5)
    if measure(inlet.position + s[:, None] * inlet.direction).min() <= 0.0:
        yield "its direction does not lead into the lumen"


def _beginnings(anatomy: Anatomy) -> Iterator[str]:
    """Errors of branches that do not begin inside another vessel; none for scans."""
    vessels = {} if anatomy.scan else anatomy.tree.vessels
    for key, vessel in vessels.items():
        if vessel.parent is None:
            continue
        rim = on_walls(rings_of(vessel.centreline)[:1])
        depths = anatomy.tree.depths(rim).items()
        out = -float(np.max([x for name, x in depths if name != key], axis=0).min())
        if out > RIM_SLACK:
            start = shown(vessel.centreline.points[0])
            yield (
                f"the first cross-section of {key}, at {start}, lies "
                f"up to {mm(out):.2f} mm outside of {vessel.parent}: begin it deeper "
                "inside, or thinner"
            )


def _start(anatomy: Anatomy) -> Iterator[str]:
    for where, names in unreachable(anatomy).items():
        yield (
            f"{where}, where a device starts: {', '.join(names)} cannot be reached; "
            "choose another inlet"
        )


_CHECKS = {
    "centrelines in the lumen": _inside,
    "every vessel in a lumen of its own": _own_lumen,
    "branches on their parents": _parents,
    "branches of the arch on their sides": _sides,
    "vessels end at ends of the surface": _free_ends,
    "goals in their vessels": _goals,
    "inlet": _inlet,
}
_UNSCALED = {
    "sizes of vessels": _sizes,
    "start of the device": _start,
    "branches begin in other vessels": _beginnings,
}
