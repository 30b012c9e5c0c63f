"""Recording of whole episodes of a composer environment."""

import collections
import functools
import itertools
import logging
import platform
from collections.abc import Callable
from importlib import metadata
from typing import Any

import numpy as np
from dm_control.rl import control

from cathsim_dmc import __version__, bounds, json_options
from cathsim_dmc.anatomy.scan.aorta import is_upright
from cathsim_dmc.physics.forces import NAMES
from cathsim_dmc.recording.episode import Episode
from cathsim_dmc.recording.records import (
    DEVICE_SERIES,
    device_meta,
    vessel_state,
    x_ray_meta,
)
from cathsim_dmc.simulation.episodes import play_alone
from cathsim_dmc.tasks.snapshot import Snapshot

Policy = Callable[[Any], np.ndarray]
_TERM = "reward_"  # before the names of reward terms


def navigation_of(env: Any) -> Any:
    """Returns the task of an environment of this package; TypeError for any other."""
    task = getattr(env, "task", None)
    if not hasattr(task, "scene") or not hasattr(env, "physics"):
        raise TypeError(
            f"{type(env).__name__} is no environment of cathsim; give what "
            "cathsim_dmc.suite.load returns (a Gymnasium or TorchRL environment: the "
            "composer environment inside it)"
        )
    return task


def begun_task_of(env: Any) -> Any:
    """Returns the task of an environment; RuntimeError if no episode has begun."""
    task = navigation_of(env)
    if not task.rollout.begun:
        raise RuntimeError(
            "no episode has begun; call reset() of the environment first"
        )
    return task


class _Rows(collections.defaultdict[str, list]):
    """Growing lists, one per array of an episode."""

    def add(self, **values: Any) -> None:
        for name, value in values.items():
            self[name].append(value)


