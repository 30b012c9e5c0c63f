"""The common trunk of a scan's right branches."""

from __future__ import annotations

import re
from collections.abc import Collection

from cathsim_dmc.anatomy.centreline import Vessel, VesselTree
from cathsim_dmc.anatomy.scan.centring import STEP
from cathsim_dmc.anatomy.scan.tree import ostium_of

TRUNK = "bca"  # name of the common trunk of the right branches
# Branches of which the brachiocephalic artery is the trunk.
_RIGHT = re.compile(
    r"(r|right_?)(cca|ica|eca|va|sa|sca|aa|(common_)?carotid\w*|vertebral\w*|subclavian\w*)(_\d+)?"
)


def name_trunk(tree: VesselTree, right: Collection[str] = ()) -> VesselTree:
    """Give the common trunk of right branches its name, the brachiocephalic artery.

    Where curves share a trunk, the trunk is part of one of them: the right carotid
    then leaves the right vertebral. If both are right branches, the part up to the
    first of them becomes a vessel of its own and the parent of both, and of the left
    carotid of a bovine arch, which leaves it before. Nothing changes if the trunk's
    name is taken or no two right branches share one.

    Args:
        tree: as it was grown.
        right: names of branches that are right ones, whatever they are called; others
            are known by their names.
    """
    root = tree.root.name
    if TRUNK in tree.vessels:
        return tree
    for name, vessel in tree.vessels.items():
        branches = [v for v in tree.vessels.values() if v.parent == name]
        names = [name, *(branch.name for branch in branches)]
        if vessel.parent != root or len(names) < 2:
            continue
        own = [key for key in names if key in right or _RIGHT.fullmatch(key)]
        if name not in own or len(own) < 2:
            continue
        line = vessel.centreline
        split = min(tree.origin(key) for key in own[1:])
        # Only the left carotid, of a bovine arch, leaves the trunk before it.
        others = set(names) - set(own)
        if any(key != "lcca" or tree.origin(key) > split for key in others):
            continue
        if not vessel.ostium + 2.0 * STEP < split < line.length - 2.0 * STEP:
            continue  # they part in the root's lumen, or at the curve's end
        trunk = line.slice(0.0, split)
        rest = line.slice(split, line.length)
        vessels = {}
        for key, other in tree.vessels.items():
            if key == name:
                vessels[TRUNK] = Vessel(TRUNK, trunk, root, vessel.ostium)
                vessels[key] = Vessel(key, rest, TRUNK, ostium_of(rest, trunk))
            elif other.parent == name and tree.origin(key) < split + STEP:
                own = other.centreline
                vessels[key] = Vessel(key, own, TRUNK, ostium_of(own, trunk))
            else:
                vessels[key] = other
        return VesselTree(vessels)
    return tree
