"""Scripted insertions; convergence of tip path and wall force with step and links."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.anatomy import Anatomy, Centreline, Goal
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.tasks.config import (
    CONTROL_TIMESTEP,
    PHYSICS_TIMESTEP,
    NavigationConfig,
)
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
CURL_TIME = 2.0  # s


@dataclasses.dataclass(frozen=True)
class Script:
    """An insertion that depends on nothing but the time.

    Attributes:
        name: where it leads in the type-I arch.
        speed: of the base, share of its full speed.
        curl: commands in [-1, 1] of all tip motors about x and about y, reached in
            `CURL_TIME`.
        duration: s.
    """

    name: str
    speed: float
    curl: tuple[float, float]
    duration: float

    def action(self, step: int, task: Any) -> np.ndarray:
        """Action (A,) of a control step of a task."""
        catheter, action = task.scene.catheter, np.zeros(task.num_actions)
        ramp = min(1.0, (step + 1) * CONTROL_TIMESTEP / CURL_TIME)
        motors = len(catheter.tip_motors)
        action[0:motors:2], action[1:motors:2] = ramp * np.array(self.curl)[:, None]
        action[list(catheter.translations)] = self.speed
        return action


# Over the arch along its wall, into the first branch, into the last one.
SCRIPTS = (
    Script("over the arch", 0.5, (0.3, 0.0), 8.0),
    Script("into the BCA", 0.5, (0.0, 0.0), 6.4),
    Script("into the LSA", 0.5, (-0.3, 0.0), 7.2),
)


def run(
    script: Script,
    *,
    seed: int = 0,
    anatomy: str | Anatomy = "type1",
    goal: str | Goal = "lcca",
    **options: Any,
) -> Episode:
    """Runs a script until its end or that of the episode.

    Args:
        goal: it sets the stroke of the base.
        **options: further fields of `tasks.navigation.NavigationConfig`.

    Raises:
        RuntimeError: if the simulation diverges.
    """
    kwargs = {"random": seed, "anatomy": anatomy, "goal": goal, **options}
    environment = suite.load(suite.DOMAIN, "navigate", kwargs)
    steps, duration = itertools.count(), round(script.duration / CONTROL_TIMESTEP)
    episode = EpisodeRecorder(environment).record_episode(
        lambda _: script.action(next(steps), environment.task), max_steps=duration
    )
    environment.close()
    if "error" in episode.meta:
        raise RuntimeError(
            f"insertion {script.name!r} with {options} diverged at step {episode.steps}"
        )
    return episode


def study(script: Script, parameter: str, values: Sequence[float]) -> dict[str, Any]:
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
    runs = [run(script, **each) for each in options]  # type: ignore
    heads = [one.head[1:] for one in runs]
    away = [1e3 * np.linalg.norm(head - heads[0], axis=1) for head in heads]
    track = [1e3 * _off(head, heads[0]) for head in heads]
    return {
        "script": script.name,
        "parameter": parameter,
        "value": ascending,
        "path_mean_mm": [float(each.mean()) for each in away],
        "path_max_mm": [float(each.max()) for each in away],
        "track_max_mm": [float(each.max()) for each in track],
        "force_mean": [float(one.wall_force_sum.mean()) for one in runs],
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
        for script in SCRIPTS
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
