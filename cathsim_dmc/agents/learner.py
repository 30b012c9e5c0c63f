"""Interface of a learning algorithm."""

import abc
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import device
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.networks import NetworkShapes, Normalisers


class Learner(abc.ABC):
    """An algorithm with its networks.

    metrics: Names of the figures that `update` returns, columns of metrics.csv.
    random_frames: Number of frames to collect with uniformly random actions first.
    device: Torch device of the networks.
    shapes: Sizes of what the policy reads, and of the action.
    network: The policy that is learnt: raw observation in, sampled action out.
    policy: The policy to collect with; `network`, or one around it.
    normalisers: Observation statistics of policy and critic.
    optimiser: Adam with the parameters of all networks, made by the subclass.
    gradient_steps: Number of gradient steps so far.
    """

    metrics: ClassVar[tuple[str, ...]]
    random_frames: int = 0
    optimiser: torch.optim.Optimizer

    def __init__(
        self,
        config: Any,
        shapes: NetworkShapes,
        directory: Path,
        critic_shapes: NetworkShapes | None = None,
    ):
        """Makes the policy with fresh weights, drawn from torch's generator.

        Args:
            shapes: Sizes of what the policy reads, and of the action.
            directory: Directory of the run, for what the algorithm keeps on disk.
            critic_shapes: Sizes of what the critic reads; None for the policy's.
        """
        del directory
        self.config, self.shapes = config, shapes
        self.device = torch.device(config.torch_device)
        self.network = self.make_policy(shapes, config).to(self.device)
        self.policy: TensorDictModuleBase = self.network
        self.normalisers = Normalisers(self.network, critic_shapes, config)
        self.gradient_steps = 0

    @staticmethod
    @abc.abstractmethod
    def make_policy(shapes: NetworkShapes, config: Any) -> TensorDictSequential:
        """A policy with fresh weights: raw observation in, action out."""

    def attach(self, env: EnvBase) -> None:  # noqa: B027
        """Adapt `policy` to the environment; called once, before the first batch."""

    def observe(self, batch: TensorDictBase) -> None:
        """Take observation statistics from a batch without learning from it."""
        self.normalisers.observe(batch)

    @abc.abstractmethod
    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a batch (num_envs, steps) collected with the current policy.

        Args:
            batch: Steps as the collector gives them.
            progress: Share of the run that is done, in [0, 1].

        Returns:
            Figures by the names in `metrics`, means over the gradient steps; what is
            not known yet is left out.
        """

    def policy_state(self) -> dict[str, Any]:
        """Weights and statistics that acting needs."""
        return self.network.state_dict()

    def learning_state(self) -> dict[str, Any]:
        """State of learning beside the policy: tensors, numbers, strings."""
        return {
            "optimiser": self.optimiser.state_dict(),
            "gradient_steps": self.gradient_steps,
            "normalisers": self.normalisers.critics.state_dict(),
        }

    def load(self, policy: dict[str, Any], learning: dict[str, Any]) -> None:
        """Restore what policy_state and learning_state gave."""
        self.network.load_state_dict(policy)
        self.optimiser.load_state_dict(learning["optimiser"])
        self.gradient_steps = learning["gradient_steps"]
        # A checkpoint may have no critic with an observation of its own.
        self.normalisers.critics.load_state_dict(learning.get("normalisers", {}))


def make_collector(
    config: TrainingConfig, learner: Learner, env: EnvBase, frames: int
) -> Collector:
    """A collector of batches (num_envs, steps) with the learner's policy as it is.

    Args:
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
    if device.type == "cpu":
        return policy

    def act(observation: TensorDictBase) -> TensorDictBase:
        outside = observation.select(*policy.in_keys).to(device)
        return observation.update(policy(outside).to("cpu"))

    return act
