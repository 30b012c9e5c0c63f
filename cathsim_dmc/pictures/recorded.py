"""An episode of any policy, recorded in one call."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import policies
from cathsim_dmc.imaging.angiograph import Angiograph
from cathsim_dmc.imaging.device import Shadow
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder, navigation_of
from cathsim_dmc.recording.records import MESH_EVERY, VesselRecord

# A name of `policies.POLICIES`, a policy, or a function from the observation (a
# dictionary of arrays) to the action (A,).
AnyPolicy = str | policies.Policy | Callable[[Any], np.ndarray]
FORMATS = (".rrd", ".npz", ".gif", ".webp")
# X-ray images of a recording: pixels along a side, and how far the view is zoomed in.
_FILM_SIZE, _FILM_MAGNIFICATION = 512, 1.3


def record(
    env: Any,
    policy: AnyPolicy,
    path: str | os.PathLike[str] | None = None,
    *,
    seed: int | None = None,
    max_steps: int | None = None,
    task_name: str | None = None,
) -> Episode:
    """Play one episode and keep it.

    Args:
        env: What `cathsim_dmc.suite.load` returns; it stays usable.
        policy: Name in `policies.POLICIES`, a `Policy`, or a function from the
            observation to the action.
        path: File to write: `.rrd` (Rerun), `.npz` (arrays), `.gif` or `.webp`
            (moving picture); None writes none.
        seed: Seed of the episode; None goes on from the environment's random state.
        max_steps: Number of control steps after which the episode is cut off.
        task_name: Name of the task in the record; that of the environment otherwise.

    Returns:
        The episode.

    Raises:
        TypeError: the environment or the policy is none.
        ValueError: the policy's name or the file's kind does not exist, or the policy
            returns no action of the environment.
        FileNotFoundError: the file's folder does not exist.
    """
    if path is not None:
        _checked(path)
    recorder = EpisodeRecorder(env, task_name or navigation_of(env).name)
    episode = recorder.record_episode(as_function(policy, env, seed), seed, max_steps)
    if path is not None:
        write(episode, env, path)
    return episode


def _checked(path: str | os.PathLike[str]) -> Path:
    """The path, if a file of its kind can be written there."""
    target = Path(path)
    if target.suffix not in FORMATS:
        raise ValueError(
            f"the recording is to be written to {target}; give a file that ends in "
            f"{', '.join(FORMATS)}"
        )
    if not target.parent.is_dir():
        raise FileNotFoundError(f"no folder {target.parent}; make it first")
    return target


def as_function(
    policy: AnyPolicy, env: Any, seed: int | None = None
) -> Callable[[Any], np.ndarray]:
    """A policy as a function of the timestep; ValueError or TypeError for others."""
    if isinstance(policy, str):
        policy = policies.make_policy(policy, seed or 0)
    if isinstance(policy, policies.Policy):
        return policies.in_environment(policy, env)
    if not callable(policy):
        raise TypeError(
            f"the policy is {policy!r}; give one of {', '.join(policies.POLICIES)}, a "
            "cathsim_dmc.policies.Policy, or a function from the observation to the "
            "action"
        )
    return lambda timestep: np.asarray(policy(timestep.observation))


def write(
    episode: Episode, env: Any, path: str | os.PathLike[str], fluoroscopy: bool = True
) -> Path:
    """Write an episode in the format that the file's name asks for.

    Args:
        env: The environment, for the anatomy and the shapes of the robot.
        path: File to write, see `record`.
        fluoroscopy: Whether a Rerun file has X-ray images.
    """
    target = _checked(path)
    surface = navigation_of(env).scene.anatomy.surface
    if target.suffix == ".npz":
        return episode.save(target)
    if target.suffix == ".rrd":
        from cathsim_dmc.recording.rerun_log import write_rrd
        from cathsim_dmc.recording.rerun_scene import body_geoms

        own, film = env.task.config.fluoroscopy, None
        if fluoroscopy:
            # The task's own view and a second plane, in the size of a screen.
            view = {"size": _FILM_SIZE, "noise": False}
            view["magnification"] = max(own.magnification, _FILM_MAGNIFICATION)
            view["biplane"] = own.biplane or "LATERAL"
            film = xray_film(episode, surface, dataclasses.replace(own, **view))
        geoms = body_geoms(env.physics)
        return write_rrd(episode, surface, target, robot_geoms=geoms, fluoroscopy=film)
    from cathsim_dmc.pictures.animation import animate

    return animate(episode, surface, target)


def xray_film(
    episode: Episode, surface: Any, options: FluoroscopyOptions
) -> np.ndarray:
    """X-ray images of all states of an episode, with the contrast of a screen.

    Args:
        surface: Lumen surface, `anatomy.surface`.

    Returns:
        (T + 1, rows, columns, planes) uint8, the frontal plane first. The darkest and
        the brightest of each plane's grey levels are black and white. A vessel that
        moves is drawn anew in every fourth state.
    """
    record, states, films = VesselRecord.of(episode), episode.steps + 1, []
    moved = None if record is None or record.motion is None else record
    span = MESH_EVERY if moved else states
    for plane in Angiograph(surface, options).planes():
        film = np.empty((states, *plane.carm.resolution, 1), np.uint8)
        for first in range(0, states, span):
            line = episode.catheter[first : first + span]
            radius = np.broadcast_to(episode.radii, (len(line), len(episode.radii)))
            if moved:
                plane = plane.around(moved.surface(surface, episode.time[first]))
            film[first : first + span] = plane.render([Shadow(line, radius)])
        darkest, brightest = int(film.min()), int(film.max())
        levels = 255 * (np.arange(256.0) - darkest) / max(brightest - darkest, 1)
        films.append(np.clip(levels, 0, 255).round().astype(np.uint8)[film])
    return np.concatenate(films, axis=-1)
