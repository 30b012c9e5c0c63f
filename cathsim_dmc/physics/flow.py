"""Blood that flows: a pulsatile flow past the links of the device.

The inflow follows `blood_loops.beat` at a heart rate; time scales with its period. At a
way s from the heart it comes s / c later, c the pulse wave velocity. Branches take
their shares (`anatomy.circulation`). Across the lumen of radius R the velocity is
blunted, u = Q / πR² · (n + 2) / n · (1 - (r/R)ⁿ) with n = 9, as one-dimensional models
of the aorta have it (Smith, Pullan and Hunter 2002; openBF). Womersley's profile is
that of a developed flow; the aorta is shorter than its entrance length, and measured
profiles are flat (the Stokes layer at 1 Hz is 1 mm thick).

In a moving vessel (`anatomy.motion`), with the gradient A = ∂X/∂x of the place at rest,
the velocity v(X) at rest, over the radius that the lumen has grown to, becomes
det A A⁻¹ v(X), which conserves the volume through every section (Piola), and the
velocity A⁻¹ ∂u/∂t of the vessel's space is added.

The velocity at each link is taken once a control step where the link is, its course in
time in every physics step. Across the link the drag is that of `blood`, from the
velocity relative to the link; along it, the blood rubs like a flow between the link of
radius a and the wall, 2πµu / ln(R/a) per length.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from cathsim_dmc import bounds
from cathsim_dmc.anatomy import Anatomy
from cathsim_dmc.anatomy.circulation import Circulation
from cathsim_dmc.entities.chain import Chain
from cathsim_dmc.physics.blood import StillBlood
from cathsim_dmc.physics.drawn import Range, drawable, drawn
from cathsim_dmc.physics.effects import World
from cathsim_dmc.physics.motion import Moving
from cathsim_dmc.physics.randomisation import Episode
from cathsim_dmc.physics.readings import Readings


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

    rate: Range = 60.0
    peak: Range = 0.72
    phase: Range = 0.0
    wave_speed: Range = 4.6
    split: str = "measured"

    def __post_init__(self):
        bounds.choice("split", self.split, ("measured", "murray"))
        drawable(self, _LIMITS)


_LIMITS = {
    "rate": (30.0, 200.0, "1/min"),
    "peak": (0.0, 2.0, "m/s"),
    "phase": (0.0, 1.0, ""),
    "wave_speed": (2.0, 20.0, "m/s"),
}


class Flow(StillBlood):
    """Blood in vessels that live: it may flow, and moves with what moves them.

    Attributes:
        radius: (N, L), of the lumen around each link, m, 0 where it is in none.
    """

    radius: np.ndarray

    def __init__(self, options: FlowOptions | None, moving: Moving | None = None):
        """Takes the options of the task, None for no flow, and what moves vessels."""
        self._options, self._moving = options, moving

    def num_parameters(self, chain: Chain) -> int:
        """Those of blood."""
        from cathsim_dmc.physics import flow_loops  # late, as numba takes long

        self._places = flow_loops
        return super().num_parameters(chain)

    def bind(self, world: World) -> None:
        """Finds the parameters of blood and the radii of the links."""
        super().bind(world)
        self._link_radii = world.model.geom_size[world.index.geoms, 0]
        self._circulations: dict[int, Circulation] = {}
        self._wave_speed = np.ones(world.num_simulations)

    def enter(self, index: int, anatomy: Anatomy) -> None:
        """Fills the vessels of an anatomy."""
        murray = self._options is not None and self._options.split == "murray"
        self._circulations[index] = (
            Circulation.of(anatomy.tree, murray) if murray else anatomy.circulation
        )

    def restart(
        self, index: int, episode: Episode, random_state: np.random.RandomState
    ) -> None:
        """Draws rate, peak and phase of the heart, and pulse wave velocity."""
        super().restart(index, episode, random_state)
        if self._options is None:
            return
        rate, peak, phase, speed = (
            drawn(getattr(self._options, name), random_state) for name in _LIMITS
        )
        inflow = peak * np.pi * self._circulations[index].radius ** 2
        self._header[index, 4:] = inflow, rate / 60.0, phase
        self._wave_speed[index] = speed

    def act(self, action: np.ndarray, state: Readings) -> np.ndarray:
        """Finds the blood at the middle of each link."""
        nodes = state.centreline
        found = self._at(0.5 * (nodes[:, :-1] + nodes[:, 1:]))
        self.radius = found[..., 4]
        self._places.fill(
            found,
            self._wave_speed,
            self._header[:, 2],
            self._link_radii,
            self._options is not None,
            self._links,
        )
        return action

    def heart(self, index: int) -> dict[str, float]:
        """Rate (1/s) and phase of the heart and pulse wave velocity (m/s)."""
        rate, phase = self._header[index, 5:].tolist()
        speed = float(self._wave_speed[index])
        return {"rate": rate, "phase": phase, "wave_speed": speed}

    def _at(self, points: np.ndarray) -> np.ndarray:
        """What `flow_loops` finds at points (N, P, 3) in space: (N, P, 8)."""
        out = np.zeros((*points.shape[:2], 8))
        for index, row in enumerate(np.ascontiguousarray(points)):
            vessels = self._circulations[index].arrays
            if self._moving is None:
                self._places.velocities(row, np.zeros(len(row)), *vessels, out[index])
            else:
                first = self._moving.entered(index, row)
                course, there = self._moving.warp(index), out[index, first:]
                self._places.moving_velocities(*course, row[first:], *vessels, there)
        return out

    def read(self, time: np.ndarray, state: Readings) -> dict[str, np.ndarray]:
        """Figures of `vessel.VesselReadings` at times (N,), s."""
        found = self._at(state.head[:, None])[:, 0]
        if self._options is None:
            return {"blood_velocity": found[:, 5:]}
        inflow, rate, phase = self._header[:, 4:].T
        phases = rate * time + phase
        delays = found[:, 3] / self._wave_speed
        beats = [self._loops.beat(phase) for phase in (phases - rate * delays).tolist()]
        velocity = (inflow * np.array(beats))[:, None] * found[:, :3] + found[:, 5:]
        return {"heart_phase": phases % 1.0, "blood_velocity": velocity}
