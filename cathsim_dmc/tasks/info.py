"""Figures of a control step beside the observation: for logs, evaluations, wrappers."""

import numpy as np

from cathsim_dmc.tasks import forces, readings

# m, N, and the way gone over the shortest way.
MEASURES = (
    "distance",
    "insertion",
    "push_force",
    "wall_force_sum",
    "wall_force_max",
    "wall_force_peak",
    "path_ratio",
)
# Whether the goal was reached, and whether the physics failed.
FLAGS = ("success", "physics_error")


def measures(
    state: readings.Readings,
    wall_force: forces.WallForce,
    distance: np.ndarray,
    path_ratio: np.ndarray,
) -> dict[str, np.ndarray]:
    """`MEASURES` by name; every array has the leading axes of the readings."""
    return {
        "distance": distance,
        "insertion": state.insertion,
        "push_force": state.push_force,
        "wall_force_sum": wall_force.sum,
        "wall_force_max": wall_force.max,
        "wall_force_peak": wall_force.peak_max,
        "path_ratio": path_ratio,
    }
