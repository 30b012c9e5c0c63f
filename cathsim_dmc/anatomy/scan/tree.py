"""Growth of a vessel tree from curves in a scan and an inlet."""

import re
from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy.centreline import Centreline, Vessel, VesselTree
from cathsim_dmc.anatomy.scan.centring import STEP, centred, resample, section_radii
from cathsim_dmc.anatomy.scan.naming import ROOT
from cathsim_dmc.anatomy.scan.ways import DEVICE_RADIUS, Ways
from cathsim_dmc.anatomy.surface_depth import SurfaceDepth

TAIL = 15e-3  # m, end of a centreline within which a narrow tail is cut off
# m, least radius of a vessel's end for a 5 Fr device: that of a 6 Fr device (1.0 mm)
# and a tenth; in proportion for others.
TAIL_RADIUS = 1.1e-3
END_TRIM = 8e-3  # m, most that is cut off before a blind end
TRUNKS = ("rsa", "lsa")  # keep the part shared with others, such as vertebral arteries
STEMS = ("bca", "lcca", "rcca")  # keep the part shared with unnamed vessels
PARTING = 0.01  # least growth of their distance by arc length where curves part
MIN_RADIUS = 0.1e-3  # m, least radius of a centreline that touches the wall
BCA = "bca"  # the common trunk of the right branches
# Branches of which the brachiocephalic artery is the trunk.
_RIGHT = re.compile(
    r"(r|right_?)(cca|ica|eca|va|sa|sca|aa|(common_)?carotid\w*|vertebral\w*|subclavian\w*)(_\d+)?"
)


def grow_tree(
    field: SurfaceDepth,
    ways: Ways,
    curves: dict[str, np.ndarray],
    inlet: np.ndarray,
    far: np.ndarray | None,
    drawn: bool,
) -> VesselTree:
    """Join curves (n, 3) m by name into one tree whose root starts at the inlet (3,) m.

    The root ends at `far` (3,) m, or where the last curve leaves it. Drawn curves may
    leave the deepest path and start anywhere; others are computed from the inlet on.
    """
    before = ways.deepest_from(ways.node(inlet))
    raw = {}
    for name, curve in curves.items():
        if drawn:
            way = ways.along(curve, name)
            lead = ways.points[ways.trace(before, ways.node(way[0]))]
            curve = np.concatenate([lead, way])
        raw[name] = resample(curve)
    if far is not None:
        root = resample(ways.points[ways.trace(before, ways.node(far))])
    else:
        root = _shared_beginning(list(raw.values()), field)
    root = _deep_start(root, field)
    tail = TAIL_RADIUS * (ways.device / DEVICE_RADIUS)
    lines, trunk = {ROOT: root}, _finish(field, root, None, tail)
    vessels = {ROOT: Vessel(ROOT, trunk)}
    first = TRUNKS if drawn else (*TRUNKS, *STEMS)
    ranks = {
        k: (k not in TRUNKS, k not in first, k != BCA, -_bulk(field, raw[k]))
        for k in raw
    }
    for name in sorted(raw, key=ranks.__getitem__):
        curve = raw[name]
        parent, at = _parent(curve, lines, vessels, field)
        trunk = vessels[parent].centreline
        anchor = trunk.at(trunk.project(curve[at]).arc_length).position
        own = resample(np.concatenate([anchor[None], curve[at + 1 :]]))
        line = _finish(field, own, anchor, tail)
        lines[name] = curve
        vessels[name] = Vessel(name, line, parent, ostium_of(line, trunk))
    # Vessels have the order of the files, parents first.
    ordered = {ROOT: vessels[ROOT]}
    while len(ordered) < len(vessels):
        for name in curves:
            if name not in ordered and vessels[name].parent in ordered:
                ordered[name] = vessels[name]
    return VesselTree(ordered)


def _bulk(field: SurfaceDepth, curve: np.ndarray) -> float:
    """Sum of depths along a curve; the larger of two branches is the parent."""
    return float(np.maximum(field(curve), 0.0).sum())


def _separation(
    curve: np.ndarray, depth: np.ndarray, other: np.ndarray, field: SurfaceDepth
) -> int:
    """Index of the last point of ``curve`` before it leaves ``other`` for good."""
    distance, nearest = cKDTree(other).query(curve)
    apart = distance > np.maximum(0.4 * depth, 1e-3)
    # The curves separate for good where a wall is between them: at a wide flat end, or
    # where two drawn curves begin, they may separate and meet again in one lumen.
    # Beyond the wall they may meet once more, in a ring of vessels.
    share = np.linspace(0.0, 1.0, 9)[1:-1, None, None]
    between = curve[apart] + share * (other[nearest] - curve)[apart]
    walled = apart.copy()
    walled[apart] = field(between).min(axis=0) < 0.0
    # A corner of the lumen that they cut before their first meeting does not count.
    walled[: int((~apart).argmax())] = False
    end = int(walled.argmax()) if walled.any() else len(curve)
    together = np.nonzero(~apart[:end])[0]
    first = min(int(together[-1]) + 1, len(curve) - 2) if len(together) else 0
    # Walks back to where the two still coincide, perhaps side by side.
    least = PARTING * STEP
    while first and distance[first] > max(0.5e-3, distance[first - 1] + least):
        first -= 1
    return min(first, len(curve) - 3)


