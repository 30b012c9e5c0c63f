"""One branch of a parametric arch: take-off, flare and bends."""

import math
from dataclasses import dataclass

import numpy as np

from cathsim_dmc.anatomy.arch.parameters import BranchParameters
from cathsim_dmc.anatomy.centreline import Array, Centreline, Vessel

_CURVED_STEP = 2e-3
_FLARE_STEP = 0.5e-3
# A branch must leave its parent within this angle of the wall's normal, rad, and
# within this multiple of the parent's radius along its axis: an ostium more
# oblique than that is a slit.
_MOST_OBLIQUE = math.radians(60.0)
_LONGEST_EXIT = 2.2
# The second bend takes over within this length, m, so that no kink marks it.
_BLEND = 8e-3
_INTEGRATION_STEP = 0.5e-3  # m


@dataclass(frozen=True)
class Plane:
    """The plane of the arch: `along` the arch, `up`, and its `normal`, unit vectors.

    The normal points to the patient's right and back.
    """

    along: Array
    up: Array
    normal: Array

    @classmethod
    def turned(cls, rotation: float, tilt: float = 0.0) -> "Plane":
        """Vertical plane turned from the sagittal one, its top then tilted."""
        along = np.array([math.sin(rotation), math.cos(rotation), 0.0])
        side = np.cross([0.0, 0.0, 1.0], along)
        up = math.cos(tilt) * np.array([0.0, 0.0, 1.0]) + math.sin(tilt) * side
        return cls(along, up, np.cross(up, along))

    def to_world(self, flat: Array) -> Array:
        """World coordinates (..., 3) of in-plane ones (..., 2)."""
        return flat[..., :1] * self.along + flat[..., 1:] * self.up


def branch_vessel(
    name: str,
    p: BranchParameters,
    parent: Vessel,
    ostium: Array,
    direction: Array,
    plane: Plane,
    fillet: float,
) -> Vessel:
    """Branch of an arch.

    Args:
        p: its figures.
        parent: vessel that it leaves.
        ostium: (3,) m, on the parent's surface.
        direction: (3,) unit vector of its first part.
        fillet: growth (m) of its radius at the ostium.

    Raises:
        ValueError: if it is too oblique or too wide for its parent.
    """
    # Start where the axis, followed back into the parent, is nearest to the
    # parent's centreline; then aim from there at the ostium.
    line = parent.centreline
    back = np.linspace(0.0, 4.0, 400)[:, None] * float(line.project(ostium).radius)
    crossing = line.project(ostium - back * direction)
    place = line.at(crossing.arc_length[crossing.distance.argmin()])
    direction = ostium - place.position
    exit_length = float(np.linalg.norm(direction))
    direction = direction / exit_length
    outward = ostium - line.at(line.project(ostium).arc_length).position
    tilt = math.acos(np.clip(direction @ outward / np.linalg.norm(outward), -1.0, 1.0))
    inwards = _inwards(name, p.radius + fillet, exit_length, tilt, float(place.radius))
    flare_start = max(exit_length - inwards, 0.1 * exit_length)
    flare_end = exit_length + 2.0 * fillet + p.radius * math.tan(tilt)
    length = exit_length + p.length
    flare = 2 + int((flare_end - flare_start) / _FLARE_STEP)
    beyond = 2 + int((length - flare_end) / _CURVED_STEP)
    parts = (
        np.linspace(0.0, flare_start, 4),
        np.linspace(flare_start, flare_end, flare),
        np.linspace(flare_end, length, beyond),
    )
    s = np.unique(np.concatenate(parts))
    points = place.position + _path(p, s, direction, plane, flare_end + 6e-3, length)
    progress = np.clip((s - exit_length) / p.length, 0.0, 1.0)
    # Quadratic from the full fillet where the ring is inside the parent to none.
    u = np.clip((s - flare_start) / (flare_end - flare_start), 0.0, 1.0)
    radii = p.radius + (p.end_radius - p.radius) * progress + fillet * (1.0 - u) ** 2
    return Vessel(name, Centreline(points, radii), parent.name, exit_length)


def _inwards(
    name: str, wide: float, exit_length: float, tilt: float, parent_radius: float
) -> float:
    """How far (m) the flare reaches into the parent; ValueError if too far."""
    if tilt > _MOST_OBLIQUE or exit_length > _LONGEST_EXIT * parent_radius:
        raise ValueError(
            f"branch {name!r} leaves at {math.degrees(tilt):.0f} degrees from the "
            f"normal of its parent's wall, {exit_length * 1e3:.0f} mm from its "
            f"centreline; at most {math.degrees(_MOST_OBLIQUE):.0f} degrees and "
            f"{_LONGEST_EXIT * parent_radius * 1e3:.0f} mm are allowed. Change its "
            "take_off."
        )
    if wide > 0.95 * parent_radius:
        raise ValueError(
            f"branch {name!r} with its fillet has radius {wide:g} m at the ostium; its "
            f"parent's lumen radius is {parent_radius:g} m. Make the branch smaller."
        )
    sag = parent_radius - math.sqrt(parent_radius**2 - wide**2)
    # A bent parent needs more than this estimate for a straight one.
    return 1.25 * (sag + wide * math.tan(tilt)) + 1e-3


def _path(
    p: BranchParameters,
    s: Array,
    direction: Array,
    plane: Plane,
    bend_start: float,
    length: float,
) -> Array:
    """Points (n, 3) at arc lengths `s` of a branch that starts at the origin."""
    in_plane = np.cross(plane.normal, direction)
    in_plane /= np.linalg.norm(in_plane)
    if in_plane @ plane.along < 0.0:
        in_plane = -in_plane
    side = np.cross(direction, in_plane)
    side *= np.sign(side @ plane.normal) or 1.0
    bend = math.cos(p.bend_azimuth) * in_plane + math.sin(p.bend_azimuth) * side
    if p.second_bend_radius is None:
        turn = np.maximum(s - bend_start, 0.0) / p.bend_radius
        return (np.minimum(s, bend_start) + p.bend_radius * np.sin(turn))[
            :, None
        ] * direction + (p.bend_radius * (1.0 - np.cos(turn)))[:, None] * bend
    # Curvature in a frame that does not twist, integrated in small steps.
    count = max(2, math.ceil(length / _INTEGRATION_STEP))
    fine = np.linspace(0.0, length, count)
    middle = 0.5 * (bend_start + length)
    later = np.clip((fine - middle) / _BLEND + 0.5, 0.0, 1.0)
    first = (fine >= bend_start) * (1.0 - later) / p.bend_radius
    second = later / p.second_bend_radius
    angle = p.second_bend_azimuth
    tangent, u, v = direction, in_plane, side
    tangents = np.empty((len(fine), 3))
    step = fine[1] - fine[0]
    azimuth = p.bend_azimuth
    for i in range(len(fine)):
        tangents[i] = tangent
        curl_u = first[i] * math.cos(azimuth) + second[i] * math.cos(angle)
        curl_v = first[i] * math.sin(azimuth) + second[i] * math.sin(angle)
        tangent = tangent + step * (curl_u * u + curl_v * v)
        tangent = tangent / math.sqrt(tangent @ tangent)
        u = u - (u @ tangent) * tangent
        u = u / math.sqrt(u @ u)
        v = v - (v @ tangent) * tangent - (v @ u) * u
        v = v / math.sqrt(v @ v)
    steps = 0.5 * step * (tangents[1:] + tangents[:-1])
    points = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return np.stack([np.interp(s, fine, points[:, i]) for i in range(3)], axis=1)
