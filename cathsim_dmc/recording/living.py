"""The vessel of a recorded episode, where it lives: phases, blood, wall and motion."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

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
# Waves P, Q, R, S and T of the curve that stands for an ECG: middle, in beats from the
# beginning of the ejection, width and height.
_WAVES = np.array([
    (-0.20, 0.030, 0.15), (-0.07, 0.012, -0.12), (-0.04, 0.025, 1.0),
    (-0.01, 0.012, -0.2), (0.24, 0.045, 0.3),
])  # fmt: skip
MESH_EVERY = 4  # states, of which a recording keeps the moved surface
DENT = 6e-3  # m around a contact, in which a wall that gives is drawn pressed in


@dataclass(frozen=True, eq=False)
class VesselRecord:
    """A vessel over T+1 states.

    Attributes:
        series: (T+1,) by name, see `SERIES`.
        blood_velocity: (T+1, 3), at the head, m/s, world frame.
        goal: (T+1, 3), m, world frame.
        motion: How it moves; None where it rests.
        parameters: Of the motion, see `anatomy.motion_loops`.
        depth: (K,), of the contacts in a wall that gives, m, or (0,).
    """

    series: dict[str, np.ndarray]
    blood_velocity: np.ndarray
    goal: np.ndarray
    motion: Motion | None
    parameters: np.ndarray
    depth: np.ndarray

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
        depth = np.array(given.get("depth", []), np.float64)
        motion = Motion(lattice) if lattice.size else None
        series = {name: np.array(given[name], np.float64) for name in SERIES}
        return cls(series, velocity, goal, motion, parameters, depth)

    def curves(self) -> dict[str, tuple[np.ndarray, str]]:
        """What is drawn over time (T+1,), by name, with labels.

        The phases stand as an ECG, a sum of five waves of this size for any heart, and
        as the depth of a breath.
        """
        found = {
            name: (factor * self.series[name], label)
            for name, (factor, label) in SERIES.items()
        }
        place, width, height = _WAVES.T
        way = self.series["heart_phase"][:, None] - place
        way -= np.round(way)
        ecg = np.exp(-0.5 * (way / width) ** 2) @ height
        breath = 0.5 - 0.5 * np.cos(2.0 * np.pi * self.series["breath_phase"])
        found["heart_phase"] = ecg, "ECG, schematic"
        found["breath_phase"] = breath, "depth of the breath"
        return found

    @property
    def still(self) -> bool:
        """Whether its surface is always that at rest."""
        return self.motion is None and not self.depth.any()

    def surface(self, rest: Surface, episode: Episode, state: int) -> Surface:
        """The surface of the lumen in a state, with the dents of the contacts."""
        if self.motion is not None:
            time = float(episode.time[state])
            rest = self.motion.surface(self.parameters, time, rest)
        there = episode.contact_step == state - 1  # contacts of state t + 1: step t
        if not self.depth.size or not there.any():
            return rest
        return dented(rest, episode.contact_position[there], self.depth[there])


def dented(surface: Surface, place: np.ndarray, depth: np.ndarray) -> Surface:
    """A surface pressed outwards by contacts (K, 3) m of depths (K,) m.

    A vertex goes outwards by the depth of the nearest contact, less towards `DENT`.
    """
    distance, nearest = KDTree(place).query(surface.vertices)
    share = np.clip(1.0 - (distance / DENT) ** 2, 0.0, None) ** 2
    way = (share * np.maximum(depth[nearest], 0.0))[:, None]
    return Surface(surface.vertices + way * surface.normals, surface.faces)


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


def dents(task: Any, contacts: Any) -> np.ndarray:
    """Depths (K,) m of the contacts; (0,) in a wall that does not give."""
    gives = task.config.vessel_options.wall is not None
    return contacts.penetration[contacts.present] if gives else np.zeros(0)