def _parent(
    curve: np.ndarray,
    lines: Mapping[str, np.ndarray],
    vessels: Mapping[str, Vessel],
    field: SurfaceDepth,
) -> tuple[str, int]:
    """Vessel that a curve (n, 3) leaves last, and the index at which it does."""
    depth = field(curve)
    at = {key: _separation(curve, depth, line, field) for key, line in lines.items()}
    key = max(at, key=lambda name: at[name])
    # The wide vessel is the parent of curves that leave it side by side.
    while (vessel := vessels[key]).parent is not None:
        place = vessel.centreline.project(curve[at[key]])
        trunk = vessels[vessel.parent].centreline.project(curve[at[key]])
        # A branch that turns back towards the place is no nearer than its parent.
        if place.arc_length > vessel.ostium and place.distance < trunk.distance:
            break
        key = vessel.parent
    return key, at[key]


def _shared_beginning(curves: list[np.ndarray], field: SurfaceDepth) -> np.ndarray:
    """Part that the bulkiest curve shares with any other, or 60 % of it if alone."""
    longest = max(curves, key=lambda curve: _bulk(field, curve))
    others = [curve for curve in curves if curve is not longest]
    if not others:
        return longest[: max(4, int(0.6 * len(longest)))]
    depth = field(longest)
    shared = max(_separation(longest, depth, other, field) for other in others)
    return longest[: max(4, shared + 1)]


def _deep_start(curve: np.ndarray, field: SurfaceDepth) -> np.ndarray:
    """Cut off the beginning, up to where the lumen has its full width."""
    depth = field(curve)
    head = depth[: max(2, len(curve) // 3)]
    settled = depth >= 0.8 * np.maximum.accumulate(head)[min(15, len(head) - 1)]
    return curve[int(settled.argmax()) :]


def _finish(
    field: SurfaceDepth, curve: np.ndarray, anchor: np.ndarray | None, tail: float
) -> Centreline:
    """Centre a curve in the lumen, end it at a `tail` radius (m), measure its radii."""
    # Near a blind end the depth is the distance to the end, not to the side wall.
    last = min(len(curve) // 2, int(END_TRIM / STEP))
    deep = field(curve[-last:])
    wide = np.nonzero(deep >= 0.75 * deep.max())[0][-1]
    curve = curve[: len(curve) - last + wide + 1]
    points = centred(field, curve, fixed_start=anchor is not None)
    depth = field(points)
    # A tail that no device can follow is cut off; a stenosis farther up is kept.
    first = max(2, len(points) - int(TAIL / STEP))
    narrow = np.nonzero(depth[first:] < tail)[0]
    if narrow.size:
        points, depth = points[: first + narrow[0]], depth[: first + narrow[0]]
    radii = section_radii(field, points)
    return Centreline(points, np.maximum(radii, MIN_RADIUS))


def ostium_of(line: Centreline, trunk: Centreline) -> float:
    """Arc length (m) at which a branch leaves its parent's tube."""
    place = trunk.project(line.points)
    outside = place.distance > place.radius
    at = int(outside.argmax()) if outside.any() else len(outside) // 2
    return float(min(line.arc_length[at], 0.5 * line.length))


def name_trunk(tree: VesselTree, right: Collection[str] = ()) -> VesselTree:
    """Give the common trunk of right branches its name, the brachiocephalic artery.

    If two right branches, by their names or because they are in `right`, share a trunk,
    the trunk becomes a vessel of its own. It is the parent of both, and of the left
    carotid of a bovine arch, which leaves it before them.
    """
    root = tree.root.name
    if BCA in tree.vessels:
        return tree
    for name, vessel in tree.vessels.items():
        names = [name, *(key for key, v in tree.vessels.items() if v.parent == name)]
        own = [key for key in names if key in right or _RIGHT.fullmatch(key)]
        if vessel.parent != root or name not in own or len(own) < 2:
            continue
        if "rcca" in tree.vessels and "rcca" not in names:
            continue  # an aberrant subclavian artery with its vertebral one
        line = vessel.centreline
        split = min(tree.origin(key) for key in own[1:])
        # Only the left carotid, of a bovine arch, leaves the trunk before it.
        others = set(names) - set(own)
        if any(key != "lcca" or tree.origin(key) > split for key in others):
            continue
        if not vessel.ostium + 2.0 * STEP < split < line.length - 2.0 * STEP:
            continue  # they fork in the root's lumen, or at the curve's end
        trunk = line.slice(0.0, split)
        rest = line.slice(split, line.length)
        vessels = {}
        for key, other in tree.vessels.items():
            if key == name:
                vessels[BCA] = Vessel(BCA, trunk, root, vessel.ostium)
                vessels[key] = Vessel(key, rest, BCA, ostium_of(rest, trunk))
            elif other.parent == name and tree.origin(key) < split + STEP:
                ostium = ostium_of(other.centreline, trunk)
                vessels[key] = Vessel(key, other.centreline, BCA, ostium)
            else:
                vessels[key] = other
        return VesselTree(vessels)
    return tree


def with_root(tree: VesselTree, name: str) -> VesselTree:
    """The tree with its root renamed `name`."""
    old, vessels = tree.root.name, {}
    for key, vessel in tree.vessels.items():
        key = name if key == old else key
        parent = name if vessel.parent == old else vessel.parent
        vessels[key] = replace(vessel, name=key, parent=parent)
    return VesselTree(vessels)
