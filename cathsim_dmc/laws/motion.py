"""Motion of a vessel: how heart and breathing displace space.

A point x in space corresponds to the point X = x - u(x, t) of the vessel at rest, with
u = a(t) H(x) + b(t) B(x). The radius of the lumen grows by g(x) r(t) p(t - s(x)/c),
with the distance s from the heart and the velocity c of the pulse wave. H, B, g and s
are sampled on a lattice (`anatomy.motion.Motion`) and trilinear between its points.
docs/vessel_model.md has the course in time and its sources.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from cathsim_dmc.compiled import inlined, law
from cathsim_dmc.laws.heart import SYSTOLE, pulse

# Numbers in the head of a lattice: origin (3) m, step m, shape (3). Its values follow.
HEAD = 7
# Values at a point: displacement by the heart (3) and by breathing (3) at amplitude 1,
# m, growth of the radius, m·kPa, and distance from the heart, m.
VALUES = 8
# Numbers of `warp`: place at rest (3), its gradient (9) row by row, growth of the
# radius and its gradient (3), ∂u/∂t (3) and rate of growth of the radius.
WARP = 20
RAMP = 0.5  # s, over which the motion begins in an episode
_TURNS = 60  # iterations at most
_CLOSE = 1e-7  # m, change below which the iteration ends


class MotionParameters(NamedTuple):
    """Parameters of the motion of a vessel.

    Attributes:
        heart: Amplitude of the heart, m.
        breathing: Amplitude of breathing.
        distensibility: 1/kPa.
        rate: Heart rate, 1/s.
        phase: Phase of the heart at time 0, in beats.
        wave_speed: Pulse wave velocity, m/s.
        breath_rate: Breathing rate, 1/s.
        breath_phase: Phase of breathing at time 0, in breaths.
    """

    heart: Any
    breathing: Any
    distensibility: Any
    rate: Any
    phase: Any
    wave_speed: Any
    breath_rate: Any
    breath_phase: Any


class Course(NamedTuple):
    """The motion of a vessel at a time.

    Attributes:
        heart: Amplitude of the heart, m.
        breathing: Amplitude of breathing.
        growth: Amplitude of the radius, 1/kPa.
        heart_rate, breathing_rate, growth_rate: Their time derivatives, per s.
        beats: Phase of the pulse at the heart, in beats.
        lag: Lag of the pulse with the distance from the heart, beats per metre.
        rate: Heart rate, 1/s.
    """

    heart: Any
    breathing: Any
    growth: Any
    heart_rate: Any
    breathing_rate: Any
    growth_rate: Any
    beats: Any
    lag: Any
    rate: Any


@law
def course_at(parameters, time):
    """`Course` of `MotionParameters` at a time, s.

    The amplitudes of heart and breathing rise from 0 and fall back by half a cosine
    each. All amplitudes ramp up over `RAMP`.
    """
    heart, breathing, distensibility = parameters[:3]
    rate, begun = parameters.rate, parameters.phase
    share = min(max(time / RAMP, 0.0), 1.0)
    ramp = share * share * (3.0 - 2.0 * share)
    growing = 6.0 * share * (1.0 - share) / RAMP
    phase = rate * time + begun
    phase -= math.floor(phase)
    length = SYSTOLE if phase < SYSTOLE else 1.0 - SYSTOLE
    turn = math.pi / length
    angle = turn * (phase if phase < SYSTOLE else phase - 1.0)
    beat, beating = 0.5 - 0.5 * math.cos(angle), 0.5 * math.sin(angle)
    beating *= turn * rate
    breaths = parameters.breath_rate
    angle = 2.0 * math.pi * (breaths * time + parameters.breath_phase)
    breath, inhaling = 0.5 - 0.5 * math.cos(angle), 0.5 * math.sin(angle)
    inhaling *= 2.0 * math.pi * breaths
    return Course(
        heart * ramp * beat,
        breathing * ramp * breath,
        distensibility * ramp,
        heart * (ramp * beating + growing * beat),
        breathing * (ramp * inhaling + growing * breath),
        distensibility * growing,
        rate * time + begun,
        rate / parameters.wave_speed,
        rate,
    )


@law
def nth_course(parameters, n, time):
    """`course_at` of row n of `MotionParameters` of arrays (N,)."""
    own = MotionParameters(
        parameters.heart[n],
        parameters.breathing[n],
        parameters.distensibility[n],
        parameters.rate[n],
        parameters.phase[n],
        parameters.wave_speed[n],
        parameters.breath_rate[n],
        parameters.breath_phase[n],
    )
    return course_at(own, time)


@inlined
def _cell(place, count):
    """Cell of a lattice, fraction within it, and 1 in the lattice, else 0."""
    last = count - 1.0
    inside = 1.0 if 0.0 <= place <= last else 0.0
    # NaN goes to the first cell: `max` would keep it.
    place = min(place if place > 0.0 else 0.0, last - 1e-9)
    return int(place), place - int(place), inside


@law
def interpolate(lattice, point, out):
    """Writes the values (8) at a point to out[:, 0], their gradients to out[:, 1:]."""
    step, ny, nz = lattice[3], int(lattice[5]), int(lattice[6])
    i, u, first_flat = _cell((point[0] - lattice[0]) / step, lattice[4])
    j, v, second_flat = _cell((point[1] - lattice[1]) / step, lattice[5])
    k, w, third_flat = _cell((point[2] - lattice[2]) / step, lattice[6])
    first = HEAD + VALUES * ((i * ny + j) * nz + k)
    dy, dx = VALUES * nz, VALUES * nz * ny
    for n in range(VALUES):
        at = first + n
        a, b = lattice[at], lattice[at + VALUES]
        c, d = lattice[at + dy], lattice[at + dy + VALUES]
        e, f = lattice[at + dx], lattice[at + dx + VALUES]
        g, h = lattice[at + dx + dy], lattice[at + dx + dy + VALUES]
        ab, cd = a + w * (b - a), c + w * (d - c)
        ef, gh = e + w * (f - e), g + w * (h - g)
        low, high = ab + v * (cd - ab), ef + v * (gh - ef)
        out[n, 0] = low + u * (high - low)
        out[n, 1] = first_flat * (high - low) / step
        out[n, 2] = second_flat * ((1.0 - u) * (cd - ab) + u * (gh - ef)) / step
        rise = (1.0 - u) * ((1.0 - v) * (b - a) + v * (d - c))
        rise += u * ((1.0 - v) * (f - e) + v * (h - g))
        out[n, 3] = third_flat * rise / step


@law
def warp(lattice, course, point, values, out):
    """Writes the motion at a point in space.

    Args:
        lattice: (7 + 8 a b c,) float64 of `anatomy.motion.Motion`.
        course: `Course`.
        point: (3) m, in space.
        values: (VALUES, 4) scratch.
        out: (WARP,) float64, see `WARP`.
    """
    interpolate(lattice, point, values)
    a, b, growth = course.heart, course.breathing, course.growth
    out[0], out[1], out[2] = point
    for i in range(3):
        out[i] -= a * values[i, 0] + b * values[3 + i, 0]
        for j in range(3):
            out[3 + 3 * i + j] = -a * values[i, 1 + j] - b * values[3 + i, 1 + j]
        out[3 + 4 * i] += 1.0
        out[16 + i] = course.heart_rate * values[i, 0]
        out[16 + i] += course.breathing_rate * values[3 + i, 0]
    share, rate = pulse(course.beats - course.lag * values[7, 0])
    out[12] = growth * share * values[6, 0]
    for j in range(3):
        out[13 + j] = growth * share * values[6, 1 + j]
    growing = course.growth_rate * share + growth * rate * course.rate
    out[19] = growing * values[6, 0]


@inlined
def rest_place(there):
    """Place at rest (3) m, from the output of `warp`."""
    return (there[0], there[1], there[2])


@law
def first_past(inlet, points):
    """Index of the first point (n, 3) past an inlet (position, direction in), or n."""
    for n in range(len(points)):
        level = 0.0
        for k in range(3):
            level += (points[n, k] - inlet[0, k]) * inlet[1, k]
        if level > 0.0:
            return n
    return len(points)


@law
def to_rest(lattice, course, points, scratch, out):
    """Writes the places at rest (n, 3) of places in space (n, 3), m.

    `scratch` is (VALUES + WARP / 4, 4) float64.
    """
    values, there = scratch[:VALUES], scratch[VALUES:].reshape(-1)
    for n in range(len(points)):
        x, y, z = points[n]
        warp(lattice, course, (x, y, z), values, there)
        out[n, 0], out[n, 1], out[n, 2] = rest_place(there)


@law
def to_space(lattice, course, points, scratch, out, growth):
    """Writes the places in space (n, 3) of places at rest (n, 3), and growth (n,), m.

    Fixed-point iteration x ← X + u(x), which converges while space does not fold. For
    `scratch` see `to_rest`.
    """
    values, there = scratch[:VALUES], scratch[VALUES:].reshape(-1)
    for n in range(len(points)):
        x, y, z = points[n]
        for _ in range(_TURNS):
            warp(lattice, course, (x, y, z), values, there)
            ax, ay = points[n, 0] - there[0], points[n, 1] - there[1]
            az = points[n, 2] - there[2]
            x, y, z = x + ax, y + ay, z + az
            if max(abs(ax), abs(ay), abs(az)) < _CLOSE:
                break
        out[n, 0], out[n, 1], out[n, 2] = x, y, z
        growth[n] = there[12]


@law
def carried(there, flow):
    """Flow (3) at rest mapped into space, from the output of `warp`, and det A.

    The map det A A⁻¹, with the gradient A of the place at rest, conserves volume.
    """
    p, q, r = flow
    a, b, c = there[3], there[4], there[5]
    d, e, f = there[6], there[7], there[8]
    g, h, i = there[9], there[10], there[11]
    x, y, z = e * i - f * h, c * h - b * i, b * f - c * e
    u = x * p + y * q + z * r
    v = (f * g - d * i) * p + (a * i - c * g) * q + (c * d - a * f) * r
    w = (d * h - e * g) * p + (b * g - a * h) * q + (a * e - b * d) * r
    return (u, v, w), a * x + d * y + g * z


@law
def wall_velocity(there, normal):
    """Velocity (3) m/s of the wall, from the output of `warp`.

    Space moves at A⁻¹ ∂u/∂t (see `carried`). A widening wall moves against its normal
    (3), which points away from the wall.
    """
    (u, v, w), scale = carried(there, (there[16], there[17], there[18]))
    u, v, w, grow = u / scale, v / scale, w / scale, there[19]
    return u - grow * normal[0], v - grow * normal[1], w - grow * normal[2]


@law
def planes_in_space(there, planes, count):
    """Maps planes (normal and clearance) at rest into space, in place; see `warp`."""
    for row in range(count):
        x, y, z = planes[row, 0], planes[row, 1], planes[row, 2]
        u = there[3] * x + there[6] * y + there[9] * z
        v = there[4] * x + there[7] * y + there[10] * z
        w = there[5] * x + there[8] * y + there[11] * z
        length = math.sqrt(u * u + v * v + w * w)
        value = planes[row, 3] / length + there[12]
        u, v, w = u / length + there[13], v / length + there[14], w / length + there[15]
        length = math.sqrt(u * u + v * v + w * w)
        planes[row, 0], planes[row, 1] = u / length, v / length
        planes[row, 2], planes[row, 3] = w / length, value / length
