"""Inlet, goals and ends of the tree of a scan, and measures of an anatomy."""

from typing import Any

import numpy as np

from cathsim_dmc.anatomy.anatomy import Anatomy
from cathsim_dmc.anatomy.centreline import Vessel, VesselTree
from cathsim_dmc.anatomy.parts import End, Goal, Inlet, Surface
from cathsim_dmc.anatomy.scan.topology import adjacent, groups, used
from cathsim_dmc.anatomy.scan.units import shown
from cathsim_dmc.anatomy.scan.ways import DEVICE_RADIUS
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

GOAL_PAST_OSTIUM = 30e-3  # m along a branch, its first goal
GOAL_DISTAL = 0.8  # of the passable part of a branch, its second goal
ROOT_REST = 3.0  # radii, least length of a root past its last branch that has a goal
INLET_WIDTH = 0.8  # of the width near a blind end, which is cut off up to there
INLET_SEARCH = 40e-3  # m of the root over which that width is taken
# m, by which a goal may lie deeper in another vessel than in its own, a little less
# than `check` allows; and the step, m, of the search for a place where it does not.
DEEPER, MOVE = 0.4e-3, 1e-3
SHARES = (1.0, 0.6, 0.3)  # of a blind end to cut off at the inlet, tried in order


def passable_length(vessel: Vessel, device: float = DEVICE_RADIUS) -> float:
    """Arc length (m) up to which a device of a radius (m) fits a vessel."""
    line = vessel.centreline
    narrow = (line.radii < device) & (line.arc_length > vessel.ostium)
    return float(line.arc_length[narrow.argmax()] if narrow.any() else line.length)


def place_inlet(
    tree: VesselTree, at_end: bool, share: float
) -> tuple[VesselTree, Inlet]:
    """Start the root where the lumen has its width, or at a share of that length."""
    name, line = tree.root.name, tree.root.centreline
    if at_end:
        near = line.arc_length <= min(INLET_SEARCH, 0.3 * line.length)
        wide = INLET_WIDTH * np.median(line.radii[near])
        first = int((line.radii >= wide).argmax())
        # Farther by that radius, as the end of a vessel may be oblique.
        start = float(line.arc_length[first] + INLET_WIDTH * line.radii[first])
        line = line.slice(start * share, line.length)
    place = line.at(0.0)
    ahead = line.at(min(3.0 * float(place.radius), 0.5 * line.length)).position
    opening = Inlet(name, place.position, ahead - place.position, float(place.radius))
    return VesselTree({**tree.vessels, name: Vessel(name, line)}), opening


