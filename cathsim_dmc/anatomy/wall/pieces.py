"""Convex wall pieces around a vessel tree: nothing in the lumen, no gap.

Each vessel becomes a polyhedral tube: ring planes across its centreline (closer
together where it bends or tapers) and sectors around it. A wall piece is the
convex hull of one face of the tube and the same face moved outwards. Where a
piece stands in the lumen of another vessel it is replaced by its parts outside
that vessel's tube; these are cut along the planes through the other vessel's
axis, so they are convex and share their boundaries.
"""

from __future__ import annotations

import math

import numpy as np

from cathsim_dmc.anatomy.centreline import Array, Centreline, VesselTree
from cathsim_dmc.anatomy.parts import INLET_HOLE_RADIUS, End
from cathsim_dmc.anatomy.tube import (
    THICKNESS,
    TOLERANCE,
    Tube,
    frames,
    polyhedral_tube,
    widened,
)
from cathsim_dmc.anatomy.wall.polytope import clip, clip_all, volume_and_width

# A branch has sectors enough for this share of its radius at the flared start.
_START_SHARE = 0.85
# A run of slabs may form one piece while the vessel bends less than this, rad.
_STRAIGHT = math.radians(1.0)
# Clearance (m) between a parent's lumen and the cut through a branch's piece, and
# how near, in radii, a ring must be to its parent for the cut to be looked for.
_MARGIN = 0.05e-3
_NEAR_PARENT = 2.0
# Pieces thinner than this (m) or smaller (m^3) are left out: no device passes the
# slit they would fill, and MuJoCo rejects meshes without volume.
_THINNEST = 0.02e-3
_SMALLEST = 1e-12


def _convex_run(tube: Tube) -> int:
    """Number of first slabs whose wall is convex along a straight axis."""
    line = tube.line
    slope = np.diff(line.radii) / np.diff(line.arc_length)
    run = 1
    while run < len(slope):
        turn = np.clip(tube.tangents[0] @ tube.tangents[run + 1], -1.0, 1.0)
        if math.acos(turn) > _STRAIGHT or slope[run] < slope[run - 1] - 1e-3:
            break
        run += 1
    return run


def _hulls(tube: Tube, first: int) -> list[list[Array]]:
    """Wall pieces of a tube by sector; the `first` slabs form one piece each."""
    sectors = tube.inner.shape[1]
    inner, outer = (Tube.face_corners(rings) for rings in (tube.inner, tube.outer))
    pieces: list[list[Array]] = []
    for k in range(sectors):
        column = []
        if first > 1:
            pair = [k, (k + 1) % sectors]
            near, far = widened(*np.moveaxis(tube.inner[: first + 1, pair], 1, 0))
            rings = np.concatenate([near, far])
            # The outside of the last ring, carried back along the straight axis.
            last = np.stack(widened(*tube.outer[first, pair]))
            shift = tube.centres[0] - tube.centres[first]
            column.append(np.concatenate([rings, last, last + shift]))
        for j in range(first if first > 1 else 0, len(tube.centres) - 1):
            column.append(np.concatenate([inner[j, k], outer[j, k]]))
        pieces.append(column)
    return pieces


def subtract(piece: Array, tube: Tube) -> list[Array]:
    """Parts of a convex piece (n, 3) outside the lumen of `tube`, all convex."""
    middle = piece.mean(axis=0)
    size = np.sqrt(((piece - middle) ** 2).sum(axis=1).max())
    nearest = tube.line.project(middle)
    if nearest.distance > size + tube.reach:
        return [piece]
    # Heights (rings, n) of the vertices over the ring planes.
    height = np.einsum("rj,rnj->rn", tube.tangents, piece[None] - tube.centres[:, None])
    touched = (height[:-1].max(axis=1) > 0.0) & (height[1:].min(axis=1) < 0.0)
    # A plane is meaningless far from its ring: keep the slabs near the piece.
    gap = np.abs(tube.line.arc_length - nearest.arc_length)
    touched &= np.minimum(gap[:-1], gap[1:]) < size + np.diff(tube.line.arc_length)
    slabs = np.flatnonzero(touched)
    if not len(slabs):
        return [piece]
    home = int(np.searchsorted(tube.line.arc_length, nearest.arc_length)) - 1
    home = min(max(home, slabs[0]), slabs[-1])
    axis = tube.centres[home + 1] - tube.centres[home]
    axis /= np.linalg.norm(axis)
    # Planes through the axis and the corners; sector k lies between k and k + 1.
    cuts = np.cross(axis, tube.inner[home] - tube.centres[home])
    cuts /= np.linalg.norm(cuts, axis=1)[:, None]
    levels = cuts @ tube.centres[home]
    normals, offsets = (values[slabs] for values in tube.faces)
    sectors = len(cuts)
    side = cuts @ piece.T - levels[:, None]
    parts: dict[int, Array] = {}
    blocked: set[int] = set()
    for k in range(sectors):
        ahead = (k + 1) % sectors
        if side[k].max() <= 1e-9 or side[ahead].min() >= -1e-9:
            continue
        part = clip(piece, cuts[k], levels[k])
        part = None if part is None else clip(part, -cuts[ahead], -levels[ahead])
        if part is None:
            continue
        parts[k] = part
        if (part @ normals[:, k].T - offsets[:, k]).min() < -1e-9:
            blocked.add(k)
    if not blocked:
        return [piece]
    out: list[Array | None] = []
    if slabs[0] == 0 and height[0].min() < -1e-9:
        out.append(clip(piece, -tube.tangents[0], -tube.tangents[0] @ tube.centres[0]))
    if slabs[-1] == len(tube.centres) - 2 and height[-1].max() > 1e-9:
        end = tube.tangents[-1]
        out.append(clip(piece, end, end @ tube.centres[-1]))
    out += [clip_all(parts[k], normals[:, k], offsets[:, k]) for k in blocked]
    # Free sectors side by side form one part while they span less than a half turn.
    free = [k for k in parts if k not in blocked]
    starts = [k for k in free if (k - 1) % sectors not in free]
    for first in starts or free[:1]:
        k = first
        while k in free:
            last = k
            while (last + 1) % sectors in free and (last + 1 - k) % sectors < (
                sectors // 2 - 1
            ):
                last = (last + 1) % sectors
            group = clip(piece, cuts[k], levels[k])
            ahead = (last + 1) % sectors
            if group is not None:
                out.append(clip(group, -cuts[ahead], -levels[ahead]))
            span = (last - k) % sectors + 1
            for done in range(span):
                free.remove((k + done) % sectors)
            k = ahead
    return [part for part in out if part is not None]


