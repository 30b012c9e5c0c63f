"""Polyhedral tubes around centrelines: rings of corners and the faces between them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cathsim_dmc.anatomy.centreline import Array, Centreline

# Depth of the wall, m: twice a 6F device's diameter, so nothing tunnels.
THICKNESS = 4e-3
# Height of a chord over the lumen surface, m; half of it stands in the lumen.
TOLERANCE = 0.35e-3
# How far a piece reaches past its sector on both sides, m, in the plane of its face
# and so behind its neighbours' faces. A device pressed hard on the seam would
# otherwise slip between two pieces, whose sides then clamp it.
OVERLAP = 1e-3
# Longest slab, m, and fewest sectors, whatever the tolerance allows.
_LONGEST_SLAB = 25e-3
_FEWEST_SECTORS = 7


@dataclass(frozen=True, eq=False)
class Tube:
    """Polyhedral tube: `inner` and `outer` corners (rings, sectors, 3), metres."""

    arc_length: Array
    centres: Array
    tangents: Array
    inner: Array
    outer: Array

    @cached_property
    def faces(self) -> tuple[Array, Array]:
        """Outward unit normals (slabs, sectors, 3) and offsets of the faces."""
        corners = self.face_corners(self.inner)
        a, b, c, d = (corners[..., i, :] for i in range(4))
        normal = np.cross(d - a, c - b)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        middle = 0.5 * (self.centres[:-1] + self.centres[1:])
        outward = corners.mean(axis=-2) - middle[:, None]
        normal *= np.sign(np.einsum("skj,skj->sk", normal, outward))[..., None]
        # A slightly warped face: the highest corner keeps the wall outside.
        return normal, np.einsum("skj,skcj->skc", normal, corners).max(axis=-1)

    @staticmethod
    def face_corners(rings: Array) -> Array:
        """Corners (slabs, sectors, 4, 3) between neighbouring rings and sectors.

        Neighbouring sectors overlap by `OVERLAP` in the planes of their faces.
        """
        first, second = widened(rings, np.roll(rings, -1, axis=1))
        return np.stack([first[:-1], second[:-1], first[1:], second[1:]], axis=2)

    @cached_property
    def reach(self) -> float:
        """Largest distance (m) of a lumen corner from its ring's centre."""
        return float(np.linalg.norm(self.inner - self.centres[:, None], axis=-1).max())

    @cached_property
    def line(self) -> Centreline:
        """Centres of the rings as a polyline; radii are the mean corner distances."""
        radii = np.linalg.norm(self.inner - self.centres[:, None], axis=-1)
        return Centreline(self.centres, radii.mean(axis=1))


def widened(first: Array, second: Array) -> tuple[Array, Array]:
    """Ends (..., 3) of segments made longer by `OVERLAP` on both sides."""
    along = second - first
    along *= OVERLAP / np.linalg.norm(along, axis=-1, keepdims=True)
    return first - along, second + along


def frames(tangents: Array) -> tuple[Array, Array]:
    """Rotation-minimising normals u, v (n, 3) along unit tangents (n, 3)."""
    axis = np.zeros(3)
    axis[np.abs(tangents[0]).argmin()] = 1.0
    u = np.empty_like(tangents)
    u[0] = np.cross(tangents[0], axis)
    u[0] /= np.linalg.norm(u[0])
    for i in range(1, len(tangents)):
        u[i] = u[i - 1] - (u[i - 1] @ tangents[i]) * tangents[i]
        u[i] /= np.linalg.norm(u[i])
    return u, np.cross(tangents, u)


