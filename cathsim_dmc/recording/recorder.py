"""Recording of whole episodes of a composer environment."""

from __future__ import annotations

import functools
import itertools
import logging
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import numpy as np
from dm_control.rl import control

from cathsim_dmc.recording.coaxial import SERIES, device_meta
from cathsim_dmc.recording.episode import TERMINATIONS, Episode
from cathsim_dmc.simulation.episodes import ComposerSimulation, play

Policy = Callable[[Any], np.ndarray]

HEAD_SITE = "catheter/head"
INSERTION_JOINT = "catheter/insertion"
LINK_PREFIX = "catheter/link_"

_VERSIONED = ("cathsim-dmc", "mujoco", "dm-control", "numpy")


@dataclass(frozen=True)
class StepReadout:
    """What the task says about the control step that has just ended.

    Forces in newtons, world frame, on the wall by the device. Contacts, sum and
    largest force are those of the last physics step; the peaks are over all physics
    steps of the control step.
    """

    contact_position: np.ndarray
    contact_force: np.ndarray
    wall_force_sum: float
    wall_force_max: float
    wall_force_peak_sum: float
    wall_force_peak_max: float
    push_force: float
    reward_terms: dict[str, float]


def read_step(task: Any, physics: Any) -> StepReadout:
    """Ask a task for its forces; the one place that knows the task's attributes."""
    contacts, wall = task.contacts(physics), task.wall_force
    return StepReadout(
        contact_position=np.array(contacts.position[contacts.present]),
        contact_force=np.array(contacts.force[contacts.present]),
        wall_force_sum=float(wall.sum),
        wall_force_max=float(wall.max),
        wall_force_peak_sum=float(wall.peak_sum),
        wall_force_peak_max=float(wall.peak_max),
        push_force=float(task.readings.push_force),
        reward_terms=_reward_terms(task),
    )


def _reward_terms(task: Any) -> dict[str, float]:
    """Weighted terms of the last reward by name."""
    prefix = "reward_"
    return {
        name.removeprefix(prefix): value
        for name, value in task.info().items()
        if name.startswith(prefix)
    }


def read_termination(task: Any, timestep: Any) -> str | None:
    """Return why the episode ended, or None while it runs.

    A task never sees the end by diverged physics or by composer's time limit: the
    environment then ends the episode itself, with discount 0 and 1.
    """
    if not timestep.last() or task.termination not in (None, "truncated"):
        return task.termination
    return "truncated" if timestep.discount else "physics_error"


def read_goal(task: Any) -> tuple[np.ndarray, float] | None:
    """Return goal position (3,) and radius in metres, or None without a goal."""
    position = getattr(task, "goal_position", None)
    if position is None:
        return None
    radius = float(task.objective.goal_radius)
    return np.array(position, dtype=np.float64).reshape(3), radius


class _Rows:
    """Growing lists, one per array of an episode."""

    def __init__(self) -> None:
        self.columns: dict[str, list] = {}

    def add(self, **values: Any) -> None:
        for name, value in values.items():
            self.columns.setdefault(name, []).append(value)

    def get(self, name: str, row_shape: tuple[int, ...] = ()) -> np.ndarray:
        values = self.columns.get(name)
        return np.array(values) if values else np.zeros((0, *row_shape))