def cut_open(
    vertices: np.ndarray, faces: np.ndarray, inlet: Inlet
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a closed surface across the inlet and drop what lies behind it.

    Only the ring of triangles around the inlet is cut: a bent vessel may meet the
    inlet's plane again elsewhere. ValueError if that does not part the lumen in two.

    Returns:
        (vertices (W, 3) m, faces that stay (n, 3), faces of the flat cap (m, 3)).
    """
    side = (vertices - inlet.position) @ inlet.direction
    side = np.where(np.abs(side) < 1e-9, 1e-9, side)
    front: np.ndarray = np.asarray(side[faces] > 0.0)
    crossing: np.ndarray = np.asarray(front.any(axis=1) & ~front.all(axis=1))
    pairs = adjacent(faces)
    label = groups(len(faces), pairs[crossing[pairs].all(axis=1)])
    # The plane may cut several rings; the one around the inlet has the least mean
    # distance. The least distance may be that of a neighbouring vessel.
    away = np.linalg.norm(vertices[faces].mean(axis=1) - inlet.position, axis=1)
    count = np.bincount(label, crossing)
    mean = np.bincount(label, crossing * away) / np.where(count > 0, count, np.nan)
    ring = crossing & (label == np.nanargmin(mean))
    # A triangle beside the ring lies wholly on one side of the plane.
    label = groups(len(faces), pairs[~ring[pairs].any(axis=1)])
    beside = pairs[ring[pairs].sum(axis=1) == 1]
    beside = beside[~ring[beside]]
    gone = np.unique(label[beside[~front[beside, 0]]])
    stay = np.unique(label[beside[front[beside, 0]]])
    if np.intersect1d(gone, stay).size or not stay.size:
        raise ValueError(
            f"the lumen cannot be cut at {shown(inlet.position)}: both sides stay "
            "connected. Choose an inlet on a single vessel."
        )
    # Of each triangle that is cut, p is the corner that is alone on its side, x and y
    # are the cuts of the edges to q and from r.
    ahead = front[ring]
    odd = np.where(ahead.sum(axis=1) == 1, ahead.argmax(axis=1), ahead.argmin(axis=1))
    p, q, r = np.take_along_axis(faces[ring], (odd[:, None] + [0, 1, 2]) % 3, axis=1).T
    edges = np.sort(np.stack([np.append(p, p), np.append(q, r)], axis=1), axis=1)
    edges, numbers = np.unique(edges, axis=0, return_inverse=True)
    start, end = edges.T
    share = (side[start] / (side[start] - side[end]))[:, None]
    fresh = vertices[start] + share * (vertices[end] - vertices[start])
    x, y = len(vertices) + numbers.reshape(2, -1)
    alone = side[p] > 0.0
    pieces = [
        np.stack([p, x, y], axis=1)[alone],
        np.stack([x, q, r], axis=1)[~alone],
        np.stack([x, r, y], axis=1)[~alone],
    ]
    points = np.concatenate([vertices, fresh, fresh.mean(axis=0)[None]])
    shell = np.concatenate([faces[~ring & ~np.isin(label, gone)], *pieces])
    centre = np.full(len(p), len(points) - 1)
    cap = np.stack([np.where(alone, y, x), np.where(alone, x, y), centre], axis=1)
    return points, shell, cap


def place_goals(
    tree: VesselTree, device: float = DEVICE_RADIUS, scale: float = 1.0
) -> dict[str, Goal]:
    """One goal past the ostium of each branch and one far along it, by name.

    The root has one past its last branch, or none if it ends in its branches. A device
    with a radius (m) can reach all of them. A goal that would lie in the ostium of
    another vessel is moved; `scale` is the enlargement of the tree while it grew.
    """
    goals = {}
    for key, vessel in tree.vessels.items():
        if vessel.parent is None:
            continue
        reach = passable_length(vessel, device) - vessel.ostium
        first = vessel.ostium + min(GOAL_PAST_OSTIUM, 0.5 * reach)
        places = {key: first}
        if GOAL_DISTAL * reach > 1.3 * (first - vessel.ostium):
            places[f"{key}_distal"] = vessel.ostium + GOAL_DISTAL * reach
        end = vessel.ostium + reach
        for name, s in places.items():
            s = _in_own_lumen(tree, vessel, s, (vessel.ostium, end), DEEPER / scale)
            goals[name] = Goal(name, key, vessel.centreline.at(s).position, float(s))
    root = tree.root
    last = max(
        (tree.origin(k) for k, v in tree.vessels.items() if v.parent == root.name),
        default=0.0,
    )
    rest = passable_length(root, device) - last
    s = last + GOAL_DISTAL * rest
    if rest > ROOT_REST * float(root.centreline.at(max(s, 0.0)).radius):
        place = root.centreline.at(s).position
        goals[root.name] = Goal(root.name, root.name, place, float(s))
    return goals


def _in_own_lumen(
    tree: VesselTree, vessel: Vessel, s: float, limits: tuple[float, float], more: float
) -> float:
    """Arc length, m, nearest to `s` at which no other vessel is deeper by `more`, m.

    The search is within `limits`, m; it returns `s` if there is none.
    """
    line, (low, high) = vessel.centreline, limits

    def own(places: np.ndarray) -> np.ndarray:
        depths = tree.depths(line.at(places).position)
        return np.asarray(depths[vessel.name] >= np.max([*depths.values()], 0) - more)

    if own(np.array([s]))[0]:
        return s
    steps = np.arange(low, high, MOVE)
    steps = steps[own(steps)]
    return float(steps[np.abs(steps - s).argmin()]) if len(steps) else s


def flat_ends(tree: VesselTree, opening: Inlet) -> tuple[End, ...]:
    """The open inlet, and capped ends of all vessels that do not end in branches."""
    ends = [
        End(opening.vessel, opening.position, -opening.direction, opening.radius, True)
    ]
    for key, vessel in tree.vessels.items():
        length = vessel.centreline.length
        branches = [k for k, v in tree.vessels.items() if v.parent == key]
        if any(tree.origin(k) > length - 1e-6 for k in branches):
            continue  # the vessel ends in its branches
        place = vessel.centreline.at(length)
        ends.append(End(key, place.position, place.tangent, float(place.radius), False))
    return tuple(ends)


def resized(
    tree: VesselTree, inlet: Inlet, surface: Surface, factor: float
) -> tuple[VesselTree, Inlet, Surface]:
    """A tree, its inlet and its surface, scaled by `factor`."""
    if factor == 1.0:
        return tree, inlet, surface
    inlet = Inlet(
        inlet.vessel, factor * inlet.position, inlet.direction, factor * inlet.radius
    )
    surface = Surface(factor * surface.vertices, surface.faces)
    return tree.scaled(factor), inlet, surface


def describe(anatomy: Anatomy, device: float = DEVICE_RADIUS) -> dict[str, Any]:
    """Measures of an imported anatomy as JSON values, lengths in millimetres.

    `passable_mm` is the length up to which a device with a radius (m) passes.
    """
    vessels, goals, inlet = {}, {}, anatomy.inlet
    for key, vessel in anatomy.tree.vessels.items():
        line = vessel.centreline
        own = line.radii[line.arc_length >= vessel.ostium]
        vessels[key] = {
            "parent": vessel.parent,
            "length_mm": round(line.length * 1e3, 1),
            "ostium_mm": round(vessel.ostium * 1e3, 1),
            "median_radius_mm": round(float(np.median(own)) * 1e3, 2),
            "passable_mm": round(passable_length(vessel, device) * 1e3, 1),
        }
    for key, goal in anatomy.goals.items():
        route = anatomy.route(key)
        goals[key] = {
            "vessel": goal.vessel,
            "route_mm": round(route.length * 1e3, 1),
            "narrowest_radius_mm": round(float(route.radii.min()) * 1e3, 2),
        }
    return {
        "name": anatomy.name,
        "surface_triangles": len(anatomy.surface.faces),
        "volume_ml": round(anatomy.surface.volume * 1e6, 1),
        "inlet": {
            "vessel": inlet.vessel,
            "position_mm": np.round(inlet.position * 1e3, 1).tolist(),
            "radius_mm": round(inlet.radius * 1e3, 2),
        },
        "vessels": vessels,
        "goals": goals,
    }


def opened_at_inlet(
    tree: VesselTree, at_end: bool, surface: Surface
) -> tuple[VesselTree, Inlet, Surface]:
    """The tree from its inlet on, the inlet, and the surface cut there."""
    # Less is cut off where the plane of the inlet would meet a branch.
    for share in SHARES if at_end else SHARES[:1]:
        opened, inlet = place_inlet(tree, at_end, share)
        last = not at_end or share == SHARES[-1]
        try:
            points, shell, cap = cut_open(surface.vertices, surface.faces, inlet)
        except ValueError:
            if last:
                raise
            continue
        vertices, faces = used(points, np.concatenate([shell, cap]))
        cut = Surface(vertices, faces)
        tips = [vessel.centreline.points[-1] for vessel in opened.vessels.values()]
        begun = [v.centreline.points[0] for v in opened.vessels.values() if v.parent]
        depths = SurfaceDepth(cut)(np.array([*tips, *begun]))
        if (depths > 0.0).all():
            break
        floors = np.append(np.full(len(tips), -inlet.radius), np.zeros(len(begun)))
        gone = np.flatnonzero(depths <= floors)
        if last and len(gone):
            where = shown([*tips, *begun][gone[-1]])
            raise ValueError(
                f"a branch is cut off at {where} with the end of the lumen, for the "
                f"inlet at {shown(inlet.position)}. Choose an inlet farther from it "
                f"(inlet; --inlet X Y Z), such as {', '.join(map(shown, tips[:8]))}."
            )
    return opened, inlet, cut
