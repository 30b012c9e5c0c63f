"""Base class of all policies."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import dm_env
import numpy as np
from dm_control import composer

from cathsim_dmc.policies.view import View


class Policy:
    """Chooses the actions of N simulations of one task.

    Attributes:
        name: Name for reports.
        task: Name of the task that it was made for; None for any.
        observation: Name or names of the observations that it reads; None if it reads
            none.
        task_kwargs: Further options of the task that it was made for.
    """

    name: str = "policy"
    task: str | None = None
    observation: str | Sequence[str] | None = None
    task_kwargs: Mapping[str, Any] | None = None

    def reset(self, view: View, which: np.ndarray) -> None:
        """Begin new episodes; called after the simulations were reset.

        Args:
            view: The simulations; the same one until all of them begin anew.
            which: (N,) bool, the simulations that begin a new episode.
        """

    def act(self, observation: Any) -> np.ndarray:
        """Choose the actions of the next control step.

        Args:
            observation: Observations of the N simulations: a TensorDict with batch
                size [N] from a TorchRL environment, arrays by name without the axis N
                from a composer environment.

        Returns:
            (N, A) actions in [-1, 1].
        """
        raise NotImplementedError


def in_environment(
    policy: Policy, environment: composer.Environment
) -> Callable[[dm_env.TimeStep], np.ndarray]:
    """A policy as a function from a composer environment's timestep to its action."""
    view = View(environment)

    def act(timestep: dm_env.TimeStep) -> np.ndarray:
        if timestep.first():
            policy.reset(view, np.ones(1, dtype=bool))
        return np.asarray(policy.act(timestep.observation), dtype=np.float64)[0]

    return act
