"""Velocity of blood at many places at once, compiled; see `flow`."""

import math

import numpy as np

from cathsim_dmc.anatomy.motion_loops import VALUES, WARP, carried, courses, warp
from cathsim_dmc.compiled import compiled

# Exponent of the profile across the lumen.
EXPONENT = 9
# Distance over which the flow of a vessel passes into that of its branch, m.
_BLEND = 5e-4
# Least ratio of the radii of lumen and link, for the friction along the link.
_LEAST_GAP = 1.2


@compiled
def profile(share):
    """Velocity over its mean at a share of the lumen's radius; 0 outside."""
    return (1.0 - share**EXPONENT) * (EXPONENT + 2) / EXPONENT if share < 1.0 else 0.0


@compiled
def moving_velocities(
    lattice, parameters, time, points, ends, radii, shares, ways, vessel, out
):
    """As `velocities`, where the vessel is at a time, s.

    Args:
        lattice: of `anatomy.motion.Motion`.
        parameters: of the motion.
        out: (P, 8): as there, and the velocity of the vessel's space, m/s.
    """
    values, there = np.empty((VALUES, 4)), np.empty((len(points), WARP))
    course = courses(parameters, time)
    for p in range(len(points)):
        x, y, z = points[p]
        warp(lattice, course, x, y, z, values, there[p])
    rest, growth = there[:, :3].copy(), there[:, 12].copy()
    velocities(rest, growth, ends, radii, shares, ways, vessel, out)
    for p in range(len(points)):
        row, at = out[p], there[p]
        if row[4] > 0.0:
            row[0], row[1], row[2], scale = carried(at, row[0], row[1], row[2])
            row[5], row[6], row[7], scale = carried(at, at[16], at[17], at[18])
            row[5:] /= scale


@compiled
def fill(found, speed, viscosity, radii, flowing, links):
    """Writes the parameters of links (N, L, 8), see `blood_loops.OF_LINK`.

    Args:
        found: (N, L, 8), of `velocities`.
        speed: (N,), pulse wave velocity, m/s.
        viscosity: (N,), Pa·s.
        radii: (L,), of the links, m.
        flowing: whether blood flows, and not only moves with the vessel.
        links: written.
    """
    for index in range(len(found)):
        for n in range(len(radii)):
            row, link = found[index, n], links[index, n]
            link[5:] = row[5:]
            if flowing:
                link[:3] = row[:3]
                link[3], link[4] = row[3] / speed[index], 0.0
                if row[4] > 0.0:
                    gap = max(row[4] / radii[n], _LEAST_GAP)
                    link[4] = 2.0 * math.pi * viscosity[index] / math.log(gap)


@compiled
def velocities(points, growth, ends, radii, shares, ways, vessel, out):
    """Writes velocity, way from the heart and radius of the lumen at some places.

    Args:
        points: (P, 3), m, in the vessel at rest.
        growth: (P,), of the radius of the lumen, m.
        ends: as the others, of `anatomy.circulation.Circulation`.
        radii: (S, 2), m.
        shares: (S, 2).
        ways: (S, 2), m.
        vessel: (S,).
        out: (P, 5 or more): velocity for an inflow of 1 m³/s, 1/m²; way, m; radius,
            m; 0 outside the lumen.
    """
    count = len(vessel)
    nearest = np.empty(vessel[-1] + 1)
    segment = np.empty(vessel[-1] + 1, np.int64)
    for p in range(len(points)):
        nearest[:] = np.inf
        k = 0
        while k < count:
            square = 0.0
            t = _place(points[p], ends[k])
            clipped = min(max(t, 0.0), 1.0)
            for i in range(3):
                there = (1.0 - clipped) * ends[k, 0, i] + clipped * ends[k, 1, i]
                square += (points[p, i] - there) ** 2
            v = vessel[k]
            if square < nearest[v]:
                nearest[v], segment[v] = square, k
            # So many of the next, no longer each than this one, are farther away.
            ahead = (math.sqrt(square) - math.sqrt(nearest[v])) * 0.999999
            step = int(ahead / abs(ways[k, 1] - ways[k, 0]))
            k += 1
            while step > 1 and k < count and vessel[k] == v:
                k, step = k + 1, step - 1
        out[p] = 0.0
        deepest = -np.inf
        for v in range(len(nearest)):
            k, t = segment[v], _place(points[p], ends[segment[v]])
            before = t < 0.0 and (k == 0 or vessel[k - 1] != v)
            after = t > 1.0 and (k == count - 1 or vessel[k + 1] != v)
            t = min(max(t, 0.0), 1.0)
            radius = growth[p] + (1.0 - t) * radii[k, 0] + t * radii[k, 1]
            # Depth in the tube of the vessel, none past its ends.
            nearest[v] = radius - math.sqrt(nearest[v])
            if before or after:
                nearest[v] = -np.inf
            deepest = max(deepest, nearest[v])
        total = 0.0
        if deepest <= 0.0:
            continue
        for v in range(len(nearest)):
            weight = math.exp((nearest[v] - deepest) / _BLEND)
            if weight < 1e-6:
                continue
            k = segment[v]
            t = min(max(_place(points[p], ends[k]), 0.0), 1.0)
            radius = growth[p] + (1.0 - t) * radii[k, 0] + t * radii[k, 1]
            length = 0.0
            for i in range(3):
                length += (ends[k, 1, i] - ends[k, 0, i]) ** 2
            speed = (1.0 - t) * shares[k, 0] + t * shares[k, 1]
            speed *= weight * profile(1.0 - nearest[v] / radius)
            speed /= math.pi * radius * radius * math.sqrt(length)
            for i in range(3):
                out[p, i] += speed * (ends[k, 1, i] - ends[k, 0, i])
            out[p, 3] += weight * ((1.0 - t) * ways[k, 0] + t * ways[k, 1])
            out[p, 4] += weight * radius
            total += weight
        out[p] /= total


@compiled
def _place(point, ends):
    """Place of a point along a segment, 0 at its start and 1 at its end."""
    along, square = 0.0, 0.0
    for i in range(3):
        way = ends[1, i] - ends[0, i]
        along += (point[i] - ends[0, i]) * way
        square += way * way
    return along / square