class EpisodeRecorder:
    """Runs a policy in an environment and keeps everything that happened.

    The environment stays usable afterwards; nothing is switched on or changed in it.
    Poses are those the simulator holds after a step: with ``legacy_step=False`` they
    belong to the start of the last physics step, as do the contacts, while ``qpos``
    and ``time`` belong to its end.

    Args:
        env: A ``composer.Environment`` whose model holds the catheter and whose task
            answers ``read_step`` and has a ``termination``.
        task_name: Registered name to write into episodes; the class name of the task
            otherwise.
        task_kwargs: Keyword arguments the environment was made with, for ``meta``.

    Raises:
        ValueError: if the model lacks the catheter's links, head or insertion joint.
    """

    def __init__(
        self,
        env: Any,
        task_name: str | None = None,
        task_kwargs: dict[str, Any] | None = None,
    ) -> None:
        self._env = env
        self._task_name = task_name or type(env.task).__name__
        self._task_kwargs = dict(task_kwargs or {})
        self._bind()

    def _bind(self) -> None:
        # A reset may compile a new model, so names are looked up once per episode.
        model = self._env.physics.model
        bodies = _names(model, "body", model.nbody)
        count = 0
        while f"{LINK_PREFIX}{count}" in bodies:
            count += 1
        # Asking for link 0 makes the error of a model without a catheter.
        self._links = [
            _find(bodies, f"{LINK_PREFIX}{i}", "body") for i in range(max(count, 1))
        ]
        self._head = _find(_names(model, "site", model.nsite), HEAD_SITE, "site")
        joint = _find(_names(model, "joint", model.njnt), INSERTION_JOINT, "joint")
        self._insertion = int(model.jnt_qposadr[joint])

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
        self._bind()
        rows = _Rows()
        rows.add(**self._state())
        steps, error, termination, discount = 0, None, None, 1.0
        try:
            for action, timestep, _ in itertools.islice(turns, max_steps):
                discount = float(timestep.discount)
                termination = read_termination(self._env.task, timestep)
                if termination == "physics_error":
                    error = "the environment ended the episode"
                    break
                state = self._state()
                readout = read_step(self._env.task, self._env.physics)
                count = len(readout.contact_force)
                rows.add(**state)
                rows.add(
                    action=action,
                    reward=float(timestep.reward),
                    wall_force_sum=readout.wall_force_sum,
                    wall_force_max=readout.wall_force_max,
                    wall_force_peak_sum=readout.wall_force_peak_sum,
                    wall_force_peak_max=readout.wall_force_peak_max,
                    push_force=readout.push_force,
                    reward_terms=readout.reward_terms,
                    contact_step=np.full(count, steps),
                    contact_position=readout.contact_position,
                    contact_force=readout.contact_force,
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
        self._bind()
        rows = _Rows()
        rows.add(**self._state())
        return self._episode(rows, None, self._meta(rows, "truncated", 1.0))

    def _state(self) -> dict[str, Any]:
        data = self._env.physics.data
        head = data.site_xpos[self._head]
        devices = getattr(self._env.task, "devices", None)
        coaxial = {} if devices is None else {n: getattr(devices, n) for n in SERIES}
        return {
            **coaxial,
            "time": float(data.time),
            "qpos": np.array(data.qpos),
            "catheter": np.vstack([data.xpos[self._links], head]),
            "body_pos": np.array(data.xpos),
            "body_quat": np.array(data.xquat),
            "base_insertion": float(data.qpos[self._insertion]),
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

    def _meta(self, rows: _Rows, termination: str, discount: float) -> dict[str, Any]:
        model = self._env.physics.model
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
            "catheter_radius": _link_radii(model, self._links),
            "wall_force_peak_sum": rows.get("wall_force_peak_sum").tolist(),
            "wall_force_peak_max": rows.get("wall_force_peak_max").tolist(),
            "reward_terms": _columns(rows.columns.get("reward_terms", [])),
        }
        if SERIES[0] in rows.columns:
            series = {name: rows.get(name) for name in SERIES}
            meta["devices"] = device_meta(self._env.task, series)
        goal = read_goal(self._env.task)
        if goal is not None:
            position, radius = goal
            head = rows.get("catheter")[:, -1]
            meta["goal_position"] = position.tolist()
            meta["goal_radius"] = radius
            meta["distance"] = np.linalg.norm(head - position, axis=-1).tolist()
        return meta

    def _episode(self, rows: _Rows, seed: int | None, meta: dict) -> Episode:
        state = ("time", "qpos", "catheter", "body_pos", "body_quat")
        step = ("reward", "wall_force_sum", "wall_force_max", "push_force")
        ragged = {"contact_position": (3,), "contact_force": (3,)}
        return Episode(
            task=self._task_name,
            seed=seed,
            meta=meta,
            insertion=rows.get("base_insertion"),
            action=rows.get("action", self._env.action_spec().shape),
            contact_step=np.concatenate(
                [np.zeros(0, np.int64), *rows.columns.get("contact_step", [])]
            ),
            **{name: rows.get(name) for name in (*state, *step)},
            **{
                name: np.concatenate(
                    [np.zeros((0, *shape)), *rows.columns.get(name, [])]
                )
                for name, shape in ragged.items()
            },
        )


def _columns(rows: list[dict[str, float]]) -> dict[str, list[float]]:
    """Rows of named numbers as a list for each name."""
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else ())}


def _names(model: Any, kind: str, count: int) -> dict[str, int]:
    return {model.id2name(i, kind): i for i in range(count)}


def _find(names: dict[str, int], name: str, kind: str) -> int:
    if name not in names:
        raise ValueError(
            f"the model has no {kind} {name!r}; it has {', '.join(sorted(names))}"
        )
    return names[name]


def _link_radii(model: Any, links: list[int]) -> list[float]:
    """Radius in metres of the first geom of every link."""
    return [float(model.geom_size[model.body_geomadr[i], 0]) for i in links]


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in _VERSIONED:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
