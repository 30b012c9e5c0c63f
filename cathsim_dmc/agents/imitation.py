"""Imitation learning: regression of a policy on an expert's actions."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import nn
from typing_extensions import override

from cathsim_dmc.agents.config import TrainingConfig, positive, within
from cathsim_dmc.agents.demonstrations import (
    EXPERT_ACTION,
    alike,
    load_transitions,
    require_dataset,
)
from cathsim_dmc.agents.learner import Learner, means
from cathsim_dmc.agents.networks import NetworkShapes, bounded, network_of

# Magnitude beyond which an action is saturated: its value before the tanh is unknown.
_SATURATED = 0.99
# Number of states from which the deviation of the policy is estimated.
_SAMPLE = 4_096


@dataclass(frozen=True, kw_only=True)
class CloningConfig(TrainingConfig):
    """Settings of the algorithms that imitate an expert.

    Attributes:
        batch_size: Number of states per gradient step.
        weight_decay: Each gradient step multiplies weights and biases by 1 - learning
            rate · weight_decay, as AdamW does ("Decoupled Weight Decay Regularization",
            Loshchilov and Hutter, 2019).
    """

    batch_size: int = positive(256)
    weight_decay: float = within(0.0, low=0, high=100)
    hidden: tuple[int, ...] = (128, 128)
    learning_rate: float = 1e-3
    normalisation_frames: int = 0
    training_max_steps: int | None = 300


class CloningLearner(Learner):
    """Fits PPO's policy to the expert's actions by least squares.

    The standard deviation of the policy, with which it explores and from which PPO may
    start, is that of the expert's actions around the policy's.
    """

    imitates: ClassVar[bool] = True

    def __init__(self, config: CloningConfig, shapes: NetworkShapes, directory: Path):
        super().__init__(config, shapes, directory)
        self._actor = network_of(self.network)
        assert isinstance(self._actor.log_std, nn.Parameter)
        self._log_std = self._actor.log_std
        self.optimiser = torch.optim.AdamW(
            [*self._actor.body.parameters(), *self._actor.mean.parameters()],
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,
        )

    def fit(
        self, sample: Callable[[int], TensorDictBase], rates: torch.Tensor
    ) -> dict[str, float]:
        """Take gradient steps on the squared error of the action.

        Args:
            sample: Function that draws a number of states with "expert_action".
            rates: (steps,), learning rate of each step.

        Returns:
            "loss", mean over the steps, if there are any, and "deviation", root mean
            square error of the action at the end.
        """
        losses = []
        for rate in rates.tolist():
            for group in self.optimiser.param_groups:
                group["lr"] = rate
            mean, target = self._means(sample(self.config.batch_size))
            loss = ((mean.tanh() - target).square() * self._weights(target)).mean()
            self.descend(loss)
            losses.append({"loss": loss.detach()})
        return {**means(losses), "deviation": self._set_deviation(sample(_SAMPLE))}

    def _weights(self, target: torch.Tensor) -> torch.Tensor:
        """Weights (n, 1) of the squared errors of the actions `target` (n, A)."""
        return torch.ones_like(target[:, :1])

    def _means(self, states: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the means before the tanh and the target actions, each (n, A)."""
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
        self._log_std.data.copy_(bounded(log_std))
        return float((mean.tanh() - target).square().mean().sqrt())


def decaying(start: float, stop: float, steps: int) -> torch.Tensor:
    """Return learning rates (steps,), linear from `start` to `stop`, without `stop`."""
    return torch.linspace(start, stop, steps + 1)[:-1]


@dataclass(frozen=True, kw_only=True)
class BCConfig(CloningConfig):
    """Behaviour cloning.

    The frames of the run are not learnt from: the policy plays between blocks of
    gradient steps so that metrics.csv shows its performance.

    Attributes:
        demonstrations: Directory of the dataset, as `cathsim demos` writes it, with the
            observation of the run among its observations; or of episodes of a human
            operator, as `cathsim play --out` writes them.
        gradient_steps: Number of gradient steps in all, spread over total_frames.
        steps_per_env: Number of control steps of each environment between two blocks of
            gradient steps.
    """

    algorithm: ClassVar[str] = "bc"

    demonstrations: str | None = None
    gradient_steps: int = positive(10_000)
    steps_per_env: int = positive(128)
    total_frames: int = 20_480
    checkpoint_frames: int = 10_240

    @property
    def resumable(self) -> frozenset[str]:
        """All but the number of frames, over which the gradient steps are spread."""
        return super().resumable - {"total_frames"}


class BC(CloningLearner):
    """Fits a policy to a dataset."""

    metrics: ClassVar[tuple[str, ...]] = ("loss", "deviation", "gradient_steps")

    def __init__(self, config: BCConfig, shapes: NetworkShapes, directory: Path):
        """Makes the policy; DatasetError if the dataset cannot be used."""
        self.states = load_transitions(
            require_dataset(config.demonstrations),
            config.observation,
            shapes,
            **alike(config.task, config.task_kwargs),
        ).exclude("next")
        super().__init__(config, shapes, directory)
        self.observe(self.states)

    @override
    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        # The next part of all gradient steps; the batch only counts frames.
        config = self.config
        after = min(progress + batch.numel() / config.total_frames, 1.0)
        steps = math.ceil(config.gradient_steps * after) - self.gradient_steps
        rates = decaying(1.0 - progress, 1.0 - after, steps) * config.learning_rate
        figures = self.fit(self._sample, rates)
        return {**figures, "gradient_steps": float(self.gradient_steps)}

    def _sample(self, count: int) -> TensorDictBase:
        return self.states[torch.randint(len(self.states), (count,))]
