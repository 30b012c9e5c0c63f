"""Recording of whole episodes of a composer environment."""

import functools
import itertools
import logging
import platform
from collections.abc import Callable
from importlib import metadata
from typing import Any

import numpy as np
from dm_control.rl import control

from cathsim_dmc.recording.coaxial import SERIES, device_meta
from cathsim_dmc.recording.episode import TERMINATIONS, Episode
from cathsim_dmc.recording.living import dents, vessel_meta, vessel_state
from cathsim_dmc.simulation.episodes import ComposerSimulation, play

Policy = Callable[[Any], np.ndarray]

_VERSIONED = ("cathsim-dmc", "mujoco", "dm-control", "numpy")


def navigation_of(env: Any) -> Any:
    """The task of an environment of this package; TypeError for any other."""
    task = getattr(env, "task", None)
    if not hasattr(task, "scene") or not hasattr(env, "physics"):
        raise TypeError(
            f"{type(env).__name__} is no environment of cathsim; give what "
            "cathsim_dmc.suite.load returns (a Gymnasium or TorchRL environment: the "
            "composer environment inside it)"
        )
    return task


def read_termination(task: Any, timestep: Any) -> str | None:
    """Return why the episode ended, or None while it runs.

    A task never sees the end by diverged physics or by composer's time limit: the
    environment then ends the episode itself, with discount 0 and 1.
    """
    if not timestep.last() or task.termination not in (None, "truncated"):
        return task.termination
    return "truncated" if timestep.discount else "physics_error"


class _EpisodeRows(dict[str, list]):
    """Growing lists, one per array of an episode."""

    def add(self, **values: Any) -> None:
        for name, value in values.items():
            self.setdefault(name, []).append(value)

    def array(self, name: str, row_shape: tuple[int, ...] = ()) -> np.ndarray:
        values = self.get(name)
        return np.array(values) if values else np.zeros((0, *row_shape))


