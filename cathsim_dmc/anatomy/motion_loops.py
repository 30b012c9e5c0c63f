"""How a moving vessel displaces space, compiled; see `anatomy.motion`."""

import math

import numpy as np

from cathsim_dmc.anatomy.circulation import BEAT
from cathsim_dmc.compiled import compiled

# One simulation's numbers: `MARK`, amplitudes of heart and breathing, distensibility;
# rate (1/s) and phase of the heart, pulse wave velocity (m/s), rate (1/s) and phase of
# breathing; the geoms that carry the wall and the bore of the sheath, -1 for none.
PARAMETERS, MARK = 11, 2947.0
# Of the head of a lattice: origin (3) m, step m, shape (3); then its values.
HEAD = 7
# Values at a point: displacement by the heart (3) and by breathing (3) at amplitude 1,
# m, growth of the radius, m·kPa, and way from the heart, m.
VALUES = 8
# Numbers of `warp`: place at rest (3), its gradient (9) row by row, growth of the
# radius and its gradient (3), velocity of space at a fixed place (3), rate of growth.
WARP = 20
RAMP = 0.5  # s, over which an episode's vessel begins to move
SYSTOLE = 0.35  # of a beat, in which the root goes its way; it returns in the rest
_COMPLIANCE = 1.2  # s, by which the pressure decays in diastole
_TURNS = 60  # iterations at most
_CLOSE = 1e-7  # m


def _pulse() -> np.ndarray:
    """Pressure over a beat of 1 s, from 0 to 1: the inflow into a compliance."""
    count = len(BEAT) - 1
    pressure, course = 0.0, np.zeros(count + 1)
    for _ in range(8):  # beats, until it repeats itself
        for k in range(count):
            pressure += (BEAT[k] - pressure / _COMPLIANCE) / count
            course[k + 1] = pressure
        course[0] = course[-1]
    return (course - course.min()) / np.ptp(course)


PULSE = _pulse()


@compiled
def pulse(phase):
    """Share (0 to 1) of the pulse's growth at a phase in beats, and its derivative."""
    place = (phase - math.floor(phase)) * (len(PULSE) - 1)
    first = min(int(place), len(PULSE) - 2)
    slope = PULSE[first + 1] - PULSE[first]
    return PULSE[first] + (place - first) * slope, slope * (len(PULSE) - 1)


@compiled
def courses(parameters, time):
    """Amplitudes of heart, breathing and radius, their rates (1/s), and the pulse."""
    # Of the pulse: its phase at the heart, the lag a metre, 1/m, and its rate, 1/s.
    share = min(max(time / RAMP, 0.0), 1.0)
    ramp = share * share * (3.0 - 2.0 * share)
    growing = 6.0 * share * (1.0 - share) / RAMP
    phase = parameters[4] * time + parameters[5]
    phase -= math.floor(phase)
    length = SYSTOLE if phase < SYSTOLE else 1.0 - SYSTOLE
    turn = math.pi / length
    angle = turn * (phase if phase < SYSTOLE else phase - 1.0)
    heart, beating = 0.5 - 0.5 * math.cos(angle), 0.5 * math.sin(angle)
    beating *= turn * parameters[4]
    angle = 2.0 * math.pi * (parameters[7] * time + parameters[8])
    breath, breathing = 0.5 - 0.5 * math.cos(angle), 0.5 * math.sin(angle)
    breathing *= 2.0 * math.pi * parameters[7]
    return (
        parameters[1] * ramp * heart,
        parameters[2] * ramp * breath,
        parameters[3] * ramp,
        parameters[1] * (ramp * beating + growing * heart),
        parameters[2] * (ramp * breathing + growing * breath),
        parameters[3] * growing,
        parameters[4] * time + parameters[5],
        parameters[4] / parameters[6],
        parameters[4],
    )


@compiled
def _cell(place, count):
    """Cell of a lattice, share of it, and 0 outside, where nothing changes, else 1."""
    last = count - 1.0
    inside = 1.0 if 0.0 <= place <= last else 0.0
    place = min(max(place, 0.0), last - 1e-9)
    return int(place), place - int(place), inside


@compiled
def interpolate(lattice, x, y, z, out):
    """Writes the values (8) at a point into out[:, 0], their gradients behind them."""
    step, ny, nz = lattice[3], int(lattice[5]), int(lattice[6])
    i, u, first_flat = _cell((x - lattice[0]) / step, lattice[4])
    j, v, second_flat = _cell((y - lattice[1]) / step, lattice[5])
    k, w, third_flat = _cell((z - lattice[2]) / step, lattice[6])
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


