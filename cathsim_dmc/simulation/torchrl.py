"""The batched simulation as a TorchRL environment."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from cathsim_dmc import suite
from cathsim_dmc.simulation import batch
from cathsim_dmc.tasks import info as info
from cathsim_dmc.tasks import info as task_info


class BatchedEnv(EnvBase):
    """N simulations of a task of the suite; batch size [N], CPU.

    Keys: the task's observations (float32, images uint8), "action" (N, A), "reward",
    "terminated" (success or physics error), "truncated", and under "info" the
    `tasks.measures.MEASURES` (float32) and `FLAGS` (bool), all (N, 1).
    """

    def __init__(
        self,
        task_name: str,
        num_envs: int = 16,
        *,
        num_threads: int | None = None,
        seed: int = 0,
        observation: str = "internal",
        task_kwargs: Mapping[str, Any] | None = None,
    ):
        """Builds the simulations.

        Args:
          task_name: a task of `suite.SUITE`.
          num_envs: N.
          num_threads: of the simulation, None for one per core.
          seed: of the first simulation; the others count up from it.
          observation: name or names of observations.
          task_kwargs: further options of the task.
        """
        environment = suite.load(
            suite.DOMAIN,
            task_name,
            task_kwargs={**(task_kwargs or {}), "observation": observation},
        )
        self._simulation = batch.BatchSimulation(
            environment.task,
            num_envs,
            num_threads=num_threads or 0,
            seeds=seed,
        )
        super().__init__(device="cpu", batch_size=[num_envs])
        self._make_specs(self._simulation.reset())

    def _make_specs(self, observation: Mapping[str, np.ndarray]) -> None:
        shape = self.batch_size
        entries = {
            key: Bounded(0, 255, value.shape, dtype=torch.uint8)
            if value.dtype == np.uint8
            else Unbounded(value.shape, dtype=torch.float32)
            for key, value in observation.items()
        }
        info = {
            key: Unbounded((*shape, 1), dtype=torch.float32)
            for key in task_info.MEASURES
        }
        for key in task_info.FLAGS:
            info[key] = Binary(1, (*shape, 1), dtype=torch.bool)
        entries["info"] = Composite(info, shape=shape)
        self.observation_spec = Composite(entries, shape=shape)
        self.action_spec = Bounded(
            -1.0, 1.0, (*shape, self._simulation.num_actions), dtype=torch.float32
        )
        self.reward_spec = Unbounded((*shape, 1), dtype=torch.float32)
        flag = Binary(1, (*shape, 1), dtype=torch.bool)
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape
        )

    def _reset(self, tensordict: TensorDict | None = None, **kwargs) -> TensorDict:
        chosen = None
        if tensordict is not None and "_reset" in tensordict.keys():
            mask = tensordict["_reset"].reshape(self.batch_size).numpy()
            chosen = np.flatnonzero(mask)
        observation = self._simulation.reset(chosen)
        simulation = self._simulation
        outcome = simulation.meaning.outcome(simulation.readings.head)
        no = np.zeros(self.batch_size, dtype=bool)
        info = self._info(simulation.readings, simulation.wall_force, outcome, no)
        return self._tensors(observation, info)

    def _step(self, tensordict: TensorDict) -> TensorDict:
        step = self._simulation.step(tensordict["action"].numpy())
        info = self._info(
            step.readings, step.wall_force, step.outcome, step.physics_error
        )
        result = self._tensors(step.observation, info)
        result["reward"] = _column(step.outcome.reward, torch.float32)
        result["terminated"] = _column(step.terminated, torch.bool)
        result["truncated"] = _column(step.truncated, torch.bool)
        result["done"] = result["terminated"] | result["truncated"]
        return result

    def _info(self, state, wall, outcome, physics_error) -> dict[str, torch.Tensor]:
        numbers = task_info.measures(
            state, wall, outcome.distance, self._simulation.path_ratio
        )
        info = {key: _column(value, torch.float32) for key, value in numbers.items()}
        info["success"] = _column(outcome.success, torch.bool)
        info["physics_error"] = _column(physics_error, torch.bool)
        return info

    def _tensors(self, observation, info) -> TensorDict:
        entries = {
            key: torch.as_tensor(value)
            if value.dtype == np.uint8
            else torch.as_tensor(value).to(torch.float32)
            for key, value in observation.items()
        }
        entries["info"] = TensorDict(info, batch_size=self.batch_size)
        return TensorDict(entries, batch_size=self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self._simulation.seed(0 if seed is None else seed)

    @property
    def simulation(self) -> batch.BatchSimulation:
        """The simulations underneath."""
        return self._simulation


def _column(values: np.ndarray, dtype: torch.dtype) -> torch.Tensor:
    return torch.as_tensor(values).to(dtype)[:, None]
