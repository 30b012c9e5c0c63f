"""Convergence of tip path and wall force with the time step and the link length."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cathsim_dmc.anatomy import Centreline
from cathsim_dmc.tasks.config import PHYSICS_TIMESTEP, NavigationConfig
from cathsim_dmc.validation import insertion
from cathsim_dmc.validation.checks import Check

TIMESTEPS = (0.001, 0.002, 0.004, 0.008)  # s
SHAFT_LINKS = (0.005, 0.007, 0.010, 0.014, 0.0175, 0.025)  # m
DEFAULTS = {
    "physics_timestep": PHYSICS_TIMESTEP,
    "shaft_link": NavigationConfig().shaft_link,
}
# The start of an episode is displaced by up to 1 mm; a coarser model may not move the
# path by more than that on average.
PATH_BOUND = 1.0  # mm
FORCE_BOUND = 10.0  # % of the mean wall force
# Least mean wall force of a script whose force is compared, N.
LEAST_FORCE = 1e-3


def study(
    script: insertion.Script, parameter: str, values: Sequence[float]
) -> dict[str, Any]:
    """Runs a script at several resolutions, other settings at their defaults.

    Args:
        parameter: "physics_timestep" (s) or "shaft_link" (m).

    Returns:
        "script" (name), "parameter", and lists with an entry for each value: "value",
        mean and largest distance (mm) of the head from the finest run's at the same
        time ("path_mean_mm", "path_max_mm") and from its track whatever the time
        ("track_max_mm"), and "force_mean" (N), that of the wall force.
    """
    ascending = sorted(float(value) for value in values)
    # A tiny goal: the script runs to its end.
    fixed = {"goal_radius": 1e-5, "outside_range": True}
    options = [{**fixed, parameter: value} for value in ascending]
    runs = [insertion.run(script, **each) for each in options]  # type: ignore
    away = [1e3 * np.linalg.norm(run.head - runs[0].head, axis=1) for run in runs]
    track = [1e3 * _off(run.head, runs[0].head) for run in runs]
    return {
        "script": script.name,
        "parameter": parameter,
        "value": ascending,
        "path_mean_mm": [float(each.mean()) for each in away],
        "path_max_mm": [float(each.max()) for each in away],
        "track_max_mm": [float(each.max()) for each in track],
        "force_mean": [float(run.wall_force_sum.mean()) for run in runs],
    }


def _off(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distances (n,) of points (n, 3) from a polyline (m, 3), m."""
    moves = np.append(True, np.any(np.diff(line, axis=0) != 0.0, axis=1))
    track = Centreline(line[moves], np.ones(moves.sum()))
    return track.project(points).distance


def studies() -> list[dict[str, Any]]:
    """Studies of both parameters for each script."""
    resolutions = {"physics_timestep": TIMESTEPS, "shaft_link": SHAFT_LINKS}
    return [
        study(script, parameter, values)
        for script in insertion.SCRIPTS
        for parameter, values in resolutions.items()
    ]


def checks(results: Sequence[dict[str, Any]]) -> Iterator[Check]:
    """Whether the defaults, which are among the values, are converged."""
    for one in results:
        default, finest = DEFAULTS[one["parameter"]], one["value"][0]
        of_step = one["parameter"] == "physics_timestep"
        kind, unit = ("step", "ms") if of_step else ("links", "mm")
        label = f"{kind} of {1e3 * default:g} {unit} against {1e3 * finest:g} {unit}, "
        label += one["script"]
        index = int(np.argmin(np.abs(np.array(one["value"]) - default)))
        note = f"largest {one['path_max_mm'][index]:.2f} mm, off the track by at most "
        note += f"{one['track_max_mm'][index]:.2f} mm"
        path, name = (
            one["path_mean_mm"][index],
            f"{label}: mean distance of the tip paths",
        )
        yield Check.at_most(name, path, PATH_BOUND, "mm", note)
        force, reference = (1e3 * one["force_mean"][k] for k in (index, 0))
        if reference > 1e3 * LEAST_FORCE:
            name = f"{label}: mean wall force"
            yield Check.deviation(name, force, reference, FORCE_BOUND, "mN")
