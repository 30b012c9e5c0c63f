"""Vessels of a lumen that are in no tree: where, how wide and how long."""

from typing import NamedTuple

import numpy as np

from cathsim_dmc.anatomy.centreline import VesselTree
from cathsim_dmc.anatomy.scan.extract import BRANCH
from cathsim_dmc.anatomy.scan.topology import groups
from cathsim_dmc.anatomy.scan.units import mm, shown
from cathsim_dmc.anatomy.scan.ways import CELL, Ways, in_reach

REACH = (1.2, 1e-3)  # radii and m from a centreline, up to which lumen is its vessel's
THIN = 10e-3  # m, least length of a vessel too thin for the device that is told
WIDE = 98.0  # percentile of the depths of a vessel that is its radius


class LeftOut(NamedTuple):
    """A vessel that is in no tree: a place (3,) in its middle, width, length; m."""

    position: np.ndarray
    width: float
    length: float


def left_out(ways: Ways, tree: VesselTree) -> list[LeftOut]:
    """Vessels longer than their own width that no vessel of a tree covers.

    Their length is counted from the lumen of the tree on, the longest is first.
    """
    lines = [vessel.centreline for vessel in tree.vessels.values()]
    centres = np.concatenate([line.points for line in lines])
    radii = np.concatenate([line.radii for line in lines])
    taken = in_reach(ways.points, centres, REACH[0] * radii + REACH[1])
    beyond = ways.main & ~taken
    links = ways.links[beyond[ways.links].any(axis=1)]
    if not len(links):
        return []
    gone, before = ways.out_of(taken, links)
    label = groups(len(beyond), links[beyond[links].all(axis=1)])
    label[~beyond] = -1
    found = []
    for key in np.flatnonzero(np.bincount(label[beyond]) > 1):
        own = np.flatnonzero(label == key)
        far = int(own[np.where(np.isfinite(gone[own]), gone[own], -1.0).argmax()])
        width = 2.0 * (float(np.percentile(ways.depth[own], WIDE)) + CELL)
        if gone[far] > width:
            way = ways.trace(before, far)
            middle = ways.points[way[len(way) // 2]]
            found.append(LeftOut(middle, width, float(gone[far])))
    return sorted(found, key=lambda one: -one.length)


def said(found: list[LeftOut], device: str, radius: float) -> str | None:
    """A note on vessels left out for a device with a radius (m), or None."""
    found = [one for one in found if one.width > 2.0 * radius or one.length > THIN]
    if not found:
        return None
    texts = []
    for one in found:
        why = "too short" if one.length < BRANCH else "narrow on the way to it"
        why = "too thin" if one.width <= 2.0 * (radius + CELL) else why
        texts.append(
            f"{shown(one.position)}, {mm(one.width):.1f} mm wide, "
            f"{mm(one.length):.0f} mm long ({why})"
        )
    count = "a vessel is" if len(found) == 1 else f"{len(found)} vessels are"
    return f"{count} left out for the {device}: {'; '.join(texts)}"
