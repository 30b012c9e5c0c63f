"""A vessel that moves: pulsation, heartbeat and breathing (`anatomy.motion`).

The wall of a moving vessel is the field at rest, evaluated at x - u(x, t) in every
physics step (docs/vessel_model.md). An episode begins at rest, at the end of diastole
and of expiration; the motion reaches its full amplitude after `laws.motion.RAMP`.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.random import RandomState

from cathsim_dmc import bounds, rows
from cathsim_dmc.anatomy import Anatomy, Surface
from cathsim_dmc.anatomy.motion import PARAMETERS, Motion
from cathsim_dmc.compiled import compiled
from cathsim_dmc.laws.motion import (
    VALUES,
    WARP,
    MotionParameters,
    first_past,
    nth_course,
    to_rest,
    to_space,
)
from cathsim_dmc.physics.effects import Draw, Effect, World
from cathsim_dmc.physics.randomisation import Drawn, check_drawn, drawn
from cathsim_dmc.physics.readings import Readings
from cathsim_dmc.physics.stepper import CONTROL_TIMESTEP

_LIMITS = {
    "heart": (0.0, 12e-3, "m"),
    "breathing": (0.0, 2.0, ""),
    "distensibility": (0.0, 0.08, "1/kPa"),
    "rate": (30.0, 200.0, "1/min"),
    "phase": (0.0, 1.0, ""),
    "wave_speed": (2.0, 20.0, "m/s"),
    "breath_rate": (4.0, 60.0, "1/min"),
    "breath_phase": (0.0, 1.0, ""),
}
OF_HEART = {"rate": 60.0, "phase": 0.0, "wave_speed": 4.6}
_CLOCK_MASS = 0.1  # kg; gives a contact at 0.05 m/s an inverse weight of 0.025 kg⁻¹


@dataclasses.dataclass(frozen=True)
class MotionOptions:
    """How a vessel moves; a range (low, high) is drawn from in each episode.

    Attributes:
        heart: Displacement of the aortic root in a beat, m, 0 to 0.012, before it is
            smoothed and faded towards the inlet (docs/vessel_model.md).
        breathing: Amplitude relative to that of Sailer 2015, 0 to 2, likewise.
        distensibility: Area distensibility of a wide artery, 1/kPa, 0 to 0.08; 0.044
            when young, 0.02 at about 50 years.
        rate: Heart rate, 1/min, 30 to 200; None for that of the flow, or 60.
        phase: Phase of the heart at the start of an episode, 0 to 1; None for that of
            the flow, or 0.
        wave_speed: Pulse wave velocity, m/s, 2 to 20; None for that of the flow, or
            4.6.
        breath_rate: Breathing rate, 1/min, 4 to 60.
        breath_phase: Phase of breathing at the start, 0 to 1; 0 is the end of
            expiration.
    """

    heart: Drawn = 5.5e-3
    breathing: Drawn = 1.0
    distensibility: Drawn = 0.02
    rate: Drawn | None = None
    phase: Drawn | None = None
    wave_speed: Drawn | None = None
    breath_rate: Drawn = 15.0
    breath_phase: Drawn = 0.0

    def __post_init__(self):
        check_drawn(self, _LIMITS)

    def check(self, anatomy: Anatomy) -> None:
        """Raises ValueError if the largest amplitudes fold the space of an anatomy."""
        heart, breathing = float(np.max(self.heart)), float(np.max(self.breathing))
        anatomy.motion.check(anatomy.name, heart, breathing)


class Moving(Effect):
    """Moves the wall of each simulation.

    Attributes:
        flow: `flow.Flow` with the same heart; None without a flow.
    """

    parameters = MotionParameters
    acts_in, adapter = "contact", "motion"
    state = ("_clock",)
    flow: Any

    def __init__(self, options: MotionOptions):
        """Takes the options of the task."""
        self._options, self.flow = options, None

    def bind(self, world: World) -> None:
        """Allocates the clocks and inlets of the simulations."""
        super().bind(world)
        self._motions: dict[int, Motion] = {}
        self._surfaces: dict[int, Surface] = {}
        self._alike: list[tuple[Motion, np.ndarray]] | None = None
        self.inlets = np.zeros((world.num_simulations, 2, 3))
        self._clock = np.zeros(world.num_simulations)
        self._step = world.model.opt.timestep

    def enter(self, index: int, anatomy: Anatomy) -> None:
        """Takes the motion of the anatomy of one simulation."""
        self._motions[index], self._surfaces[index] = anatomy.motion, anatomy.surface
        self.inlets[index] = anatomy.inlet.position, anatomy.inlet.direction
        self._alike = None

    def restart(self, index: int, episode: Draw, random_state: RandomState) -> None:
        """Draws amplitudes, rates and phases."""
        given = {name: getattr(self._options, name) for name in _LIMITS}
        given |= {name: OF_HEART[name] for name in OF_HEART if given[name] is None}
        values = {name: drawn(value, random_state) for name, value in given.items()}
        values["rate"] /= 60.0
        values["breath_rate"] /= 60.0
        if self.flow is not None:
            values |= self.flow.heart(index)
        for name, each in self.world.parameters._asdict().items():
            each[index] = values[name]
        self._clock[index] = 0.0

    def conditions(self, index: int) -> dict[str, float]:
        """Motion of one simulation, in the units of `MotionOptions`."""
        values = self.world.parameters._asdict().items()
        found = {name: float(each[index]) for name, each in values}
        found |= {name: 60.0 * found[name] for name in ("rate", "breath_rate")}
        return {f"motion.{name}": value for name, value in found.items()}

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Advances the clock by a control step; the last effect of the vessel."""
        self._clock += CONTROL_TIMESTEP
        return action

    def record(self) -> dict[str, list[float]]:
        """Lattice, to six digits, and parameters of the first simulation."""
        lattice = [float(f"{value:.6g}") for value in self._motions[0].lattice]
        return {"lattice": lattice, "parameters": self._numbers(0).tolist()}

    def _numbers(self, index: int) -> np.ndarray:
        """Numbers (PARAMETERS,) of one simulation, as `anatomy.motion` takes them."""
        numbers = np.zeros(PARAMETERS)
        numbers[1:9] = [each[index] for each in self.world.parameters]
        return numbers

    def phases(self) -> tuple[np.ndarray, np.ndarray]:
        """Phases (N,), (N,) of heart and breathing, 0 to 1."""
        given, time = self.world.parameters, self._clock
        breath = given.breath_rate * time + given.breath_phase
        return (given.rate * time + given.phase) % 1.0, breath % 1.0

    @property
    def alike(self) -> list[tuple[Motion, np.ndarray]]:
        """Motions, each with the indices (n,) of the simulations of its anatomy."""
        if self._alike is None:
            count = range(self.world.num_simulations)
            self._alike = rows.alike(self._motions[index] for index in count)
        return self._alike

    def lattice(self, index: int) -> np.ndarray:
        """Lattice of one simulation's motion."""
        return self._motions[index].lattice

    @property
    def times(self) -> np.ndarray:
        """Times (N,), s, of quantities that MuJoCo derives: a physics step earlier."""
        return np.maximum(self._clock - self._step, 0.0)

    def at_rest(self, state: Readings) -> Readings:
        """Readings with centreline and head past the inlet mapped to rest."""
        places, times = state.centreline.copy(), self.times

        def move(motion: Motion, own: np.ndarray) -> None:
            given = self.world.parameters, times
            _to_rest_of(motion.lattice, own, given, self.inlets, places)

        rows.of_each(self.alike, move)
        return state._replace(centreline=places, head=places[:, -1])

    def to_space(self, points: np.ndarray) -> np.ndarray:
        """Places in space (N, 3) of places at rest (N, 3), m."""
        places, times = np.array(points), self.times

        def move(motion: Motion, own: np.ndarray) -> None:
            given = self.world.parameters, times
            _to_space_of(motion.lattice, own, given, places)

        rows.of_each(self.alike, move)
        return places

    def warp(self, index: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Lattice and parameters of one simulation's motion, and its time, s."""
        time = float(self.times[index])
        return self._motions[index].lattice, self._numbers(index), time

    def surface(self, index: int) -> Surface:
        """Present surface of the lumen of one simulation.

        Raises:
            ValueError: if there is no simulation of that index.
            RuntimeError: if no episode has begun in it.
        """
        index = bounds.whole("index", index, 0, self.world.num_simulations - 1)
        if not self.world.parameters.rate[index]:
            raise RuntimeError("no episode has begun; call reset() first")
        parameters, time = self.warp(index)[1:]
        return self._motions[index].surface(parameters, time, self._surfaces[index])


def add_clock(root) -> None:
    """Adds the body whose velocity is that of the wall, see `adapters.motion`."""
    clock = root.worldbody.add("body", name="vessel_clock", gravcomp=1)
    inertia = [_CLOCK_MASS * 1e-4] * 3
    clock.add("inertial", pos=[0, 0, 0], mass=_CLOCK_MASS, diaginertia=inertia)
    clock.add("joint", name="vessel_clock", type="slide", axis=[1, 0, 0])


@compiled
def _to_rest_of(lattice, own, given, inlets, places):
    """Maps places past the inlet from space to the vessel at rest, in place.

    Args:
        lattice: Lattice of `anatomy.motion.Motion`.
        own: (n,) int64, indices of the simulations of its anatomy.
        given: `MotionParameters` of arrays (N,), and times (N,), s.
        inlets: (N, 2, 3), position (m) and direction of the inlets.
        places: (N, P, 3) m, in space; overwritten with the places at rest.
    """
    parameters, times = given
    scratch = np.empty((VALUES + WARP // 4, 4))
    for n in own:
        course = nth_course(parameters, n, times[n])
        moved = places[n, first_past(inlets[n], places[n]) :]
        to_rest(lattice, course, moved, scratch, moved)


@compiled
def _to_space_of(lattice, own, given, places):
    """Maps places (N, 3) m of the vessel at rest into space, see `_to_rest_of`."""
    parameters, times = given
    scratch, growth = np.empty((VALUES + WARP // 4, 4)), np.empty(1)
    for n in own:
        course, one = nth_course(parameters, n, times[n]), places[n : n + 1]
        to_space(lattice, course, one, scratch, one, growth)
