"""Vessels of a lumen that its tree leaves out: places, widths and lengths."""

from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.scan.extract import BRANCH
from cathsim_dmc.anatomy.scan.topology import groups
from cathsim_dmc.anatomy.scan.units import mm, shown
from cathsim_dmc.anatomy.scan.ways import CELL, Ways, in_reach

REACH = (1.2, 1e-3)  # radii and m from a centreline that its vessel covers
THIN = 10e-3  # m, least length of a reported vessel too thin for the device
SHORT = 2.0  # of its width: least length of a vessel, not a stub or an aneurysm
WIDE = 98.0  # percentile of the depths of a vessel that gives its radius


class LeftOut(NamedTuple):
    """A vessel that is in no tree: a place (3,) in its middle, width, length; m."""

    position: np.ndarray
    width: float
    length: float


def left_out(ways: Ways, tree: VesselTree) -> list[LeftOut]:
    """Vessels longer than their own width that no vessel of a tree covers.

    Lengths count from the lumen of the tree, or from that of a longer vessel that is
    left out. The longest comes first.
    """
    lines = [vessel.centreline for vessel in tree.vessels.values()]
    centres = np.concatenate([line.points for line in lines])
    radii = np.concatenate([line.radii for line in lines])
    taken = in_reach(ways.points, centres, REACH[0] * radii + REACH[1])
    before = ways.deepest_from(ways.node(tree.root.centreline.points[0]))
    found: list[LeftOut] = []
    while more := _beyond(ways, taken, before):
        for one, way in more:
            found.append(one)
            reach = REACH[0] * (ways.depth[way] + CELL) + REACH[1]
            free = np.flatnonzero(~taken)
            taken[free] = in_reach(ways.points[free], ways.points[way], reach)
    return sorted(found, key=lambda one: -one.length)


def _beyond(
    ways: Ways, taken: np.ndarray, before: np.ndarray
) -> list[tuple[LeftOut, np.ndarray]]:
    """Longest vessel, and its path, in each part of the lumen that is not `taken` (n,).

    Paths follow the predecessors `before` (n,).
    """
    beyond = ways.main & ~taken
    links = ways.links[beyond[ways.links].any(axis=1)]
    if not len(links):
        return []
    gone, near = ways.out_of(taken, links)
    label = groups(len(beyond), links[beyond[links].all(axis=1)])
    label[~beyond] = -1
    found = []
    for key in np.flatnonzero(np.bincount(label[beyond]) > 1):
        own = np.flatnonzero(label == key)
        far = int(own[np.where(np.isfinite(gone[own]), gone[own], -1.0).argmax()])
        way = ways.trace(before, far)
        way = way[label[way] == key]
        reach = REACH[0] * (ways.depth[way] + CELL) + REACH[1]
        around = own[in_reach(ways.points[own], ways.points[way], reach)]
        width = 2.0 * (float(np.percentile(ways.depth[around], WIDE)) + CELL)
        if gone[far] > width:
            path = ways.trace(near, far)
            middle = ways.points[path[len(path) // 2]]
            found.append((LeftOut(middle, width, float(gone[far])), way))
    return found


def said(
    found: list[LeftOut], device: str, radius: float, *, drawn: bool = False
) -> str | None:
    """A note on vessels left out for a device with a radius (m), or None.

    In a tree of `drawn` centrelines they are left out for want of one.
    """
    found = [one for one in found if one.width > 2.0 * radius or one.length > THIN]
    if not found:
        return None
    # Of vessels hardly longer than wide, such as bulges, only the longest is reported.
    short = [one for one in found if one.length < SHORT * one.width]
    long = [one for one in found if one.length >= SHORT * one.width]
    texts = [_told(one, radius, drawn) for one in long]
    if short:
        count = "stub" if len(short) == 1 else f"{len(short)} stubs, the longest"
        texts.append(f"{count} at {_told(short[0], radius, True)}")
    count = "a vessel is" if len(found) == 1 else f"{len(found)} vessels are"
    where = "of the drawn centrelines" if drawn else f"for the {device}"
    return f"{count} left out {where}: {'; '.join(texts)}"


def _told(one: LeftOut, radius: float, plain: bool) -> str:
    """Place and size of a vessel, and unless `plain`, why a device's tree lacks it."""
    text = f"{shown(one.position)}, {mm(one.width):.1f} mm wide, "
    text += f"{mm(one.length):.0f} mm long"
    why = "too short" if one.length < BRANCH else "narrow on the way to it"
    why = "too thin" if one.width <= 2.0 * (radius + CELL) else why
    return text if plain else f"{text} ({why})"
