"""Sources of training batches: a collector in this process, or on a cluster."""

import math
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from cathsim_dmc import extras, files
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.learner import Learner


class BatchSource(Protocol):
    """Source of batches (num_envs, steps) of the learner's present policy."""

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yield batches without end."""
        ...

    def shutdown(self) -> Any:
        """Close the environments."""


def check_collector(config: TrainingConfig, learner: type[Learner]) -> None:
    """Check that collectors on a cluster support the settings.

    Raises:
        ConfigError: they cannot; the message says what to change.
    """
    if config.collector == "local":
        return
    if not learner.remote:
        raise ConfigError(
            f"collector={config.collector!r} cannot collect for {config.algorithm}, "
            "whose expert reads the simulations of this process: choose "
            "collector='local'."
        )
    if config.num_envs % config.collectors:
        raise ConfigError(
            f"num_envs={config.num_envs} is not a multiple of "
            f"collectors={config.collectors}: each collector has the same number."
        )
    with files.refused(ConfigError, f"collector={config.collector!r}", ImportError):
        extras.require("ray", "ray")


def make_collector(
    config: TrainingConfig,
    learner: Learner,
    env: EnvBase,
    make_env: Callable[..., EnvBase],
    frames: int,
) -> BatchSource:
    """Return a source of batches (num_envs, steps) of the learner's present policy.

    Args:
        env: Environment, which the source closes.
        make_env: Function that made it, for further ones on a cluster.
        frames: Number of frames that earlier processes of the run have collected.
    """

    def random_frames(frames: int) -> int:  # whole batches
        left = max(learner.random_frames - frames, 0) / config.frames_per_batch
        return math.ceil(left) * config.frames_per_batch

    options = {
        "exploration_type": ExplorationType.RANDOM,
        "trust_policy": True,
        "track_traj_ids": False,
        "auto_register_policy_transforms": False,
    }
    if config.collector == "ray":
        # Imported late: Ray is an extra, and slow to import.
        from cathsim_dmc.agents.ray_source import RaySource

        env.close()
        return RaySource(config, learner, make_env, frames, random_frames, options)
    return Collector(
        env,
        _on_cpu(learner.policy, learner.device),
        frames_per_batch=config.frames_per_batch,
        init_random_frames=random_frames(frames) or None,
        total_frames=-1,
        **options,
    )


def _on_cpu(
    policy: TensorDictModuleBase, device: torch.device
) -> Callable[[TensorDictBase], TensorDictBase]:
    if device.type == "cpu":
        return policy

    def act(observation: TensorDictBase) -> TensorDictBase:
        outside = observation.select(*policy.in_keys).to(device)
        return observation.update(policy(outside).to("cpu"))

    return act
