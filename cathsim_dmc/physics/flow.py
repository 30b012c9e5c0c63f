"""Blood that flows: a pulsatile flow past the links of the device.

docs/vessel_model.md has the equations and their sources. The velocity at the position
of each link is computed once per control step, its course in time (`laws.blood.beat`)
in every physics step.
"""

import dataclasses
import math

import numpy as np
from numpy.random import RandomState

from cathsim_dmc import bounds, rows
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.circulation import Circulation
from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.blood import beat
from cathsim_dmc.laws.motion import VALUES, WARP, carried, first_past, nth_course, warp
from cathsim_dmc.physics.blood import StillBlood
from cathsim_dmc.physics.effects import Draw, World
from cathsim_dmc.physics.motion import Moving
from cathsim_dmc.physics.randomisation import Drawn, check_drawn, drawn
from cathsim_dmc.physics.readings import Readings

# Exponent of the profile across the lumen (Smith, Pullan and Hunter 2002; openBF).
EXPONENT = 9
# Distance over which the flow of a vessel passes into that of its branch, m.
_BLEND = 5e-4
# Least ratio of the radii of lumen and link, for the friction along the link.
_LEAST_GAP = 1.2


@dataclasses.dataclass(frozen=True)
class FlowOptions:
    """How blood flows; a range (low, high) is drawn from uniformly in each episode.

    Attributes:
        rate: Heart rate, 1/min, 30 to 200.
        peak: Mean velocity across the lumen at the heart at its peak, m/s, 0 to 2;
            0.72 are 573 mL/s in an aorta of 31.9 mm (ADAN56).
        phase: Phase of the heart at the start of an episode, 0 to 1; 0 is the beginning
            of the ejection.
        wave_speed: Pulse wave velocity, m/s, 2 to 20.
        split: "measured" for the shares of BCA, LCCA and LSA in adults, "murray" for
            shares of all outlets by their radii cubed, as in a scan.
    """

    rate: Drawn = 60.0
    peak: Drawn = 0.72
    phase: Drawn = 0.0
    wave_speed: Drawn = 4.6
    split: str = "measured"

    def __post_init__(self):
        bounds.choice("split", self.split, ("measured", "murray"))
        check_drawn(self, _LIMITS)


_LIMITS = {
    "rate": (30.0, 200.0, "1/min"),
    "peak": (0.0, 2.0, "m/s"),
    "phase": (0.0, 1.0, ""),
    "wave_speed": (2.0, 20.0, "m/s"),
}


class Flow(StillBlood):
    """Blood in living vessels: it may flow, and it moves with the vessels.

    Attributes:
        radius: (N, L), radius of the lumen around each link, m; 0 for none.
    """

    state = ("radius", "_link_radii")
    radius: np.ndarray

    def __init__(self, options: FlowOptions | None, moving: Moving | None = None):
        """Takes the options, None for no flow, and the effect that moves vessels."""
        self._options, self._moving = options, moving
        if options is not None:
            self.state += ("_wave_speed",)

    def bind(self, world: World) -> None:
        """Takes the simulations, and the radii of the links from the model."""
        super().bind(world)
        radii = world.model.geom_size[world.index.geoms, 0]
        self._link_radii = np.tile(radii, (world.num_simulations, 1))
        self._circulations: dict[int, Circulation] = {}
        self._alike: list[tuple[Circulation, np.ndarray]] | None = None
        self._wave_speed = np.ones(world.num_simulations)
        self.radius = np.zeros(self._link_radii.shape)

    def enter(self, index: int, anatomy: Anatomy) -> None:
        """Takes the circulation of the anatomy of one simulation."""
        murray = self._options is not None and self._options.split == "murray"
        blood = anatomy.murray_circulation if murray else anatomy.circulation
        self._circulations[index], self._alike = blood, None

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Draws rate, peak and phase of the heart, and pulse wave velocity."""
        super().restart(index, episode, random_state)
        if self._options is None:
            return
        rate, peak, phase, speed = (
            drawn(getattr(self._options, name), random_state) for name in _LIMITS
        )
        blood = self.world.parameters
        blood.peak[index] = peak * np.pi * self._circulations[index].radius ** 2
        blood.rate[index], blood.phase[index] = rate / 60.0, phase
        self._wave_speed[index] = speed

    def conditions(self, index: int) -> dict[str, float]:
        """Heart of one simulation in the units of `FlowOptions`; none without flow."""
        if self._options is None:
            return {}
        blood, area = self.world.parameters, self._circulations[index].radius ** 2
        found = {
            "rate": 60.0 * blood.rate[index],
            "peak": blood.peak[index] / (np.pi * area),
            "phase": blood.phase[index],
            "wave_speed": self._wave_speed[index],
        }
        return {f"flow.{name}": float(value) for name, value in found.items()}

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Writes velocity and friction of the blood at the middle of each link."""
        nodes = state.centreline
        found = self._at(0.5 * (nodes[:, :-1] + nodes[:, 1:]))
        self.radius = found[..., 4]
        if self.world.chain.coaxial:  # radii change as the devices slide
            for index, radii in enumerate(self._link_radii):
                sizes = self.world.field(index, "geom_size")
                radii[:] = sizes[self.world.index.geoms, 0]
        flowing = self._options is not None
        _fill(found, self._wave_speed, self._link_radii, flowing, self.world.parameters)
        return action

    def heart(self, index: int) -> dict[str, float]:
        """Rate (1/s) and phase of the heart and pulse wave velocity (m/s)."""
        blood, speed = self.world.parameters, float(self._wave_speed[index])
        rate, phase = float(blood.rate[index]), float(blood.phase[index])
        return {"rate": rate, "phase": phase, "wave_speed": speed}

    def _at(self, points: np.ndarray) -> np.ndarray:
        """Output (N, P, 8) of `velocities` at points (N, P, 3), m, in space."""
        places, out = np.ascontiguousarray(points), np.zeros((*points.shape[:2], 8))
        if self._alike is None:
            count = range(len(points))
            self._alike = rows.alike(self._circulations[index] for index in count)
        moving = self._moving
        times = None if moving is None else moving.times

        def find(blood: Circulation, own: np.ndarray) -> None:
            if moving is None:
                velocities_of(own, places, blood.segments, out)
                return
            given = moving.world.parameters, times, moving.inlets
            lattice = moving.lattice(own[0])
            moving_velocities_of(lattice, own, given, places, blood.segments, out)

        rows.of_each(self._alike, find)
        return out

    def read(self, time: np.ndarray, state: Readings) -> dict[str, np.ndarray]:
        """Blood velocity and heart phase, by their names in `vessel.VesselReadings`.

        Args:
            time: (N,), time since the start of the episodes, s.
            state: Readings at that time.
        """
        found = self._at(state.head[:, None])[:, 0]
        if self._options is None:
            return {"blood_velocity": found[:, 5:]}
        blood = self.world.parameters
        phases = blood.rate * time + blood.phase
        delayed = phases - blood.rate * (found[:, 3] / self._wave_speed)
        beats = np.empty(len(delayed))
        _beat(delayed, beats)
        velocity = (blood.peak * beats)[:, None] * found[:, :3] + found[:, 5:]
        return {"heart_phase": phases % 1.0, "blood_velocity": velocity}