def _parent_cuts(tube: Tube, parent: Centreline) -> tuple[Array, Array]:
    """Planes that keep a branch's wall out of its parent's lumen.

    Each is parallel to the parent's wall where the sector leaves it, and just
    above what the piece has inside the parent. What is cut off beside the lumen is
    a sliver at the parent's wall, whose own pieces fill it.

    Returns:
        Unit normals (sectors, 3) out of the parent, and offsets (slabs, sectors),
        -inf where a piece stays clear of the parent.
    """
    parent = _nearby(parent, tube)
    middles = 0.5 * (tube.inner + np.roll(tube.inner, -1, axis=1))
    fine = np.linspace(0.0, 1.0, 33)[:-1, None, None, None]
    # (steps, slabs, sectors, 3), put in order along the tube
    path = middles[:-1] + fine * (middles[1:] - middles[:-1])
    ray = np.swapaxes(path, 0, 1).reshape(-1, *middles.shape[1:])
    nearest = parent.project(ray)
    leaves = (nearest.radius - nearest.distance < 0.0).argmax(axis=0)
    columns = np.arange(ray.shape[1])
    points = ray[leaves, columns]
    foot = parent.at(nearest.arc_length[leaves, columns]).position
    normals = points - foot
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    # A grid through each piece: along, around and outwards, (..., 25, 5, 7, 3).
    u, v, w = (np.linspace(0.0, 1.0, count) for count in (25, 5, 7))
    sides = []
    for rings in (tube.inner, tube.outer):
        corners = Tube.face_corners(rings)[..., None, None, :]
        first = corners[:, :, 0] + v[:, None] * (corners[:, :, 1] - corners[:, :, 0])
        last = corners[:, :, 2] + v[:, None] * (corners[:, :, 3] - corners[:, :, 2])
        first, last = first[:, :, 0, None], last[:, :, 0, None]
        sides.append(first + u[:, None, None] * (last - first))
    inner, outer = (side[..., None, :] for side in sides)
    grid = inner + w[:, None] * (outer - inner)
    offsets = np.full(grid.shape[:2], -np.inf)
    near = parent.project(middles.mean(axis=1)).distance < _NEAR_PARENT * (
        parent.radii.max() + tube.reach
    )
    for j in np.flatnonzero(near[:-1]):
        place = parent.project(grid[j])
        inside = place.distance < place.radius + _MARGIN
        height = np.einsum("k...j,kj->k...", grid[j], normals)
        height = np.where(inside, height, -np.inf).reshape(len(normals), -1)
        offsets[j] = height.max(axis=1) + _MARGIN
    return normals, offsets


def _nearby(parent: Centreline, tube: Tube) -> Centreline:
    """The part of a parent's centreline that a branch's wall can come near to."""
    start = parent.project(tube.centres)
    margin = _NEAR_PARENT * (parent.radii.max() + tube.reach + THICKNESS)
    near = start.distance < margin
    arcs = start.arc_length[near]
    return parent.slice(arcs.min() - margin, arcs.max() + margin)


def _ring_inside(line: Centreline, ostium: float, parent: Centreline) -> float:
    """Largest arc length up to `ostium` whose whole ring lies in the parent."""
    s = np.linspace(0.0, ostium, 65)
    place = line.at(s)
    u, v = frames(place.tangent)
    angle = np.linspace(0.0, 2.0 * math.pi, 17)[:-1]
    spokes = np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None]
    rings = place.position[:, None] + 1.05 * place.radius[:, None, None] * spokes
    nearest = parent.project(rings)
    inside = (nearest.distance < nearest.radius).all(axis=1)
    # The last ring of the first unbroken stretch inside.
    return float(s[max(0, (~inside).argmax() - 1)]) if not inside.all() else ostium


