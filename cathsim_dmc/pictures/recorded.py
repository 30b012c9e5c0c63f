"""An episode of any policy, recorded in one call."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cathsim_dmc import bounds, files, policies
from cathsim_dmc.anatomy.parts import Surface
from cathsim_dmc.imaging.angiograph import Angiograph
from cathsim_dmc.imaging.options import FluoroscopyOptions
from cathsim_dmc.pictures.films import SUFFIXES, check_film
from cathsim_dmc.pictures.moment import on_screen
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.recorder import EpisodeRecorder, navigation_of
from cathsim_dmc.recording.records import MESH_EVERY, VesselRecord, XRayRecord
from cathsim_dmc.tasks.snapshot import Snapshot

# A name of `policies.POLICIES`, a policy, or a function from the observation (a
# dictionary of arrays) to the action (A,).
AnyPolicy = str | policies.Policy | Callable[[Any], np.ndarray]
FORMATS = (".rrd", ".npz", *SUFFIXES)
_FILM_SIZE = 512  # pixels along a side of the X-ray images of a recording
_TOGETHER = 8  # states whose X-ray images are drawn together


def record(
    env: Any,
    policy: AnyPolicy,
    path: str | os.PathLike[str] | None = None,
    *,
    seed: int | None = None,
    max_steps: int | None = None,
    task_name: str | None = None,
    start: Snapshot | None = None,
) -> Episode:
    """Play one episode and keep it.

    Args:
        env: What `cathsim_dmc.suite.load` returns; it stays usable.
        policy: Name in `policies.POLICIES`, a `Policy`, or a function from the
            observation to the action.
        path: File to write: `.rrd` (Rerun), `.npz` (arrays), `.gif`, `.webp` or
            `.mp4` (moving picture); None writes none.
        seed: Seed of the episode; None continues the environment's random state. With
            `start` it seeds the policy alone.
        max_steps: Number of control steps after which the episode is cut off.
        task_name: Name of the task in the record; that of the environment otherwise.
        start: Snapshot of a running episode, which the policy continues; the record
            begins there. None for a new episode.

    Returns:
        The episode.

    Raises:
        TypeError: `env` is no environment of this package, or `policy` no policy.
        ValueError: the policy's name or the file's kind does not exist, or the policy
            returns no action of the environment, or `start` is of another task or of
            an episode that has ended.
        OSError: the file's folder does not exist or is read-only.
        ImportError: `path` is an MP4 and the extra `video` is missing.
    """
    if path is not None:
        _checked(path)
    recorder = EpisodeRecorder(env, task_name or navigation_of(env).name)
    act, drawn = as_function(policy, env, seed), seed if start is None else None
    episode = recorder.record_episode(act, drawn, max_steps, start)
    if path is not None:
        write(episode, env, path)
    return episode


def _checked(path: str | os.PathLike[str]) -> Path:
    """Returns the path; raises if no file of its kind can be written there."""
    target = files.as_path("path", path)
    if target.suffix not in FORMATS:
        raise ValueError(
            f"the recording is to be written to {target}; give a file that ends in "
            f"{', '.join(FORMATS)}"
        )
    if target.suffix in SUFFIXES:
        check_film(target)
    return files.require_file(target)


def as_function(
    policy: AnyPolicy, env: Any, seed: int | None = None
) -> Callable[[Any], np.ndarray]:
    """Converts a policy to a function from the time step to the action (A,).

    Raises:
        ValueError: if a name does not exist.
        TypeError: if `policy` is no policy.
    """
    named = isinstance(policy, str)
    if named and policy in policies.POLICIES:
        policy = policies.make_policy(policy, seed or 0)
    if isinstance(policy, policies.Policy):
        return policies.in_environment(policy, env)
    if not callable(policy):
        raise (ValueError if named else TypeError)(
            f"the policy is {policy!r}; give one of {', '.join(policies.POLICIES)}, "
            "what cathsim_dmc.agents.load_policy returns for a trained one, another "
            "cathsim_dmc.policies.Policy, or a function from the observation to the "
            "action"
        )
    if hasattr(policy, "in_keys"):
        raise TypeError(
            f"the policy is a {type(policy).__name__}, which reads a TensorDict; give "
            "cathsim_dmc.agents.load_policy(policy)"
        )
    return lambda timestep: np.asarray(policy(timestep.observation))


def write(
    episode: Episode, env: Any, path: str | os.PathLike[str], fluoroscopy: bool = True
) -> Path:
    """Write an episode in the format of the file's suffix.

    Args:
        env: The environment, for the anatomy and the shapes of the robot.
        path: File to write, see `record`.
        fluoroscopy: Whether a Rerun file has X-ray images.

    Raises:
        ValueError: the environment does not have the anatomy of the episode.
    """
    target = _checked(path)
    if target.suffix == ".npz":
        return episode.save(target)
    surface = surface_of(episode, env)
    if target.suffix == ".rrd":
        from cathsim_dmc.recording.rerun_log import write_rrd
        from cathsim_dmc.recording.rerun_scene import body_geoms

        film = None
        if fluoroscopy:
            # The task's own view and a second plane, in the size of a screen.
            own = XRayRecord.of(episode).options
            view = {"size": _FILM_SIZE, "biplane": own.biplane or "LATERAL"}
            film = xray_film(episode, surface, on_screen(own, **view))
        geoms = body_geoms(env.physics)
        return write_rrd(episode, surface, target, robot_geoms=geoms, fluoroscopy=film)
    from cathsim_dmc.pictures.animation import animate

    return animate(episode, surface, target)


def surface_of(episode: Episode, env: Any) -> Surface:
    """Lumen surface of the environment's anatomy in which an episode was recorded.

    ValueError if the environment does not have that anatomy.
    """
    bounds.instance("the episode", episode, Episode)
    task = navigation_of(env)
    given = [episode.meta.get(entry) for entry in ("anatomy", "lumen")]
    names = []
    for anatomy in (task.scene.anatomy, *task.anatomies):
        own = [anatomy.name, anatomy.digest]  # other lumens have the same name
        if all(one in (None, its) for one, its in zip(given, own, strict=True)):
            return anatomy.surface
        names.append(" ".join(own))
    named = " ".join(filter(None, given))
    raise ValueError(
        f"the episode of {episode.task!r} was recorded in the anatomy {named!r}, and "
        f"the environment has {bounds.shown(names[1:])}; load the task with that "
        "anatomy, random arches with the same arches, pool and first"
    )


def xray_film(
    episode: Episode, surface: Any, options: FluoroscopyOptions
) -> np.ndarray:
    """X-ray images of all states of an episode, stretched to all grey levels.

    Args:
        surface: Lumen surface, `anatomy.surface`.

    Returns:
        (T + 1, rows, columns, planes) uint8, the frontal plane first. The darkest and
        the brightest grey level of each plane are black and white. A vessel that moves
        is updated in every fourth state.
    """
    record, states = VesselRecord.of(episode), episode.steps + 1
    x_ray = XRayRecord.of(episode)
    moved = None if record is None or record.motion is None else record
    # In small parts: rendering thousands of states at once takes gigabytes.
    span = MESH_EVERY if moved else _TOGETHER
    parts = [slice(first, first + span) for first in range(0, states, span)]
    planes = Angiograph(surface, options).planes(x_ray.deviation)
    films = np.empty((states, *planes[0].carm.resolution, len(planes)), np.uint8)
    for number, plane in enumerate(planes):
        film = films[..., number]
        for rows in parts:
            if moved:
                plane = plane.around(moved.surface(surface, rows.start))
            film[rows] = plane.render(x_ray.shadows(episode, rows))[..., 0]
        darkest, brightest = int(film.min()), int(film.max())
        levels = 255 * (np.arange(256.0) - darkest) / max(brightest - darkest, 1)
        levels = np.clip(levels, 0, 255).round().astype(np.uint8)
        for rows in parts:
            film[rows] = levels[film[rows]]
    return films