@compiled
def profile(share):
    """Velocity relative to its mean, at a fraction of the lumen's radius; 0 outside."""
    return (1.0 - share**EXPONENT) * (EXPONENT + 2) / EXPONENT if share < 1.0 else 0.0


@compiled
def _beat(phases, out):
    """Writes `laws.blood.beat` at phases (N,)."""
    for n in range(len(phases)):
        out[n] = beat(phases[n])


@compiled
def velocities_of(own, points, segments, out):
    """Writes `velocities` (N, P, 8) of simulations `own` (n,) with vessels at rest."""
    growth = np.zeros(points.shape[1])
    for n in own:
        velocities(points[n], growth, segments, out[n])


@compiled
def moving_velocities_of(lattice, own, given, points, segments, out):
    """As `velocities_of`, in vessels that move, at points past the inlet.

    Args:
        lattice: Lattice of `anatomy.motion.Motion`.
        own: (n,) int64, indices of the simulations.
        given: `laws.motion.MotionParameters` of arrays (N,), times (N,) in s, and
            inlets (N, 2, 3), position (m) and direction.
        points: (N, P, 3) m, in space.
        segments: See `velocities`.
        out: (N, P, 8), written.
    """
    parameters, times, inlets = given
    for n in own:
        first = first_past(inlets[n], points[n])
        course = nth_course(parameters, n, times[n])
        moving_velocities(lattice, course, points[n, first:], segments, out[n, first:])


@compiled
def moving_velocities(lattice, course, points, segments, out):
    """As `velocities` in a moving vessel; out[:, 5:] is the velocity of space, m/s."""
    values, there = np.empty((VALUES, 4)), np.empty((len(points), WARP))
    for p in range(len(points)):
        x, y, z = points[p]
        warp(lattice, course, (x, y, z), values, there[p])
    rest, growth = there[:, :3].copy(), there[:, 12].copy()
    velocities(rest, growth, segments, out)
    for p in range(len(points)):
        row, at = out[p], there[p]
        if row[4] > 0.0:
            flow, scale = carried(at, (row[0], row[1], row[2]))
            row[0], row[1], row[2] = flow
            flow, scale = carried(at, (at[16], at[17], at[18]))
            row[5], row[6], row[7] = flow
            row[5:] /= scale


@compiled
def _fill(found, speed, radii, flowing, blood):
    """Writes the `Blood` of the links of N simulations, from `Flow._at`."""
    for index in range(len(found)):
        for n in range(radii.shape[1]):
            row = found[index, n]
            blood.space_velocity[index, n] = row[5:]
            if flowing:
                blood.velocity[index, n] = row[:3]
                if blood.peak[index] == 0.0:  # stands for a steady flow in the law
                    blood.velocity[index, n] = 0.0
                blood.delay[index, n] = row[3] / speed[index]
                blood.friction[index, n] = 0.0
                if row[4] > 0.0:
                    gap = max(row[4] / radii[index, n], _LEAST_GAP)
                    friction = 2.0 * math.pi * blood.viscosity[index] / math.log(gap)
                    blood.friction[index, n] = friction


@compiled
def velocities(points, growth, segments, out):
    """Writes velocity, distance from the heart and radius of the lumen at points.

    Args:
        points: (P, 3), m, in the vessel at rest.
        growth: (P,), growth of the radius of the lumen, m.
        segments: segments of the vessels, `anatomy.circulation.Segments`.
        out: (P, 5 or more), written: velocity (3) for an inflow of 1 m³/s, 1/m²;
            distance, m; radius, m; all are 0 outside the lumen.
    """
    ends, radii, shares, ways, vessel = segments
    count = len(vessel)
    nearest = np.empty(vessel[-1] + 1)
    segment = np.zeros(vessel[-1] + 1, np.int64)  # 0 for a NaN point
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
            # The next `step` segments, none of them longer, are farther away.
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
            # Depth in the tube of the vessel, -inf past its ends.
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
