"""The vessel of a recorded episode, where it lives: phases, blood, wall and motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cathsim_dmc.anatomy.motion import Motion
from cathsim_dmc.recording.episode import Episode

# Figures over the states in ``meta['vessel']``: name, factor and label of a plot.
SERIES = {
    "heart_phase": (1.0, "phase of the heart"),
    "breath_phase": (1.0, "phase of breathing"),
    "blood_speed": (1.0, "blood at the head, m/s"),
    "indentation": (1e3, "indentation, mm"),
    "wall_work": (1e6, "work on the wall, µJ"),
}


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
    def of(cls, episode: Episode) -> VesselRecord | None:
        """Reads the vessel of an episode; None if it is rigid and its blood rests.

        Raises:
            ValueError: an entry is missing, or has not one row for each state.
        """
        given = episode.meta.get("vessel")
        if not given:
            return None
        try:
            series = {name: np.array(given[name], np.float64) for name in SERIES}
            velocity = np.array(given["blood_velocity"], np.float64)
            goal = np.array(given["goal"], np.float64)
            lattice = np.array(given["lattice"], dtype=np.float64)
            parameters = np.array(given["parameters"], dtype=np.float64)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"meta['vessel'] lacks or spoils {error!r}") from error
        for name, values in (*series.items(), ("goal", goal)):
            if len(values) != episode.steps + 1:
                raise ValueError(
                    f"meta['vessel'] has {len(values)} values of {name}; give "
                    f"{episode.steps + 1}, one for each state"
                )
        motion = Motion(lattice) if lattice.size else None
        return cls(series, velocity, goal, motion, parameters)

    def vertices(self, rest: np.ndarray, outwards: np.ndarray, time: float):
        """Vertices (V, 3) m at a time, s, of those at rest with normals outwards."""
        assert self.motion is not None
        places, growth = self.motion.to_space(self.parameters, time, rest)
        return places + growth[:, None] * outwards


def vessel_state(task: Any) -> dict[str, Any]:
    """What a record keeps of the vessel in a state; nothing of one that rests."""
    rollout = task.rollout
    state = rollout.vessel
    if state is None:
        return {}
    info = {name: float(value[0]) for name, value in state.info().items()}
    moving = rollout.moving
    return {
        "vessel": {
            **info,
            "blood_velocity": state.blood_velocity[0].tolist(),
            "goal": rollout.goal.reshape(3).tolist(),
        },
        "vessel_motion": {} if moving is None else moving.record(),
    }


def vessel_meta(states: list[dict[str, Any]], motion: dict[str, Any]) -> dict[str, Any]:
    """Entry ``meta['vessel']`` of the states of an episode."""
    columns = {name: [state[name] for state in states] for name in states[0]}
    return {**columns, "lattice": [], "parameters": [], **motion}
