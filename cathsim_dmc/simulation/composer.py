"""The composer environments as TorchRL environments with the batched path's keys."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import DMControlEnv, EnvBase, Transform, TransformedEnv

from cathsim_dmc.tasks import info as info
from cathsim_dmc.tasks import info as task_info


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
        next_tensordict["info"] = self._read()
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        tensordict_reset["info"] = self._read()
        return tensordict_reset

    def _read(self) -> TensorDict:
        task = self.environment.task
        state = task.readings
        numbers = task_info.measures(
            state,
            task.wall_force,
            task.meaning.outcome(state.head).distance,
            task.path_ratio,
        )
        entries = {
            name: torch.tensor([float(value)], dtype=torch.float32)
            for name, value in numbers.items()
        }
        entries["success"] = torch.tensor([task.termination == "success"])
        entries["physics_error"] = torch.tensor([task.termination == "physics_error"])
        return TensorDict(entries)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declare "info"."""
        info = {
            name: Unbounded((1,), dtype=torch.float32) for name in task_info.MEASURES
        }
        info |= {name: Binary(1, (1,), dtype=torch.bool) for name in task_info.FLAGS}
        observation_spec["info"] = Composite(info)
        return observation_spec


def composer_env(task: str, task_kwargs: Mapping[str, Any], seed: int) -> EnvBase:
    """One seeded composer environment of a task, batch size []."""
    from cathsim_dmc import suite

    env = DMControlEnv(suite.DOMAIN, task, **task_kwargs)
    env.set_seed(seed)
    return TransformedEnv(env, TaskInformation(env._env))