def _cap(end: End, thickness: float) -> list[Array]:
    """Disc that closes a flat end, or a ring of sectors around the inlet's hole."""
    u, v = (frame[0] for frame in frames(end.direction[None]))
    sectors = 12
    angle = 2.0 * math.pi * np.arange(sectors) / sectors
    spokes = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    # Circumscribed polygons: the rim covers the wall's thickness all around.
    stretch = 1.0 / math.cos(math.pi / sectors)
    rim = end.position + (end.radius + 0.5 * thickness) * stretch * spokes
    depth = thickness * end.direction
    if not end.open:
        return [np.concatenate([rim, rim + depth])]
    hole = end.position + INLET_HOLE_RADIUS * stretch * spokes
    pieces = []
    for k in range(sectors):
        pair = [k, (k + 1) % sectors]
        face = np.concatenate([hole[pair], rim[pair]])
        pieces.append(np.concatenate([face, face + depth]))
    return pieces


def tree_tubes(
    tree: VesselTree, *, tolerance: float = TOLERANCE, thickness: float = THICKNESS
) -> dict[str, Tube]:
    """Polyhedral tube of each vessel; branches start inside their parent."""
    tubes = {}
    for name, vessel in tree.vessels.items():
        line = vessel.centreline
        start, radius = 0.0, None
        if vessel.parent is not None:
            parent = tree.vessel(vessel.parent).centreline
            start = _ring_inside(line, vessel.ostium, parent)
            # The flare is short: let the calibre beyond it set the sectors, unless
            # chords around the wide start would become too high.
            calibre = np.median(line.radii[line.arc_length > vessel.ostium])
            radius = float(max(calibre, _START_SHARE * line.at(start).radius))
        tubes[name] = polyhedral_tube(
            line,
            start=start,
            radius=radius,
            tolerance=tolerance,
            thickness=thickness,
        )
    return tubes


def build_wall(
    tree: VesselTree,
    ends: tuple[End, ...] = (),
    *,
    tolerance: float = TOLERANCE,
    thickness: float = THICKNESS,
) -> tuple[Array, ...]:
    """Convex wall pieces (n_i, 3) around the lumen of `tree`, metres.

    Args:
        tree: vessels with smooth centrelines; a branch is straight where it
            crosses its parent's wall.
        ends: flat ends to close; an open one keeps a hole for the sheath.
        tolerance: height (m) of a chord over the lumen surface, along and around;
            half of it stands in the lumen.
        thickness: depth (m) of the wall.
    """
    tubes = tree_tubes(tree, tolerance=tolerance, thickness=thickness)
    wall: list[Array] = []
    for name, vessel in tree.vessels.items():
        tube = tubes[name]
        if vessel.parent is None:
            for column in _hulls(tube, 1):
                wall += _free_lumens(column, name, tree, tubes)
            continue
        run = _convex_run(tube)
        normals, offsets = _parent_cuts(tube, tree.vessel(vessel.parent).centreline)
        # The first piece of a column spans `run` slabs.
        offsets = np.concatenate([offsets[:run].max(axis=0)[None], offsets[run:]])
        for k, column in enumerate(_hulls(tube, run)):
            cut = [
                clip(piece, normals[k], level)
                for piece, level in zip(column, offsets[:, k], strict=True)
            ]
            pieces = [piece for piece in cut if piece is not None and _solid(piece)]
            wall += _free_lumens(pieces, name, tree, tubes)
    for end in ends:
        wall += _free_lumens(_cap(end, thickness), end.vessel, tree, tubes)
    return tuple(wall)


def _free_lumens(
    pieces: list[Array], name: str, tree: VesselTree, tubes: dict[str, Tube]
) -> list[Array]:
    """Cut the lumens of all vessels but `name` and its parent out of `pieces`."""
    whole = {id(piece) for piece in pieces}
    parts = list(pieces)
    for other, tube in tubes.items():
        if other in (name, tree.vessel(name).parent) or not parts:
            continue
        near = _near(parts, tube)
        parts = [
            part
            for piece, is_near in zip(parts, near, strict=True)
            for part in (subtract(piece, tube) if is_near else [piece])
        ]
    # Hulls as built are solid; only what was cut can be a sliver.
    return [part for part in parts if id(part) in whole or _solid(part)]


def _near(pieces: list[Array], tube: Tube) -> Array:
    """Whether pieces may reach into a tube, (n,) bool; most do not."""
    stops = np.cumsum([len(piece) for piece in pieces])
    points = np.concatenate(pieces)
    first = np.concatenate([[0], stops[:-1]])
    low, high = (ufunc.reduceat(points, first) for ufunc in (np.minimum, np.maximum))
    gap = tube.line.project(0.5 * (low + high)).distance
    return gap <= 0.5 * np.linalg.norm(high - low, axis=1) + tube.reach + 1e-6


def _solid(piece: Array) -> bool:
    volume, width = volume_and_width(piece)
    return volume > _SMALLEST and width > _THINNEST
