"""Regression of a policy on actions that are known to be good."""

from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import nn

from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.demonstrations import EXPERT_ACTION
from cathsim_dmc.agents.learner import Learner, means
from cathsim_dmc.agents.networks import LOG_STD_RANGE, NetworkShapes, network_of

# Beyond it an action counts as saturated: its deviation before the tanh says nothing.
_SATURATED = 0.99
# Number of states from which the deviation of the policy is estimated.
_SAMPLE = 4_096


class CloningLearner(Learner):
    """Fits PPO's policy to the expert's actions by least squares.

    Its deviation, with which it explores while it collects, and from which PPO may
    start, is that of the expert's actions around its own.
    """

    def __init__(self, config: TrainingConfig, shapes: NetworkShapes, directory: Path):
        super().__init__(config, shapes, directory)
        self._actor = network_of(self.network)
        assert isinstance(self._actor.log_std, nn.Parameter)
        self._log_std = self._actor.log_std
        self.optimiser = torch.optim.Adam(
            [*self._actor.body.parameters(), *self._actor.mean.parameters()],
            lr=config.learning_rate,
            fused=True,
        )

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
            "loss", the mean, and "deviation", root mean square error at the end.
        """
        losses = []
        for rate in rates.tolist():
            for group in self.optimiser.param_groups:
                group["lr"] = rate
            mean, target = self._means(sample(batch_size))
            loss = ((mean.tanh() - target).square() * self._weights(target)).mean()
            self.descend(loss)
            losses.append({"loss": loss.detach()})
        figures = {"loss": 0.0, **means(losses)}
        return {**figures, "deviation": self._set_deviation(sample(_SAMPLE))}

    def _weights(self, target: torch.Tensor) -> torch.Tensor:
        """Weights (n, 1) of the squared errors of the actions `target` (n, A)."""
        return torch.ones_like(target[:, :1])

    def _means(self, states: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
        """Means before the tanh and the actions that are wanted."""
        states = states.select(*self.shapes.raw_keys, EXPERT_ACTION).to(self.device)
        self.normalise(states)
        mean, _ = self._actor(*(states[key] for key in self.shapes.keys))
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


def decaying(start: float, stop: float, steps: int) -> torch.Tensor:
    """Learning rates (steps,) that fall linearly, without the last value."""
    return torch.linspace(start, stop, steps + 1)[:-1]
