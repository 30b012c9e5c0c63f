"""Behaviour cloning from a dataset of demonstrations."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from typing_extensions import override

from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.demonstrations import load_transitions
from cathsim_dmc.agents.fields import positive
from cathsim_dmc.agents.imitation import CloningLearner, decaying
from cathsim_dmc.agents.networks import NetworkShapes


@dataclass(frozen=True, kw_only=True)
class BCConfig(TrainingConfig):
    """Behaviour cloning.

    Nothing is learnt from the frames of the run: the clone plays between the stretches
    of learning, so that metrics.csv shows what it reaches.

    Attributes:
        demonstrations: Directory of the dataset, as `cathsim demos` writes it, with
            the observation of the run among its observations.
        gradient_steps: Number of gradient steps in all, spread over total_frames.
        batch_size: Number of states per gradient step.
        steps_per_env: Number of control steps of each environment between two
            stretches of learning.
    """

    algorithm: ClassVar[str] = "bc"
    resumable: ClassVar[frozenset[str]] = TrainingConfig.resumable - {"total_frames"}

    demonstrations: str | None = None
    gradient_steps: int = positive(10_000)
    batch_size: int = positive(256)
    steps_per_env: int = positive(128)
    total_frames: int = 20_480
    hidden: tuple[int, ...] = (128, 128)
    learning_rate: float = 1e-3
    normalisation_frames: int = 0
    training_max_steps: int | None = 300
    checkpoint_frames: int = 10_240


class BC(CloningLearner):
    """Fits a policy to a dataset."""

    metrics: ClassVar[tuple[str, ...]] = ("loss", "deviation", "gradient_steps")

    def __init__(self, config: BCConfig, shapes: NetworkShapes, directory: Path):
        """Makes the policy; ConfigError or DatasetError if there is no dataset."""
        if not config.demonstrations:
            raise ConfigError(
                "demonstrations is not given: bc needs the directory of a dataset; "
                "`cathsim demos` writes one."
            )
        self.states = load_transitions(
            config.demonstrations, config.observation, shapes
        ).exclude("next")
        super().__init__(config, shapes, directory)
        self.observe(self.states)

    @override
    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        # The next part of all gradient steps; the batch is only looked at.
        config = self.config
        after = min(progress + batch.numel() / config.total_frames, 1.0)
        steps = math.ceil(config.gradient_steps * after) - self.gradient_steps
        rates = decaying(1.0 - progress, 1.0 - after, steps) * config.learning_rate
        figures = self.fit(self._sample, config.batch_size, rates)
        return {**figures, "gradient_steps": float(self.gradient_steps)}

    def _sample(self, count: int) -> TensorDictBase:
        return self.states[torch.randint(len(self.states), (count,))]