class EpisodeRecorder:
    """Runs a policy in an environment and keeps everything that happened.

    The environment stays usable afterwards; nothing is switched on or changed in it.
    Poses are those the simulator holds after a step: with ``legacy_step=False`` they
    belong to the start of the last physics step, as do the contacts, while ``qpos``
    and ``time`` belong to its end.

    Args:
        env: What ``cathsim_dmc.suite.load`` returns; TypeError for any other.
        task_name: Registered name to write into episodes; the class name of the task
            otherwise.
        task_kwargs: Keyword arguments the environment was made with, for ``meta``.
    """

    def __init__(
        self,
        env: Any,
        task_name: str | None = None,
        task_kwargs: dict[str, Any] | None = None,
    ) -> None:
        navigation_of(env)
        self._env = env
        self._task_name = task_name or type(env.task).__name__
        self._task_kwargs = dict(task_kwargs or {})

    def record_episode(
        self, policy: Policy, seed: int | None = None, max_steps: int | None = None
    ) -> Episode:
        """Reset the environment, run one episode and return the record.

        A step in which the physics diverges ends the episode and is left out of it.

        Args:
            policy: Called with every ``dm_env.TimeStep``, returns the action. It may
                raise ``StopIteration`` to end the episode as truncated.
            seed: Seeds the environment's random state before the reset; with None it
                goes on from where it is and the episode cannot be repeated.
            max_steps: Ends the episode as truncated; by default only the environment
                ends it.

        Raises:
            ValueError: if the policy returns an action of a wrong shape or with
                values that are not finite, or ``max_steps`` is not positive.
        """
        if max_steps is not None and max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}")
        if seed is not None:
            self._env.random_state.seed(seed)
        turns = play(
            ComposerSimulation(self._env), functools.partial(self._action, policy)
        )
        next(turns)
        rows = _EpisodeRows()
        rows.add(**self._state())
        steps, error, termination, discount = 0, None, None, 1.0
        try:
            for action, timestep, _ in itertools.islice(turns, max_steps):
                discount = float(timestep.discount)
                termination = read_termination(self._env.task, timestep)
                if termination == "physics_error":
                    error = "the environment ended the episode"
                    break
                rows.add(**self._state())
                rows.add(action=action, reward=float(timestep.reward))
                forces, contacts = self._forces()
                rows.add(**forces)
                for name, values in contacts.items():
                    rows.setdefault(name, []).extend(values)
                rows.setdefault("contact_step", []).extend(
                    [steps] * len(contacts["contact_force"])
                )
                steps += 1
        except control.PhysicsError as caught:
            error, termination = str(caught), "physics_error"
        if error is not None:
            logging.getLogger(__name__).warning(
                "physics diverged after %d steps: %s", steps, error
            )
        meta = self._meta(rows, termination or "truncated", discount)
        if error is not None:
            meta["error"] = error
        return self._episode(rows, seed, meta)

    def present(self) -> Episode:
        """The present state as an episode of no steps."""
        rows = _EpisodeRows()
        rows.add(**self._state())
        return self._episode(rows, None, self._meta(rows, "truncated", 1.0))

    def _state(self) -> dict[str, Any]:
        data, task = self._env.physics.data, self._env.task
        devices = task.devices
        coaxial = {} if devices is None else {n: getattr(devices, n) for n in SERIES}
        return {
            **coaxial,
            "time": float(data.time),
            "qpos": np.array(data.qpos),
            "catheter": np.array(task.readings.centreline),
            "body_pos": np.array(data.xpos),
            "body_quat": np.array(data.xquat),
            "base_insertion": float(task.readings.insertion),
            **vessel_state(task),
        }

    def _forces(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Forces and reward terms of the step that has just ended, and contacts."""
        task, wall = self._env.task, self._env.task.wall_force
        contacts = task.contacts(self._env.physics)
        prefix = "reward_"
        forces = {
            **{name: float(value) for name, value in wall.named().items()},
            "push_force": float(task.readings.push_force),
            "reward_terms": {
                name.removeprefix(prefix): value
                for name, value in task.info().items()
                if name.startswith(prefix)
            },
        }
        return forces, {
            "contact_position": contacts.position[contacts.present],
            "contact_force": contacts.force[contacts.present],
            "contact_depth": dents(task, contacts),
        }

    def _action(self, policy: Policy, timestep: Any) -> np.ndarray:
        action = np.array(policy(timestep), dtype=np.float64)
        shape = self._env.action_spec().shape
        if action.shape != shape:
            raise ValueError(
                f"the policy returned an action of shape {action.shape}, the "
                f"environment takes {shape}"
            )
        if not np.isfinite(action).all():
            raise ValueError(f"the policy returned an action with {action}")
        return action

    def _meta(
        self, rows: _EpisodeRows, termination: str, discount: float
    ) -> dict[str, Any]:
        model, task = self._env.physics.model, self._env.task
        if termination not in TERMINATIONS:
            raise ValueError(
                f"the task ended with termination {termination!r}; it must be one of "
                f"{', '.join(TERMINATIONS)} or None"
            )
        meta = {
            "success": termination == "success",
            "termination": termination,
            "discount": discount,
            "task_kwargs": self._task_kwargs,
            "versions": _versions(),
            "control_timestep": float(self._env.control_timestep()),
            "action_names": self._env.action_spec().name.split("\t"),
            "body_names": [model.id2name(i, "body") for i in range(model.nbody)],
            "catheter_radius": [float(task.scene.device.outer_radius)]
            * len(task.scene.catheter.links),
            "wall_force_peak_sum": rows.array("wall_force_peak_sum").tolist(),
            "wall_force_peak_max": rows.array("wall_force_peak_max").tolist(),
            "reward_terms": _columns(rows.get("reward_terms", [])),
        }
        if SERIES[0] in rows:
            series = {name: rows.array(name) for name in SERIES}
            meta["devices"] = device_meta(task, series)
        position = task.objective.goal.reshape(3)
        meta["goal_position"] = position.tolist()
        meta["goal_radius"] = float(task.objective.goal_radius)
        if "vessel" in rows:
            moves, depth = rows["vessel_motion"][-1], rows.array("contact_depth")
            meta["vessel"] = vessel_meta(rows["vessel"], moves, depth)
            position = np.array(meta["vessel"]["goal"])
        head = rows.array("catheter")[:, -1]
        meta["distance"] = np.linalg.norm(head - position, axis=-1).tolist()
        return meta

    def _episode(self, rows: _EpisodeRows, seed: int | None, meta: dict) -> Episode:
        shapes = {"action": self._env.action_spec().shape}
        shapes |= dict.fromkeys(("contact_position", "contact_force"), (3,))
        names = set(Episode.__annotations__) - {"task", "seed", "meta", "insertion"}
        return Episode(
            task=self._task_name,
            seed=seed,
            meta=meta,
            insertion=rows.array("base_insertion"),
            **{name: rows.array(name, shapes.get(name, ())) for name in names},
        )


def _columns(rows: list[dict[str, float]]) -> dict[str, list[float]]:
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else ())}


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in _VERSIONED:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
