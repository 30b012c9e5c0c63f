"""Where the frames of a training come from: TorchRL's collector."""

import math
from collections.abc import Callable

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import device
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.learner import Learner


def make_collector(
    config: TrainingConfig, learner: Learner, env: EnvBase, frames: int
) -> Collector:
    """A collector of batches (num_envs, steps) with the learner's policy as it is.

    Args:
        config: Settings of the run.
        env: Environment, which the collector closes.
        frames: Number of frames that earlier processes of the run have seen.
    """
    # Whole batches.
    left = max(learner.random_frames - frames, 0) / config.frames_per_batch
    return Collector(
        env,
        _on_cpu(learner.policy, learner.device),
        frames_per_batch=config.frames_per_batch,
        init_random_frames=math.ceil(left) * config.frames_per_batch or None,
        total_frames=-1,
        exploration_type=ExplorationType.RANDOM,
        trust_policy=True,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )


def _on_cpu(
    policy: TensorDictModuleBase, device: device
) -> Callable[[TensorDictBase], TensorDictBase]:
    """A policy that takes and gives CPU tensors wherever its weights are."""
    if device.type == "cpu":
        return policy

    def act(observation: TensorDictBase) -> TensorDictBase:
        outside = observation.select(*policy.in_keys).to(device)
        return observation.update(policy(outside).to("cpu"))

    return act
