"""The composer environments as TorchRL environments with the batched path's keys."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import DMControlEnv, EnvBase, Transform, TransformedEnv

# As in simulation.torchrl, which the agents read under the same names.
NUMBERS = (
    "distance",
    "insertion",
    "push_force",
    "wall_force_sum",
    "wall_force_max",
    "wall_force_peak",
    "path_ratio",
)
FLAGS = ("success", "physics_error")


class TaskInformation(Transform):
    """Adds "info" to a composer environment: what its task measured in a step.

    Args:
        environment: the composer environment underneath.
    """

    def __init__(self, environment: Any):
        super().__init__()
        self.__dict__["environment"] = environment

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        next_tensordict["info"] = self._read(bool(next_tensordict["done"]))
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        tensordict_reset["info"] = self._read(done=False)
        return tensordict_reset

    def _read(self, done: bool) -> TensorDict:
        task = self.environment.task
        state, wall = task.readings, task.wall_force
        values = {
            "distance": task.meaning.outcome(state.head).distance,
            "insertion": state.insertion,
            "push_force": state.push_force,
            "wall_force_sum": wall.sum,
            "wall_force_max": wall.max,
            "wall_force_peak": wall.peak_max,
            "path_ratio": task.path_ratio,
        }
        entries = {
            name: torch.tensor([float(values[name])], dtype=torch.float32)
            for name in NUMBERS
        }
        entries["success"] = torch.tensor([task.termination == "success"])
        # The task ends an episode by success or time; composer by divergence.
        entries["physics_error"] = torch.tensor([done and task.termination is None])
        return TensorDict(entries)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declare "info"."""
        info = {name: Unbounded((1,), dtype=torch.float32) for name in NUMBERS}
        info |= {name: Binary(1, (1,), dtype=torch.bool) for name in FLAGS}
        observation_spec["info"] = Composite(info)
        return observation_spec


def composer_env(task: str, task_kwargs: Mapping[str, Any], seed: int) -> EnvBase:
    """One seeded composer environment of a task, batch size []."""
    from cathsim_dmc import suite

    env = DMControlEnv(suite.DOMAIN, task, **task_kwargs)
    env.set_seed(seed)
    return TransformedEnv(env, TaskInformation(env._env))
