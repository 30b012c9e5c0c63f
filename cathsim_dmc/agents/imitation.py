"""Regression of a policy on actions that are known to be good."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import nn

from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.demonstrations import EXPERT_ACTION
from cathsim_dmc.agents.networks import (
    LOG_STD_RANGE,
    GaussianActor,
    NetworkShapes,
    Normalisers,
    make_actor,
    make_policy,
)
from cathsim_dmc.agents.normalisation import ImageNormaliser, ObservationNormaliser

# Beyond it an action counts as saturated: its deviation before the tanh says nothing.
_SATURATED = 0.99
# Number of states from which the deviation of the policy is estimated.
_SAMPLE = 4_096


def make_clone(shapes: NetworkShapes, config: TrainingConfig) -> TensorDictSequential:
    """PPO's policy with fresh weights, so that PPO can go on from it."""
    network = GaussianActor(shapes, config, state_dependent_std=False)
    return make_policy(shapes, config, make_actor(shapes, network))


class Clone:
    """A policy that is fitted to the expert's actions by least squares.

    Its deviation, with which it explores while it collects, and from which PPO may
    start, is that of the expert's actions around its own.

    Attributes:
        policy: Raw observation in, sampled action out.
    """

    def __init__(self, config: TrainingConfig, shapes: NetworkShapes):
        """Make the policy with fresh weights, drawn from torch's generator."""
        self.device = torch.device(config.torch_device)
        self.policy = make_clone(shapes, config).to(self.device)
        self._keys, self._raw_keys = shapes.keys, shapes.raw_keys
        self._normalisers = Normalisers(self.policy, None, config)
        self._network = network_of(self.policy)
        assert isinstance(self._network.log_std, nn.Parameter)
        self._log_std = self._network.log_std
        self._parameters = [
            *self._network.body.parameters(),
            *self._network.mean.parameters(),
        ]
        self._optimiser = torch.optim.Adam(
            self._parameters, lr=config.learning_rate, fused=True
        )

    def observe(self, states: TensorDictBase) -> None:
        """Take observation statistics from raw observations."""
        self._normalisers.observe(states)

    def fit(
        self,
        sample: Callable[[int], TensorDictBase],
        batch_size: int,
        rates: torch.Tensor,
    ) -> dict[str, float]:
        """Take gradient steps on the squared error of the action.

        Args:
            sample: Function that draws so many states with "expert_action".
            batch_size: Number of states of a gradient step.
            rates: (steps,), learning rate of each step.

        Returns:
            "loss", the mean over the steps, and "deviation", root mean square error of
            an entry of the action at the end.
        """
        total = torch.zeros((), device=self.device)
        for rate in rates.tolist():
            for group in self._optimiser.param_groups:
                group["lr"] = rate
            mean, target = self._means(sample(batch_size))
            loss = (mean.tanh() - target).square().mean()
            self._optimiser.zero_grad()
            loss.backward()
            self._optimiser.step()
            total += loss.detach()
        return {
            "loss": float(total) / max(len(rates), 1),
            "deviation": self._set_deviation(sample(_SAMPLE)),
        }

    def _means(self, states: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
        """Means before the tanh and the actions that are wanted."""
        states = states.select(*self._raw_keys, EXPERT_ACTION).to(self.device)
        self._normalisers.add(states)
        mean, _ = self._network(*(states[key] for key in self._keys))
        return mean, states[EXPERT_ACTION]

    @torch.no_grad()
    def _set_deviation(self, states: TensorDictBase) -> float:
        mean, target = self._means(states)
        free = target.abs() < _SATURATED
        error = torch.where(free, target.clamp(-_SATURATED, _SATURATED).atanh(), mean)
        squares = (error - mean).square().sum(0) / free.sum(0).clamp_min(1)
        log_std = squares.clamp_min(1e-12).log() / 2
        self._log_std.data.copy_(log_std.clamp(*LOG_STD_RANGE))
        return float((mean.tanh() - target).square().mean().sqrt())

    def learning_state(self) -> dict[str, Any]:
        """What fitting needs beyond the policy."""
        return {"optimiser": self._optimiser.state_dict()}

    def load(self, policy: dict[str, Any], learning: dict[str, Any]) -> None:
        """Restore the policy's state and what learning_state gave."""
        self.policy.load_state_dict(policy)
        self._optimiser.load_state_dict(learning["optimiser"])


def network_of(policy: nn.Module) -> GaussianActor:
    """The network of a policy."""
    return next(m for m in policy.modules() if isinstance(m, GaussianActor))


def statistics_of(policy: nn.Module) -> list[nn.Module]:
    """The observation statistics of a policy."""
    kinds = ObservationNormaliser, ImageNormaliser
    return [module for module in policy.modules() if isinstance(module, kinds)]


def decaying(start: float, stop: float, steps: int) -> torch.Tensor:
    """Learning rates (steps,) that fall linearly, without the last value."""
    return torch.linspace(start, stop, steps + 1)[:-1]
