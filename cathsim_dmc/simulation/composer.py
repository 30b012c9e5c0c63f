"""Composer environments in TorchRL, with the keys of `BatchedEnv`."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite
from torchrl.envs import DMControlEnv, EnvBase, Transform, TransformedEnv

from cathsim_dmc import suite
from cathsim_dmc.simulation.torchrl import info_spec


class TaskInformation(Transform):
    """Adds "info" to a composer environment: the figures of its task after a step."""

    def __init__(self, environment: Any):
        """Keeps the composer environment underneath."""
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
        entries = {
            name: torch.tensor([value], dtype=_dtype(value))
            for name, value in self.environment.task.info().items()
        }
        return TensorDict(entries)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declares "info"."""
        types = self.environment.task.info_types
        observation_spec["info"] = info_spec(types, torch.Size([]))
        return observation_spec


def _dtype(value: bool | float) -> torch.dtype:
    return torch.bool if isinstance(value, bool) else torch.float32


def composer_env(task: str, task_kwargs: Mapping[str, Any], seed: int) -> EnvBase:
    """One seeded composer environment of a task, batch size []."""
    env = DMControlEnv(suite.DOMAIN, task, **task_kwargs)
    transformed = TransformedEnv(env, TaskInformation(env._env))
    # Not `set_seed`, which resets: the first episode is that of the seed.
    env._env.random_state.seed(seed)
    return transformed
