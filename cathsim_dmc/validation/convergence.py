"""Convergence of tip path and wall force with the time step and the link length."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from cathsim_dmc.tasks.config import PHYSICS_TIMESTEP, NavigationConfig
from cathsim_dmc.validation import insertion
from cathsim_dmc.validation.checks import Check

TIMESTEPS = (0.001, 0.002, 0.004, 0.008)  # s
SHAFT_LINKS = (0.005, 0.007, 0.010, 0.014, 0.0175, 0.025)  # m
# The start of an episode is displaced by up to 1 mm; a coarser model may not move the
# path by more than that on average.
PATH_BOUND = 1.0  # mm
FORCE_BOUND = 10.0  # % of the mean wall force
# A script with less wall force than this on average says nothing about it, N.
_LEAST_FORCE = 1e-3


@dataclasses.dataclass(frozen=True)
class Study:
    """One script at several resolutions; the first is the finest.

    Attributes:
        script: which insertion.
        parameter: "physics_timestep" or "shaft_link".
        values: (n,), s or m, ascending.
        links: (n,), number of links.
        path_mean: (n,), mean distance of the head from the finest run's at the same
            time, m.
        path_max: (n,), largest, m. A tip that slips a moment later is far from itself.
        track_max: (n,), largest distance of the head from the finest run's track,
            whatever the time, m.
        force_mean: (n,), mean wall force, N.
        force_p95: (n,), N.
        penetration_max: (n,), m.
    """

    script: insertion.Script
    parameter: str
    values: np.ndarray
    links: np.ndarray
    path_mean: np.ndarray
    path_max: np.ndarray
    track_max: np.ndarray
    force_mean: np.ndarray
    force_p95: np.ndarray
    penetration_max: np.ndarray

    def at(self, value: float) -> int:
        """Index of a value of the parameter."""
        return int(np.flatnonzero(np.isclose(self.values, value))[0])

    def force_deviation(self, value: float) -> float:
        """Deviation of the mean wall force from the finest run, %; signed."""
        return float(100 * (self.force_mean[self.at(value)] / self.force_mean[0] - 1))


def study(script: insertion.Script, parameter: str, values: Sequence[float]) -> Study:
    """Runs a script at several resolutions, other settings at their defaults."""
    ascending = np.sort(np.asarray(values, dtype=float))
    runs = [insertion.run(script, **{parameter: value}) for value in ascending.tolist()]
    distance = [np.linalg.norm(run.head - runs[0].head, axis=1) for run in runs]
    return Study(
        script=script,
        parameter=parameter,
        values=ascending,
        links=np.array([run.links for run in runs]),
        path_mean=np.array([each.mean() for each in distance]),
        path_max=np.array([each.max() for each in distance]),
        track_max=np.array(
            [polyline_distance(run.head, runs[0].head).max() for run in runs]
        ),
        force_mean=np.array([run.wall_force.mean() for run in runs]),
        force_p95=np.array([np.percentile(run.wall_force, 95) for run in runs]),
        penetration_max=np.array([run.penetration.max() for run in runs]),
    )


def polyline_distance(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance (n,) of points (n, 3) from a polyline (m, 3), in their unit."""
    start, along = line[:-1], np.diff(line, axis=0)
    square = np.maximum((along**2).sum(-1), np.finfo(float).tiny)
    offset = points[:, None] - start
    share = np.clip((offset * along).sum(-1) / square, 0.0, 1.0)
    nearest = offset - share[..., None] * along
    return np.sqrt((nearest**2).sum(-1).min(axis=1))


def studies(
    scripts: Sequence[insertion.Script] = insertion.SCRIPTS,
    timesteps: Sequence[float] = TIMESTEPS,
    shaft_links: Sequence[float] = SHAFT_LINKS,
) -> list[Study]:
    """Studies of both parameters for each script; default values must be among them."""
    return [
        study(script, parameter, values)
        for script in scripts
        for parameter, values in (
            ("physics_timestep", timesteps),
            ("shaft_link", shaft_links),
        )
    ]


def checks(results: Sequence[Study]) -> list[Check]:
    """Whether the defaults are converged."""
    defaults = {
        "physics_timestep": PHYSICS_TIMESTEP,
        "shaft_link": NavigationConfig().shaft_link,
    }
    found = []
    for one in results:
        default = defaults[one.parameter]
        label = (
            f"step of {1e3 * default:g} ms against {1e3 * one.values[0]:g} ms"
            if one.parameter == "physics_timestep"
            else f"links of {1e3 * default:g} mm against {1e3 * one.values[0]:g} mm"
        )
        index = one.at(default)
        found.append(
            Check.at_most(
                f"{label}, {one.script.name}: mean distance of the tip paths",
                1e3 * one.path_mean[index],
                PATH_BOUND,
                "mm",
                f"largest {1e3 * one.path_max[index]:.2f} mm, off the track by at "
                f"most {1e3 * one.track_max[index]:.2f} mm",
            )
        )
        if one.force_mean[0] > _LEAST_FORCE:
            found.append(
                Check.at_most(
                    f"{label}, {one.script.name}: mean wall force",
                    abs(one.force_deviation(default)),
                    FORCE_BOUND,
                    "%",
                    f"{1e3 * one.force_mean[index]:.1f} mN against "
                    f"{1e3 * one.force_mean[0]:.1f} mN",
                )
            )
    return found


def summary(one: Study) -> dict[str, Any]:
    """Plain values of a study; lengths in mm, forces in N."""
    return {
        "script": one.script.name,
        "parameter": one.parameter,
        "value": one.values.tolist(),
        "links": one.links.tolist(),
        "path_mean_mm": (1e3 * one.path_mean).tolist(),
        "path_max_mm": (1e3 * one.path_max).tolist(),
        "track_max_mm": (1e3 * one.track_max).tolist(),
        "force_mean": one.force_mean.tolist(),
        "force_p95": one.force_p95.tolist(),
        "penetration_max_mm": (1e3 * one.penetration_max).tolist(),
    }
