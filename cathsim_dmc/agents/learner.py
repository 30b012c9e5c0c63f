"""Interface of a learning algorithm."""

import abc
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase

from cathsim_dmc.agents.networks import NetworkShapes, make_normalisers, make_policy


class Learner(abc.ABC):
    """An algorithm with its networks.

    Attributes:
        metrics: Names of the figures that `update` returns, columns of metrics.csv.
        remote: Whether the policy needs nothing but observations, so that it can act in
            another process.
        imitates: Whether an update fits the whole policy to its targets. Otherwise a
            policy that starts from another one keeps that one's observation statistics,
            the only ones that fit its weights.
        random_frames: Number of frames to collect with uniformly random actions first.
        device: Torch device of the networks.
        shapes: Sizes of the policy's observation and of the action.
        network: The policy that is learnt: raw observation in, sampled action out.
        policy: The policy to collect with; `network`, or one around it.
        critic_normalisers: Normalisers of the observations that only the critic reads.
        optimiser: Adam with the parameters of all networks, made by the subclass.
        replay: `ReplayMemory` of the algorithm, if any; made by the subclass.
        gradient_steps: Number of gradient steps so far.
    """

    metrics: ClassVar[tuple[str, ...]]
    remote: ClassVar[bool] = True
    imitates: ClassVar[bool] = False
    random_frames: int = 0
    optimiser: torch.optim.Optimizer
    replay: Any = None

    def __init__(
        self,
        config: Any,
        shapes: NetworkShapes,
        directory: Path,
        critic_shapes: NetworkShapes | None = None,
    ):
        """Makes the policy with fresh weights, drawn from torch's generator.

        Args:
            shapes: Sizes of the policy's observation and of the action.
            directory: Directory of the run, for files of the algorithm.
            critic_shapes: Sizes of the critic's observation; None for the policy's.
        """
        self.config, self.shapes = config, shapes
        self.device = torch.device(config.torch_device)
        self.network = make_policy(shapes, config).to(self.device)
        self.policy: TensorDictModuleBase = self.network
        own = [] if critic_shapes is None else make_normalisers(critic_shapes, config)
        self.critic_normalisers = nn.ModuleList(own).to(self.device)
        self._policy_normalisers: list[Any] = list(self.network.module)[:-1]
        self.gradient_steps = 0

    def attach(self, env: EnvBase) -> None:  # noqa: B027
        """Adapt `policy` to the environment; called once, before the first batch."""

    def observe(self, batch: TensorDictBase) -> None:
        """Update the observation statistics with a batch, without learning from it."""
        chosen: list[Any] = list(self.critic_normalisers)
        if self.imitates or self.config.initial_policy is None:
            chosen += self._policy_normalisers
        for module in chosen:
            module.module.update(batch[module.in_keys[0]].to(self.device))

    @property
    def lacks_statistics(self) -> bool:
        """Whether a new run has no observation statistics before its first update."""
        taken = self.config.initial_policy is not None and not self.critic_normalisers
        return not taken and not self.random_frames

    def normalise(self, batch: TensorDictBase, critic_only: bool = False) -> None:
        """Add the normalised observations of policy and critic, or of the critic."""
        chosen: list[Any] = list(self.critic_normalisers)
        if not critic_only or not chosen:
            chosen = [*self._policy_normalisers, *chosen]
        for module in chosen:
            module(batch)

    def compiled(self, loss: nn.Module) -> Callable[[TensorDictBase], TensorDictBase]:
        """Return a loss, compiled by torch if the settings say so."""
        if not self.config.torch_compile:
            return loss
        # Samples of the entropy are then those of the loss that is not compiled.
        return torch.compile(loss, options={"fallback_random": True})

    def anneal(self, progress: float) -> None:
        """Decrease the learning rate to (1 - progress) of it if the settings say so."""
        if not self.config.anneal:
            return
        for group in self.optimiser.param_groups:
            group["lr"] = self.config.learning_rate * (1.0 - progress)

    def descend(self, loss: torch.Tensor, max_norm: float = math.inf) -> torch.Tensor:
        """Take a gradient step; return the norm before clipping, 0 without a limit."""
        self.optimiser.zero_grad()
        loss.backward()
        norm = torch.zeros(())
        if max_norm < math.inf:
            (group,) = self.optimiser.param_groups
            norm = nn.utils.clip_grad_norm_(group["params"], max_norm)
        self.optimiser.step()
        self.gradient_steps += 1
        return norm

    @abc.abstractmethod
    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a batch (num_envs, steps) collected with the current policy.

        Args:
            batch: Steps as the collector gives them.
            progress: Share of the run that is done, in [0, 1].

        Returns:
            Figures by the names in `metrics`, means over the gradient steps; figures
            that are not known yet are left out.
        """

    def policy_state(self) -> dict[str, Any]:
        """Return the weights and observation statistics of the policy."""
        return self.network.state_dict()

    def learning_state(self) -> dict[str, Any]:
        """Return the state of learning beside the policy: tensors, numbers, strings."""
        return {
            "optimiser": self.optimiser.state_dict(),
            "gradient_steps": self.gradient_steps,
            "normalisers": self.critic_normalisers.state_dict(),
            **({"replay": self.replay.state()} if self.replay is not None else {}),
        }

    def load(self, policy: dict[str, Any], learning: dict[str, Any]) -> None:
        """Restore the results of `policy_state` and `learning_state`."""
        self.network.load_state_dict(policy)
        self.optimiser.load_state_dict(learning["optimiser"])
        self.gradient_steps = learning["gradient_steps"]
        self.critic_normalisers.load_state_dict(learning["normalisers"])
        if self.replay is not None and "replay" in learning:
            self.replay.load(learning["replay"])


def means(steps: Sequence[Mapping[str, torch.Tensor]]) -> dict[str, float]:
    """Return the means of the figures of gradient steps; empty without a step."""
    names = steps[0] if steps else ()
    return {n: float(torch.stack([one[n] for one in steps]).mean()) for n in names}