class EpisodeRecorder:
    """Runs a policy in a composer environment and records the episode.

    The recorder changes no setting of the environment, which stays usable afterwards.
    Poses are those the simulator holds after a step: with ``legacy_step=False`` they
    belong to the start of the last physics step, as do the contacts, while ``qpos``
    and ``time`` belong to its end.

    Args:
        env: What ``cathsim_dmc.suite.load`` returns; TypeError for any other.
        task_name: Registered name to write into episodes; the class name of the task
            otherwise.
        task_kwargs: Options of the task, for ``meta``; None for those that
            `suite.make_task` was given. Objects among these, such as an own device,
            are kept as texts, in ``meta["objects"]``: without them the task is another.
    """

    def __init__(
        self,
        env: Any,
        task_name: str | None = None,
        task_kwargs: dict[str, Any] | None = None,
    ) -> None:
        self._env, self._task = env, navigation_of(env)
        self._task_name = task_name or type(env.task).__name__
        plain, objects = json_options.split(self._task.options)
        self._objects = json_options.as_texts(objects)
        if task_kwargs is None:
            task_kwargs = plain
        self._task_kwargs = bounds.options("task_kwargs", task_kwargs)

    def record_episode(
        self,
        policy: Policy,
        seed: int | None = None,
        max_steps: int | None = None,
        start: Snapshot | None = None,
    ) -> Episode:
        """Reset the environment, run one episode and return the record.

        A step in which the physics diverges ends the episode and is left out of it.

        Args:
            policy: Called with every ``dm_env.TimeStep``, returns the action. It may
                raise ``StopIteration`` to end the episode as truncated.
            seed: Seeds the environment's random state before the reset; with None the
                random state continues, and the episode cannot be repeated.
            max_steps: Ends the episode as truncated; by default only the environment
                ends it.
            start: Snapshot of a running episode, from which the recording starts, in
                place of a reset; it has a random state of its own.

        Raises:
            ValueError: if the policy returns an action of a wrong shape or with values
                that are not finite, ``max_steps`` is not positive, or ``start`` does
                not fit or is given with a seed.
        """
        if start is not None and seed is not None:
            raise ValueError(
                f"seed is {bounds.shown(seed)}, but start has the random state of its "
                "episode; leave the seed out"
            )
        if max_steps is not None:
            bounds.whole("max_steps", max_steps, 1)
        if seed is not None:
            self._env.random_state.seed(bounds.seed("seed", seed))
        choose = functools.partial(self._action, policy)
        turns = play_alone(self._env, choose, start)
        next(turns)
        rows = _Rows(list)
        rows.add(**self._state())
        steps, end = 0, {"termination": None, "discount": 1.0}
        if start is not None:
            if self._task.termination is not None:
                raise ValueError(
                    f"the episode of start has ended ({self._task.termination}); give "
                    "a snapshot from before its end"
                )
            end |= {"started": True}
        try:
            for action, timestep in itertools.islice(turns, max_steps):
                termination = self._task.termination
                end |= {"termination": termination, "discount": timestep.discount}
                # The environment itself ends an episode at diverged physics, discount
                # 0, or composer's time limit, discount 1; the task knows of neither.
                alone = timestep.last() and termination in (None, "truncated")
                lost = alone and not timestep.discount
                if lost or termination == "physics_error":
                    raise control.PhysicsError("the environment ended the episode")
                self._add_step(rows, steps, action, float(timestep.reward))
                steps += 1
        except control.PhysicsError as error:
            end |= {"termination": "physics_error", "error": str(error)}
            logging.getLogger(__name__).warning(
                "physics diverged after %d steps: %s", steps, error
            )
        return self._episode(rows, seed, end)

    def present(self) -> Episode:
        """Returns the present state and contacts as an episode of one step."""
        rows = _Rows(list)
        rows.add(**self._state())
        self._add_step(rows, 0, np.zeros(self._env.action_spec().shape), 0.0)
        return self._episode(rows, None, {"termination": None, "discount": 1.0})

    def _action(self, policy: Policy, timestep: Any) -> np.ndarray:
        shape, answer = self._env.action_spec().shape, policy(timestep)
        if np.shape(answer) == (1, *shape):
            raise ValueError(
                f"the policy's action is of shape {np.shape(answer)}, for a batch of "
                f"one; it must be of shape {shape}, or give "
                "cathsim_dmc.agents.load_policy(policy) for a function of batches"
            )
        action = bounds.array("the policy's action", answer, "biuf", shape)
        return np.array(action, dtype=np.float64)

    def _state(self) -> dict[str, Any]:
        data, task = self._env.physics.data, self._task
        vessel = vessel_state(task)
        series = () if task.devices is None else DEVICE_SERIES
        return {
            **{name: getattr(task.devices, name) for name in series},
            "time": float(data.time),
            "qpos": np.array(data.qpos),
            "catheter": np.array(task.readings.centreline),
            "body_pos": np.array(data.xpos),
            "body_quat": np.array(data.xquat),
            "base_insertion": float(task.readings.insertion),
            "distance": task.info()["distance"],
            **({"vessel": vessel} if vessel else {}),
        }

    def _add_step(self, rows: _Rows, step: int, action: Any, reward: float) -> None:
        """Adds state, reward, forces and contacts at the end of a step."""
        task, terms = self._task, self._task.info().items()
        rows.add(**self._state(), action=action, reward=reward)
        rows.add(**{name: float(one) for name, one in task.wall_force.named().items()})
        rows.add(push_force=float(task.readings.push_force))
        rows.add(**{name: one for name, one in terms if name.startswith(_TERM)})
        contacts = task.contacts(self._env.physics)
        there = contacts.present
        rows["contact_position"] += list(contacts.position[there])
        rows["contact_force"] += list(contacts.force[there])
        rows["contact_step"] += [step] * int(there.sum())

    def _episode(self, rows: _Rows, seed: int | None, end: dict[str, Any]) -> Episode:
        meta = self._meta(rows, end)
        names = set(Episode.__annotations__) - {"task", "seed", "meta"}
        arrays = {name: np.array(rows[name]) for name in names}
        arrays["insertion"] = np.array(rows["base_insertion"])
        shapes = {"action": self._env.action_spec().shape}
        shapes |= {"contact_position": (3,), "contact_force": (3,)}
        for name, shape in shapes.items():
            arrays[name] = arrays[name].reshape((-1, *shape))  # also without rows
        return Episode(self._task_name, seed, meta, **arrays)

    def _meta(self, rows: _Rows, end: dict[str, Any]) -> dict[str, Any]:
        model, task = self._env.physics.model, self._task
        termination = end["termination"] or "truncated"
        meta = {
            "success": termination == "success",
            **end,
            "termination": termination,
            "task_kwargs": self._task_kwargs,
            **({"objects": self._objects} if self._objects else {}),
            "versions": {
                "python": platform.python_version(),
                "cathsim-dmc": __version__,
                **{n: metadata.version(n) for n in ("mujoco", "dm-control", "numpy")},
            },
            "control_timestep": float(self._env.control_timestep()),
            "action_names": self._env.action_spec().name.split("\t"),
            "body_names": [model.id2name(i, "body") for i in range(model.nbody)],
            "catheter_radius": [float(task.scene.catheter.device.outer_radius)]
            * len(task.scene.catheter.links),
            **{name: rows[name] for name in NAMES[2:]},
            "reward_terms": {
                name.removeprefix(_TERM): values
                for name, values in rows.items()
                if name.startswith(_TERM)
            },
            "goal_position": task.objective.goal.reshape(3).tolist(),
            "goal_radius": float(task.objective.goal_radius),
            "distance": rows["distance"],
            "anatomy": task.scene.anatomy.name,
            "lumen": task.scene.anatomy.digest,
            "conditions": task.conditions.as_dict(),
            "upright": is_upright(task.scene.anatomy),
            "x_ray": x_ray_meta(task),
        }
        if task.devices is not None:
            series = {name: np.array(rows[name]) for name in DEVICE_SERIES}
            meta["devices"] = device_meta(task.scene.catheter, series)
        if states := rows["vessel"]:
            moving = task.rollout.moving
            meta["vessel"] = {
                **{name: [state[name] for state in states] for name in states[0]},
                **(moving.record() if moving else {"lattice": [], "parameters": []}),
            }
        return meta
