"""Convergence of tip path and wall force of scripted insertions."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cathsim_dmc import suite
from cathsim_dmc.anatomy import Centreline
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder
from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks import config
from cathsim_dmc.tasks.config import CONTROL_TIMESTEP
from cathsim_dmc.validation.checks import Check

TIMESTEPS = (0.001, 0.002, 0.004, 0.008)  # s
SHAFT_LINKS = (0.005, 0.007, 0.010, 0.014, 0.0175, 0.025)  # m
DEFAULTS = {
    "physics_timestep": config.PHYSICS_TIMESTEP,
    "shaft_link": config.NavigationConfig().shaft_link,
}
# The start of an episode varies by up to 1 mm; a coarser model may not displace the
# path by more than that on average.
PATH_BOUND = 1.0  # mm
FORCE_BOUND = 10.0  # % of the mean wall force
# Least mean wall force of a script whose force is compared, N.
LEAST_FORCE = 1e-3
# Judged force on the published tasks: tip commands and duration of pushes, which are at
# half speed.
TASKS = ("type1_bca", "type1_lcca", "type2_bca", "type2_lcca")
CURLS = ((0.0, 0.0), (0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3), (0.2, 0.2))
PUSH = 6.0  # s
JUDGED_BOUND = 5.0  # % of the mean of the judged force
FINE = 0.001  # s
# Largest forces of a physics step under full pushes: one task for each kind of device
# and arch.
PEAK_TASKS = ("type1_lcca", "type2_lcca", "type1_lcca_pair", "femoral_type1_lcca_pair")
PEAK_TASKS += ("type2_lcca_pair",)
# Rotations of the two devices of a pair.
TURNS = ((1.0, 0.5), (0.6, 0.3), (0.2, 0.1), (-0.2, -0.1), (-0.6, -0.3), (-1.0, -0.5))
FINEST = 0.0005  # s
CURL_TIME = 2.0  # s
FIGURES = ("path_mean_mm", "path_max_mm", "track_max_mm", "force_mean")


@dataclasses.dataclass(frozen=True)
class Script:
    """An open-loop insertion."""

    name: str  # its course in the type-I arch
    speed: float  # of the base, share of its full speed
    # After `CURL_TIME`: commands of tip motors about x and y, or those of the rotations
    # of passive devices.
    curl: tuple[float, float]
    duration: float  # s

    def action(self, step: int, task: Any) -> np.ndarray:
        """Action (A,) of a control step of a task."""
        catheter, action = task.scene.catheter, np.zeros(task.num_actions)
        ramp = min(1.0, (step + 1) * CONTROL_TIMESTEP / CURL_TIME)
        motors = len(catheter.tip_motors)
        curl, ways = ramp * np.array(self.curl), np.array(catheter.translations)
        if motors:
            action[0:motors:2], action[1:motors:2] = curl[:, None]
        else:
            action[ways + 1] = curl[: len(ways)]
        action[ways] = self.speed
        return action


# Over the arch along its wall, into the first branch, and into the last.
SCRIPTS = (
    Script("over the arch", 0.5, (0.3, 0.0), 8.0),
    Script("into the BCA", 0.5, (0.0, 0.0), 6.4),
    Script("into the LSA", 0.5, (-0.3, 0.0), 7.2),
)


def run(script: Script, *, seed: int = 0, **options: Any) -> Episode:
    """Runs a script in the type-I arch until its end or that of the episode.

    Args:
        **options: further fields of `tasks.config.NavigationConfig`.

    Raises:
        RuntimeError: if the simulation diverges.
    """
    kwargs = {"random": seed, "anatomy": "type1", "goal": "lcca", **options}
    environment = suite.load(suite.DOMAIN, "navigate", kwargs)
    steps, duration = itertools.count(), round(script.duration / CONTROL_TIMESTEP)
    episode = EpisodeRecorder(environment).record_episode(
        lambda _: script.action(next(steps), environment.task), max_steps=duration
    )
    environment.close()
    if "error" in episode.meta:
        where = f"with {options} diverged at step {episode.steps}"
        raise RuntimeError(f"insertion {script.name!r} {where}")
    return episode


def study(script: Script, parameter: str, values: Sequence[float]) -> dict[str, Any]:
    """Runs a script at several resolutions, other settings at their defaults.

    Args:
        parameter: "physics_timestep" (s) or "shaft_link" (m).

    Returns:
        "script" (name), "parameter", and lists with an entry for each value, ascending:
        "value" and `FIGURES`: mean and largest distance (mm) of the head from that of
        the finest run at the same time, largest distance (mm) from the track of the
        finest run, and mean wall force, N.
    """
    ascending = sorted(float(value) for value in values)
    # With a tiny goal the script runs to its end.
    fixed: dict[str, Any] = {"goal_radius": 1e-5, "outside_range": True}
    options: list[dict[str, Any]] = [fixed | {parameter: one} for one in ascending]
    runs = [run(script, **each) for each in options]
    heads = [one.head[1:] for one in runs]
    away = 1e3 * np.linalg.norm(np.array(heads) - heads[0], axis=-1)
    # A centreline needs distinct points: steps without motion are left out.
    moves = np.append(True, np.any(np.diff(heads[0], axis=0) != 0.0, axis=1))
    track = Centreline(heads[0][moves], np.ones(moves.sum()))
    off = [1e3 * track.project(head).distance.max() for head in heads]
    return {
        "script": script.name,
        "parameter": parameter,
        "value": ascending,
        "path_mean_mm": away.mean(axis=1).tolist(),
        "path_max_mm": away.max(axis=1).tolist(),
        "track_max_mm": off,
        "force_mean": [float(one.wall_force_sum.mean()) for one in runs],
    }


def studies() -> list[dict[str, Any]]:
    """Studies of both parameters for each script."""
    resolutions = {"physics_timestep": TIMESTEPS, "shaft_link": SHAFT_LINKS}
    return [
        study(script, name, values)
        for script in SCRIPTS
        for name, values in resolutions.items()
    ]


def checks(results: Sequence[dict[str, Any]]) -> Iterator[Check]:
    """Checks that the default resolution, one of the values, is converged."""
    units = {"physics_timestep": ("step", "ms"), "shaft_link": ("links", "mm")}
    for one in results:
        default, (kind, unit) = DEFAULTS[one["parameter"]], units[one["parameter"]]
        name = f"{kind} of {1e3 * default:g} {unit} against "
        name += f"{1e3 * one['value'][0]:g} {unit}, {one['script']}: mean "
        index = one["value"].index(default)
        path, largest, off, force = (one[key][index] for key in FIGURES)
        note = f"largest {largest:.2f} mm, off the track by at most {off:.2f} mm"
        away = f"{name}distance of the tip paths"
        yield Check.at_most(away, path, PATH_BOUND, "mm", note)
        reference = one["force_mean"][0]
        if reference > LEAST_FORCE:
            what, expected = f"{name}wall force", 1e3 * reference
            yield Check.deviation(what, 1e3 * force, expected, FORCE_BOUND, "mN")


def pushed(task: str, timestep: float, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Sums of the wall force in pushes with `CURLS`, or `TURNS` of a pair, in a task.

    Args:
        task: Name of the task.
        timestep: Physics step, s.
        speed: Of the base, share of its full speed.

    Returns:
        Mean over each control step, the judged force, and largest value of its physics
        steps, (steps, pushes), N.
    """
    made = suite.make_task(task, physics_timestep=timestep, observation="tracking")
    batch = BatchSimulation(made, len(CURLS), num_threads=1, seeds=[0] * len(CURLS))
    batch.reset()
    ways = CURLS if made.scene.catheter.tip_motors else TURNS
    scripts, found = [Script("", speed, way, PUSH) for way in ways], []
    for step in range(round(PUSH / CONTROL_TIMESTEP)):
        action = np.stack([script.action(step, made) for script in scripts])
        force = batch.step(action).wall_force
        found.append([force.mean_sum, force.peak_sum])
    mean, peak = np.moveaxis(np.array(found), 1, 0)
    return mean, peak


