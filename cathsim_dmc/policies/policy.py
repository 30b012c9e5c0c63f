"""Base class of all policies, and their view of the simulations."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import dm_env
import numpy as np
from dm_control import composer

from cathsim_dmc.simulation.batch import BatchSimulation
from cathsim_dmc.tasks.rollout import Rollout


class View:
    """N simulations of one task: those of a batch, or a composer environment.

    Attributes:
        num_simulations: N.
        num_actions: Number A of entries of an action.
        task: The task that all of them run.
    """

    def __init__(self, simulations: BatchSimulation | composer.Environment):
        """Takes simulations, which need not have begun an episode."""
        batched = isinstance(simulations, BatchSimulation)
        self.task = simulations.task
        self.num_simulations = simulations.num_simulations if batched else 1
        self.num_actions: int = self.task.num_actions
        self._stepped = simulations if batched else self.task

    @property
    def rollout(self) -> Rollout:
        """Measurements of the simulations, arrays (N, ...), see `rollout.Rollout`."""
        return self._stepped.rollout


class Policy:
    """Chooses the actions of N simulations of one task.

    Attributes:
        name: Name for reports.
        task: Name of the task that it was made for; None for any.
        observation: Name or names of the observations that it reads; None if it reads
            none.
        task_kwargs: Further options of the task that it was made for.
        num_actions: Number of entries of its actions; None for any.
    """

    name: str = "policy"
    task: str | None = None
    observation: str | Sequence[str] | None = None
    task_kwargs: Mapping[str, Any] | None = None
    num_actions: int | None = None

    def __repr__(self) -> str:
        """Name, task and observation of the policy."""
        task, reads = self.task or "any task", self.observation or "nothing"
        return f"<{type(self).__name__} {self.name!r} for {task}, reads {reads}>"

    def reset(self, view: View, which: np.ndarray) -> None:
        """Begin new episodes; called after the simulations were reset.

        Args:
            view: The simulations; the same object until all begin a new episode.
            which: (N,) bool, the simulations that begin a new episode.
        """

    def require_observations(self, names: Sequence[str]) -> None:
        """Raise ValueError if a composer environment lacks what the policy reads.

        By default any observations will do; `observation` is that of evaluations.

        Args:
            names: Names of the observations of the environment.
        """

    def among(self, first: int, count: int) -> "Policy":
        """Returns the policy for a part of the episodes of an evaluation.

        Its actions equal those in the whole evaluation bit for bit, so that parts may
        be played separately. By default it is the policy itself, which holds if the
        action of a simulation does not depend on the others.

        Args:
            first: Number of the first of these episodes.
            count: Number of all episodes.
        """
        return self

    def act(self, observation: Any) -> np.ndarray:
        """Choose the actions of the next control step.

        Args:
            observation: Observations of the N simulations: in an evaluation a
                TensorDict with batch size [N], whose entries are joined in the order
                of their names (`VECTOR` and `PIXELS` of `simulation.environments`);
                from a composer environment arrays by name without the axis N.
                `simulation.environments.as_batch` makes a TensorDict of both.

        Returns:
            (N, A) actions in [-1, 1].
        """
        raise NotImplementedError(f"{type(self).__name__} lacks act(observation)")


def in_environment(
    policy: Policy, environment: composer.Environment
) -> Callable[[dm_env.TimeStep], np.ndarray]:
    """Returns a function from a composer environment's time step to an action (A,).

    The policy is reset where an episode begins, and after a restored snapshot.

    Raises:
        ValueError: see `Policy.require_observations`.
    """
    view, known = View(environment), None
    policy.require_observations(view.task.observation_names)

    def act(timestep: dm_env.TimeStep) -> np.ndarray:
        nonlocal known
        restored = getattr(environment, "restored", 0)  # of composer's own: none
        if timestep.first() or known != restored:
            policy.reset(view, np.ones(1, dtype=bool))
            known = restored
        # Rounded to single precision, as TorchRL environments do.
        action = np.asarray(policy.act(timestep.observation), dtype=np.float32)[0]
        return action.astype(np.float64)

    return act