@compiled
def warp(lattice, course, x, y, z, scratch, out):
    """Writes what the motion of `courses` does to a place (m) in space, see `WARP`."""
    interpolate(lattice, x, y, z, scratch)
    a, b, r, da, db, dr, beats, lag, often = course
    out[0], out[1], out[2] = x, y, z
    for i in range(3):
        out[i] -= a * scratch[i, 0] + b * scratch[3 + i, 0]
        for j in range(3):
            out[3 + 3 * i + j] = -a * scratch[i, 1 + j] - b * scratch[3 + i, 1 + j]
        out[3 + 4 * i] += 1.0
        out[16 + i] = da * scratch[i, 0] + db * scratch[3 + i, 0]
    share, rate = pulse(beats - lag * scratch[7, 0])
    out[12] = r * share * scratch[6, 0]
    for j in range(3):
        out[13 + j] = r * share * scratch[6, 1 + j]
    out[19] = (dr * share + r * rate * often) * scratch[6, 0]


@compiled
def first_past(inlet, points):
    """Number of the first of places (n, 3) m past an inlet (position, way in), or n."""
    for n in range(len(points)):
        level = 0.0
        for k in range(3):
            level += (points[n, k] - inlet[0, k]) * inlet[1, k]
        if level > 0.0:
            return n
    return len(points)


@compiled
def rest(lattice, parameters, time, points, out):
    """Writes the places at rest (n, 3) of places in space (n, 3), m."""
    values, there = np.empty((VALUES, 4)), np.empty(WARP)
    course = courses(parameters, time)
    for n in range(len(points)):
        x, y, z = points[n]
        warp(lattice, course, x, y, z, values, there)
        out[n, 0], out[n, 1], out[n, 2] = there[0], there[1], there[2]


@compiled
def moved(lattice, parameters, time, points, out, growth):
    """Writes places in space (n, 3) m of those at rest, and growth of radii (n,) m."""
    values, there = np.empty((VALUES, 4)), np.empty(WARP)
    course = courses(parameters, time)
    for n in range(len(points)):
        x, y, z = points[n]
        for _ in range(_TURNS):
            warp(lattice, course, x, y, z, values, there)
            ax, ay = points[n, 0] - there[0], points[n, 1] - there[1]
            az = points[n, 2] - there[2]
            x, y, z = x + ax, y + ay, z + az
            if max(abs(ax), abs(ay), abs(az)) < _CLOSE:
                break
        out[n, 0], out[n, 1], out[n, 2] = x, y, z
        growth[n] = there[12]


@compiled
def carried(there, p, q, r):
    """What a flow (p, q, r) at rest becomes where `warp` has looked, and det A.

    det A A⁻¹ (p, q, r), with A the gradient of the place at rest, conserves volume.
    """
    a, b, c = there[3], there[4], there[5]
    d, e, f = there[6], there[7], there[8]
    g, h, i = there[9], there[10], there[11]
    x, y, z = e * i - f * h, c * h - b * i, b * f - c * e
    u = x * p + y * q + z * r
    v = (f * g - d * i) * p + (a * i - c * g) * q + (c * d - a * f) * r
    w = (d * h - e * g) * p + (b * g - a * h) * q + (a * e - b * d) * r
    return u, v, w, a * x + d * y + g * z


@compiled
def wall_velocity(there, normal):
    """Velocity (3) m/s of the wall's material where `warp` has looked."""
    # Space goes with A⁻¹ ∂u/∂t, and a wall that widens away from its normal.
    u, v, w, scale = carried(there, there[16], there[17], there[18])
    u, v, w, grow = u / scale, v / scale, w / scale, there[19]
    return u - grow * normal[0], v - grow * normal[1], w - grow * normal[2]


@compiled
def in_space(there, rows, planes):
    """Turns planes at rest (normal and clearance) into those in space; see `warp`."""
    for row in range(planes):
        x, y, z = rows[row, 0], rows[row, 1], rows[row, 2]
        u = there[3] * x + there[6] * y + there[9] * z
        v = there[4] * x + there[7] * y + there[10] * z
        w = there[5] * x + there[8] * y + there[11] * z
        length = math.sqrt(u * u + v * v + w * w)
        value = rows[row, 3] / length + there[12]
        u, v, w = u / length + there[13], v / length + there[14], w / length + there[15]
        length = math.sqrt(u * u + v * v + w * w)
        rows[row, 0], rows[row, 1], rows[row, 2] = u / length, v / length, w / length
        rows[row, 3] = value / length