def judged(task: str, timestep: float) -> tuple[float, float]:
    """Judged force of pushes at half speed in a task.

    Returns:
        Its mean over all control steps and pushes, and the mean over the pushes of its
        largest value, N.
    """
    mean, _ = pushed(task, timestep, 0.5)
    return float(mean.mean()), float(mean.max(axis=0).mean())


def peaks() -> dict[str, dict[str, float]]:
    """Largest force of full pushes at the default physics step over that at `FINEST`.

    By task: lowest and highest ratio of its pushes.
    """
    found = {}
    for task in PEAK_TASKS:
        usual, fine = (
            pushed(task, one, 1.0)[1].max(axis=0)
            for one in (config.PHYSICS_TIMESTEP, FINEST)
        )
        ratio = usual / fine
        found[task] = {"lowest": float(ratio.min()), "highest": float(ratio.max())}
    return found


def judged_checks() -> Iterator[Check]:
    """Checks that the judged force of the published tasks is converged."""
    for task in TASKS:
        usual, fine = (judged(task, one) for one in (config.PHYSICS_TIMESTEP, FINE))
        name = f"{task}: judged force, step of {1e3 * config.PHYSICS_TIMESTEP:g} ms "
        name += f"against {1e3 * FINE:g} ms"
        note = f"mean {1e3 * usual[0]:.2f} mN for {1e3 * fine[0]:.2f} mN, largest "
        note += f"{1e3 * usual[1]:.1f} mN for {1e3 * fine[1]:.1f} mN"
        yield Check.deviation(name, usual[0], fine[0], JUDGED_BOUND, "N", note)
