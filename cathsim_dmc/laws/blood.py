"""Drag of blood on the links of a device.

Across its axis, a link of length l and diameter d has the drag ½ ρ d l C_d |u| u, with
the velocity u of the blood across the axis, Re = ρ|u|d/µ and C_d = 1.18 + 6.8 / Re^0.89
+ 1.96 / √Re - 0.0004 Re / (1 + 3.64e-7 Re²) (Sucker and Brauer 1975, Wärme- und
Stoffübertragung 8, 149; Re from 1e-4 to 2e5). Along its axis, the drag is the friction
in the annular gap (`physics.flow`).
"""

import math
from typing import Any, NamedTuple

from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.heart import BEAT, place_in
from cathsim_dmc.laws.parameters import Array


class Blood(NamedTuple):
    """Blood around the links.

    Its velocity at time t is `velocity` peak beat(rate (t - delay) + phase), or
    `velocity` if `peak` is 0, plus `space_velocity`.

    Attributes:
        density: kg/m³.
        viscosity: Pa·s; 0 for no blood.
        peak: Factor of all velocities at the peak of a beat, 0 for a steady flow.
        rate: Heart rate, 1/s.
        phase: Phase of the heart at time 0, in beats.
        velocity: (L, 3), velocity of the blood at each link, m/s at a factor of 1.
        delay: (L,), delay of the beat at each link, s.
        friction: (L,), axial friction per length and velocity, N·s/m².
        space_velocity: (L, 3), velocity of the moving vessel's space, m/s.
    """

    density: Any
    viscosity: Any
    peak: Any
    rate: Any
    phase: Any
    velocity: Any = Array("links", 3)
    delay: Any = Array("links")
    friction: Any = Array("links")
    space_velocity: Any = Array("links", 3)


@compiled
def beat(phase):
    """Inflow of the aorta at a phase in beats, relative to its peak."""
    first, share = place_in(phase, len(BEAT))
    return (1.0 - share) * BEAT[first] + share * BEAT[first + 1]


@compiled
def cross_drag(blood, speed, radius, length):
    """Drag across a link divided by the speed (m/s) of the blood across it, N·s/m."""
    reynolds = blood.density * speed * 2 * radius / blood.viscosity
    # ½ Re C_d, which is 0 at rest.
    drag = (0.59 - 2e-4 * reynolds / (1 + 3.64e-7 * reynolds**2)) * reynolds
    drag += 3.4 * reynolds**0.11 + 0.98 * math.sqrt(reynolds)
    return drag * (blood.viscosity * length)


@compiled
def drag(blood, time, device):
    """Adds the drag to the generalised forces of a device.

    Args:
        blood: `Blood`.
        time: s.
        device: `device.Device`.
    """
    if blood.viscosity == 0.0:
        return
    pole, factor = device.subtree_com[0], 1.0
    phase = blood.rate * time + blood.phase
    # Force of all links from here to the end, and its torque about the pole.
    fx = fy = fz = tx = ty = tz = 0.0
    for link in range(len(blood.delay) - 1, -1, -1):
        flow, carried = blood.velocity[link], blood.space_velocity[link]
        radius, half, _ = device.geom_size[device.geoms[link]]
        spin, axes = device.cvel[link], device.xmat[link]
        place = device.xipos[link]
        x, y, z = place[0] - pole[0], place[1] - pole[1], place[2] - pole[2]
        if blood.peak != 0.0:
            factor = blood.peak * beat(phase - blood.rate * blood.delay[link])
        u = factor * flow[0] + carried[0] - spin[3] - spin[1] * z + spin[2] * y
        v = factor * flow[1] + carried[1] - spin[4] - spin[2] * x + spin[0] * z
        w = factor * flow[2] + carried[2] - spin[5] - spin[0] * y + spin[1] * x
        along = u * axes[2] + v * axes[5] + w * axes[8]
        u, v, w = u - along * axes[2], v - along * axes[5], w - along * axes[8]
        across = cross_drag(blood, math.sqrt(u * u + v * v + w * w), radius, 2 * half)
        u, v, w = across * u, across * v, across * w
        along *= blood.friction[link] * 2 * half
        u, v, w = u + along * axes[2], v + along * axes[5], w + along * axes[8]
        fx, fy, fz = fx + u, fy + v, fz + w
        tx, ty, tz = tx + y * w - z * v, ty + z * u - x * w, tz + x * v - y * u
        first = device.body_dofadr[link]
        for dof in range(first, first + device.body_dofnum[link]):
            way = device.cdof[dof]
            force = way[0] * tx + way[1] * ty + way[2] * tz
            device.qfrc_passive[dof] += force
            force = way[3] * fx + way[4] * fy + way[5] * fz
            device.qfrc_passive[dof] += force
