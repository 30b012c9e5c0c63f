"""The vessel of a recorded episode, where it lives: phases, blood, wall and motion."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cathsim_dmc.anatomy.motion import Motion
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.recording.episode import Episode

# Figures over the states in ``meta['vessel']``: name, factor and label of a plot.
SERIES = {
    "heart_phase": (1.0, "phase of the heart"),
    "breath_phase": (1.0, "phase of breathing"),
    "blood_speed": (1.0, "blood at the head, m/s"),
    "indentation": (1e3, "indentation, mm"),
    "wall_work": (1e6, "work on the wall, µJ"),
}
MESH_EVERY = 4  # states, of which a recording keeps the moved surface


@dataclass(frozen=True, eq=False)
class VesselRecord:
    """A vessel over T+1 states.

    Attributes:
        series: (T+1,) by name, see `SERIES`.
        blood_velocity: (T+1, 3), at the head, m/s, world frame.
        goal: (T+1, 3), m, world frame.
        motion: How it moves; None where it rests.
        parameters: Of the motion, see `anatomy.motion_loops`.
    """

    series: dict[str, np.ndarray]
    blood_velocity: np.ndarray
    goal: np.ndarray
    motion: Motion | None
    parameters: np.ndarray

    @classmethod
    def of(cls, episode: Episode) -> "VesselRecord | None":
        """Reads the vessel of an episode; None if it is rigid and its blood rests."""
        given = episode.meta.get("vessel")
        if not given:
            return None
        names = ("blood_velocity", "goal", "lattice", "parameters")
        velocity, goal, lattice, parameters = (
            np.array(given[name], np.float64) for name in names
        )
        motion = Motion(lattice) if lattice.size else None
        series = {name: np.array(given[name], np.float64) for name in SERIES}
        return cls(series, velocity, goal, motion, parameters)

    def curves(self) -> dict[str, tuple[np.ndarray, str]]:
        """What is drawn over time (T+1,), by name, with labels."""
        return {
            name: (factor * self.series[name], label)
            for name, (factor, label) in SERIES.items()
        }

    def surface(self, rest: Surface, time: float) -> Surface:
        """The surface of the lumen at a time, s."""
        if self.motion is None:
            return rest
        return self.motion.surface(self.parameters, float(time), rest)


def vessel_state(task: Any) -> dict[str, Any]:
    """What a record keeps of the vessel in a state; nothing of one that rests."""
    vessel = task.rollout.vessel
    if vessel is None:
        return {}
    return {
        **{name: float(value[0]) for name, value in vessel.info().items()},
        "blood_velocity": vessel.blood_velocity[0].tolist(),
        "goal": task.rollout.goal.reshape(3).tolist(),
    }