@dataclass(frozen=True, eq=False)
class Shape:
    """Differential geometry of a centreline at its points."""

    line: Centreline
    tangents: Array
    bend: Array  # (n, 3) curvature vector c'', 1/m
    flare: Array  # (n,) r'', 1/m

    @classmethod
    def of(cls, line: Centreline) -> Shape:
        """Shape of a polyline, by finite differences."""
        s = line.arc_length
        segments = np.diff(line.points, axis=0)
        segments /= np.linalg.norm(segments, axis=1)[:, None]
        tangents = np.concatenate(
            [segments[:1], segments[:-1] + segments[1:], segments[-1:]]
        )
        tangents /= np.linalg.norm(tangents, axis=1)[:, None]
        edge_order = 2 if len(s) > 2 else 1
        bend = np.gradient(tangents, s, axis=0, edge_order=1)
        slope = np.gradient(line.radii, s, edge_order=edge_order)
        return cls(line, tangents, bend, np.gradient(slope, s, edge_order=1))

    def at(self, s: Array, values: Array) -> Array:
        """Values (n,) or (n, 3) at the points, interpolated at arc lengths `s`."""
        arc = self.line.arc_length
        if values.ndim == 1:
            return np.interp(s, arc, values)
        return np.stack([np.interp(s, arc, values[:, i]) for i in range(3)], axis=1)

    def ring_positions(self, start: float, tolerance: float) -> Array:
        """Arc lengths from `start` to the end, chords within `tolerance`."""
        r = self.line.radii
        curvature = np.linalg.norm(self.bend, axis=1)
        # On the outer side of a bend the surface is longer by 1 + r/R.
        surface = curvature * (1.0 + r * curvature) + np.abs(self.flare)
        density = np.maximum(np.sqrt(surface / (8.0 * tolerance)), 1.0 / _LONGEST_SLAB)
        s = self.line.arc_length
        steps = 0.5 * (density[1:] + density[:-1]) * np.diff(s)
        count = np.concatenate([[0.0], np.cumsum(steps)])
        first = float(np.interp(start, s, count))
        slabs = max(1, math.ceil(count[-1] - first - 1e-9))
        positions = np.interp(np.linspace(first, count[-1], slabs + 1), count, s)
        positions[0], positions[-1] = start, s[-1]
        return positions


def polyhedral_tube(
    line: Centreline,
    *,
    start: float = 0.0,
    radius: float | None = None,
    tolerance: float = TOLERANCE,
    thickness: float = THICKNESS,
) -> Tube:
    """Tube around `line` from arc length `start` (m) to its end.

    Args:
        line: centreline with lumen radii.
        start: first ring.
        radius: lumen radius (m) that decides the number of sectors; the largest
            of the line if None.
        tolerance: height (m) of a chord over the surface, along and around.
        thickness: distance (m) from the lumen to the outside of the wall; less on
            the inner side of a bend, where ring planes would cross.
    """
    shape = Shape.of(line)
    s = shape.ring_positions(start, tolerance)
    if radius is None:
        radius = float(line.radii.max())
    sectors = math.ceil(2.0 * math.pi * radius / math.sqrt(8.0 * radius * tolerance))
    sectors = max(sectors, _FEWEST_SECTORS)
    centres, radii, _ = line.at(s)
    tangents = shape.at(s, shape.tangents)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    u, v = frames(tangents)
    angle = 2.0 * math.pi * np.arange(sectors) / sectors
    spokes = np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None]
    # Half of each chord's height in, half out: around ...
    ring = 2.0 * radii / (1.0 + math.cos(math.pi / sectors))
    # ... and along: positive where the lumen bulges, so the corners move out.
    towards = np.einsum("rkj,rj->rk", spokes, shape.at(s, shape.bend))
    bulge = -towards * (1.0 - radii[:, None] * towards)
    bulge -= shape.at(s, shape.flare)[:, None]
    spacing = np.gradient(s) if len(s) > 2 else np.full(len(s), s[-1] - s[0])
    lift = np.clip(bulge * spacing[:, None] ** 2 / 16.0, -tolerance / 2, tolerance / 2)
    inner = ring[:, None] + lift
    # Ring planes cross at distance 1/|c''| on the inner side: stay short of it.
    limit = np.where(towards > 0.0, 0.9 / np.maximum(towards, 1e-9), np.inf)
    outer = inner + np.clip(limit - inner, 0.25e-3, thickness)
    return Tube(
        s,
        centres,
        tangents,
        centres[:, None] + inner[..., None] * spokes,
        centres[:, None] + outer[..., None] * spokes,
    )
