"""A scripted expert that steers along the centreline to the goal.

It proves the tasks solvable and is a yardstick for trained agents. What it decides is
in `pursuit`; here it meets a composer environment or many simulations at once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import dm_env
import numpy as np
import torch
from dm_control import composer

from cathsim_dmc.agents import evaluation
from cathsim_dmc.agents.pursuit import Plan, Settings, State, decide
from cathsim_dmc.simulation import environments
from cathsim_dmc.tasks import forces, navigation
from cathsim_dmc.tasks.readings import Readings


class Expert:
    """The expert at work on one task; remembers where each simulation stands."""

    def __init__(self, plan: Plan, settings: Settings | None = None):
        """Starts without any memory; see `for_task`."""
        self._plan = plan
        self._settings = settings or Settings()
        self._state: State | None = None

    @classmethod
    def for_task(
        cls, task: navigation.Navigation, settings: Settings | None = None
    ) -> Expert:
        """The expert for a task.

        Raises:
          ValueError: if the task's device cannot be steered.
        """
        return cls(Plan.for_task(task), settings)

    @property
    def plan(self) -> Plan:
        """What is known of the task."""
        return self._plan

    @property
    def state(self) -> State | None:
        """What is remembered; None before the first action."""
        return self._state

    def reset(self, which: np.ndarray | None = None) -> None:
        """Forgets the simulations that begin a new episode.

        Args:
          which: mask or indices of them, None for all.
        """
        if which is None or self._state is None:
            self._state = None
            return
        shape = self._state.insertion.shape
        fresh = State.fresh(shape, len(self._plan.tip))
        for field in dataclasses.fields(State):
            getattr(self._state, field.name)[which] = getattr(fresh, field.name)[which]

    def act(self, readings: Readings, wall_force: forces.WallForce) -> np.ndarray:
        """Action (..., A) in [-1, 1] for the state of the devices.

        Raises:
          ValueError: if the leading axes changed since the last call without reset.
        """
        shape = readings.head.shape[:-1]
        if self._state is None:
            self._state = State.fresh(shape, len(self._plan.tip))
        if self._state.insertion.shape != shape:
            raise ValueError(
                f"the readings have leading axes {shape}, those before had "
                f"{self._state.insertion.shape}; call reset() in between"
            )
        action, self._state = decide(
            self._plan, self._settings, self._state, readings, wall_force
        )
        return action


def policy(
    env: composer.Environment, settings: Settings | None = None
) -> Callable[[dm_env.TimeStep], np.ndarray]:
    """The expert as a function from a composer environment's timestep to an action.

    It looks at the environment's task, not at the observation.
    """
    task = env.task
    expert = Expert.for_task(task, settings)

    def act(timestep: dm_env.TimeStep) -> np.ndarray:
        if timestep.first():
            expert.reset()
        state, wall_force = task.readings, task.wall_force
        if state is None:
            # Without observations the task measures nothing before the first step.
            state = task.rollout.index.read(env.physics.data.ptr)
            wall_force = forces.wall_force(np.zeros((1, 1)))
        return expert.act(state, wall_force)

    return act


def expert_episodes(
    task: str,
    episodes: int = 30,
    seed: int = 1_000_000,
    *,
    task_kwargs: Mapping[str, Any] | None = None,
    settings: Settings | None = None,
    num_threads: int | None = None,
    out_dir: str | Path | None = None,
    observer: evaluation.Observer | None = None,
) -> evaluation.EvaluationResult:
    """Evaluates the expert as `evaluation.evaluate` does a trained policy.

    Args:
      task: name of a registered task.
      episodes: how many, side by side.
      seed: of the first; they count up.
      task_kwargs: options of the task.
      settings: how to drive.
      num_threads: of the simulation, None for every core.
      out_dir: write evaluation.json there.
      observer: as in `evaluation.evaluate`.
    """
    crew = {}

    def make_env(name, **options):
        env = environments.make_env(name, **options)
        crew["simulation"] = simulation = env.base_env.simulation
        crew["expert"] = Expert.for_task(simulation.task, settings)
        return env

    def act(observation):
        simulation, expert = crew["simulation"], crew["expert"]
        if expert.state is not None:
            expert.reset(observation["step_count"].reshape(-1).numpy() == 0)
        action = expert.act(simulation.readings, simulation.wall_force)
        return torch.as_tensor(action)

    return evaluation.evaluate(
        act,
        task,
        episodes,
        seed,
        name="expert",
        observation="tracking",
        task_kwargs=task_kwargs,
        num_threads=num_threads,
        out_dir=out_dir,
        observer=observer,
        make_env=make_env,
    )
