"""Branches as they leave an aorta: their ostia, calibres and forks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cathsim_dmc.anatomy.centreline import arc_lengths
from cathsim_dmc.anatomy.scan.aorta import Bend
from cathsim_dmc.anatomy.scan.centring import resample
from cathsim_dmc.anatomy.scan.topology import groups
from cathsim_dmc.anatomy.scan.ways import CELL, Ways

OUT = 1.15  # radii of the aorta beyond which a branch has left it
SHARED = 3e-3  # m beyond that, which curves of one branch share
NEAR = 95e-3  # m of aorta to both sides of the top of the arch that has its branches
CALIBRE = (4e-3, 16e-3)  # m past the ostium between which a calibre is taken
STUB = 4e-3  # m, least height of a branch that was cut short
STUB_OUT = (1.2, 1.5e-3)  # radii and m beyond which lumen is that of a stub
STUB_RADIUS = 1.2e-3  # m
STUB_END = 2.5  # radii from an end of the aorta
STUB_APART = 45e-3  # m of aorta, at most, to the nearest branch
STUB_WIDE = 30e-3  # m along the aorta: wider ones are no stub


@dataclass(frozen=True)
class Offshoot:
    """A branch of the arch, with all that it leads to.

    Attributes:
        place: (3,) m, where it leaves the lumen of the aorta.
        s: m, arc length of the aorta there.
        radius: m, of its lumen beyond that.
        curves: rows of the computed centrelines in it; none if it was cut short.
        fork: m past the ostium, first place at which it parts, or None.
        rows: (n_i, 3) m, of each of its curves the part from the ostium on.
    """

    place: np.ndarray
    s: float
    radius: float
    curves: tuple[int, ...]
    fork: float | None
    rows: tuple[np.ndarray, ...]


def offshoots(
    ways: Ways, bend: Bend, depth: np.ndarray, curves: Sequence[np.ndarray]
) -> list[Offshoot]:
    """Branches of an arch, in their order along the line of its aorta.

    Args:
        ways: of the lumen.
        bend: of the aorta.
        depth: (n,) m, of the points of its line.
        curves: (m_i, 3) m, computed centrelines, from an end of the aorta on.
    """
    aorta = cKDTree(bend.line)
    out: list[tuple[list[int], list[np.ndarray], int]] = []
    for number, curve in enumerate(curves):
        distance, near = aorta.query(curve)
        inside = np.flatnonzero(distance < OUT * depth[near])
        start = int(inside[-1]) + 1 if len(inside) else 0
        if start >= len(curve) - 2:
            continue
        row, at = curve[start:], int(near[start])
        for members, rows, _ in out:
            shared = rows[0][: common(rows[0], row)]
            apart = np.linalg.norm(rows[0][0] - row[0])
            # They leave in one lumen, even if they part at once.
            if apart < depth_of(ways, rows[0][:1])[0] or (
                len(shared) > 1 and arc_lengths(shared)[-1] > SHARED
            ):
                members.append(number)
                rows.append(row)
                break
        else:
            out.append(([number], [row], at))
    found = [
        Offshoot(
            rows[0][0],
            1e-3 * at,
            _calibre(ways, rows[0], fork := _fork(rows)),
            tuple(members),
            fork,
            tuple(rows),
        )
        for members, rows, at in out
        if max((row[-1] - row[0]) @ bend.up for row in rows) > 0.0
    ]
    near = [one.s for one in found]
    found += [
        one
        for one in _stubs(ways, bend, depth, curves, aorta)
        if near and min(abs(one.s - s) for s in near) < STUB_APART
    ]
    found = [f for f in found if abs(f.s - 1e-3 * bend.apex) < NEAR]
    return sorted(found, key=lambda f: f.s)


def common(one: np.ndarray, other: np.ndarray) -> int:
    """How many first points two curves share."""
    count = min(len(one), len(other))
    same = (one[:count] == other[:count]).all(axis=1)
    return count if same.all() else int(same.argmin())


def depth_of(ways: Ways, line: np.ndarray) -> np.ndarray:
    """Radius (n,) m of the lumen at nodes (n, 3) of the lattice."""
    return ways.depth[[ways.node(point) for point in line]] + CELL


def _fork(rows: Sequence[np.ndarray]) -> float | None:
    shares = [
        arc_lengths(one)[min(common(one, other), len(one) - 1)]
        for k, one in enumerate(rows)
        for other in rows[k + 1 :]
    ]
    return float(min(shares)) if shares else None


def _calibre(ways: Ways, row: np.ndarray, fork: float | None) -> float:
    s = arc_lengths(row)
    first = min(CALIBRE[0], 0.3 * s[-1])
    last = min(CALIBRE[1], max(first + 2e-3, fork or np.inf))
    part = row[(s >= first) & (s <= last)]
    return float(np.median(depth_of(ways, part if len(part) else row)))


def _stubs(ways, bend, depth, curves, aorta) -> list[Offshoot]:
    """Branches that were cut short: lumen that rises from the aorta's wall."""
    nodes = ways.nodes
    distance, near = aorta.query(ways.points[nodes], distance_upper_bound=60e-3)
    there = np.isfinite(distance)
    nodes, distance, near = nodes[there], distance[there], near[there]
    wide = depth[near]
    outside = distance > STUB_OUT[0] * wide + STUB_OUT[1]
    # Nothing at the aorta's own ends, into whose corners its line leads.
    from_end = 1e-3 * np.minimum(near, len(bend.line) - 1 - near)
    outside &= from_end > STUB_END * wide
    row = np.full(len(ways.points), -1)
    row[nodes[outside]] = np.arange(int(outside.sum()))
    height, at = (distance - wide)[outside], near[outside]
    points, radius = ways.points[nodes[outside]], ways.depth[nodes[outside]]
    if not len(points):
        return []
    one, other = ways.links
    linked = (row[one] >= 0) & (row[other] >= 0)
    pairs = np.stack([row[one[linked]], row[other[linked]]], axis=1)
    label = groups(len(points), pairs)
    known = cKDTree(np.concatenate([resample(curve) for curve in curves]))
    taken = np.unique(label[known.query(points)[0] < 1.2e-3])
    found = []
    for key in np.setdiff1d(np.unique(label), taken):
        among = np.flatnonzero(label == key)
        span = 1e-3 * float(np.ptp(at[among]))
        top = among[height[among].argmax()]
        low = among[height[among].argmin()]
        rise = (points[top] - bend.line[at[low]]) @ bend.up
        if (
            height[top] > STUB
            and radius[among].max() > STUB_RADIUS
            and span < STUB_WIDE
            and rise > 0.0
        ):
            calibre = float(radius[among].max()) + CELL
            found.append(Offshoot(points[low], 1e-3 * at[low], calibre, (), None, ()))
    return found
