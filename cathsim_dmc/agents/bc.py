"""Behaviour cloning from a dataset of demonstrations."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.envs import EnvBase

from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.demonstrations import load_transitions
from cathsim_dmc.agents.imitation import Clone, decaying, make_clone
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

    demonstrations: str = ""
    gradient_steps: int = 10_000
    batch_size: int = 256
    steps_per_env: int = 128
    total_frames: int = 20_480
    hidden: tuple[int, ...] = (128, 128)
    learning_rate: float = 1e-3
    normalisation_frames: int = 0
    training_max_steps: int | None = 300
    checkpoint_frames: int = 10_240

    def __post_init__(self):
        """Validate the algorithm's own fields after the shared ones."""
        super().__post_init__()
        self._require_positive("gradient_steps", "batch_size", "steps_per_env")

    @property
    def frames_per_batch(self) -> int:
        """Frames between two stretches of learning, over all environments."""
        return self.num_envs * self.steps_per_env


class BC:
    """The learner: a clone, fitted to a dataset.

    Attributes:
        shapes: Sizes of what the policy reads, and of the action.
        policy: Raw observation in, sampled action out.
        random_frames: Number of frames to collect with uniformly random actions
            first (none).
    """

    metrics: ClassVar[tuple[str, ...]] = ("loss", "deviation", "gradient_steps")
    random_frames = 0

    def __init__(self, config: BCConfig, shapes: NetworkShapes, directory: Path):
        """Make the clone and load the dataset.

        Raises:
            ConfigError: no dataset is given.
            DatasetError: it cannot be used, see `demonstrations.load_transitions`.
        """
        del directory  # It keeps nothing on disk.
        if not config.demonstrations:
            raise ConfigError(
                "demonstrations is not given: bc needs the directory of a dataset; "
                "`cathsim demos` writes one."
            )
        self.config, self.shapes = config, shapes
        self.device = torch.device(config.torch_device)
        self.states = load_transitions(
            config.demonstrations, config.observation, shapes
        ).exclude("next")
        self.clone = Clone(config, shapes)
        self.clone.observe(self.states)
        self.policy = self.clone.policy
        self.gradient_steps = 0

    @staticmethod
    def make_policy(shapes: NetworkShapes, config: BCConfig) -> TensorDictSequential:
        """A policy with fresh weights: raw observation in, action out."""
        return make_clone(shapes, config)

    def attach(self, env: EnvBase) -> None:
        """Look at the environment to collect from; not needed."""

    def observe(self, batch: TensorDictBase) -> None:
        """Take no statistics: they are those of the dataset."""

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Fit the next part of all gradient steps; the batch is only looked at.

        Args:
            batch: Steps as the collector gives them.
            progress: Share of the run that is done, in [0, 1].

        Returns:
            The figures in `metrics`.
        """
        config = self.config
        after = min(progress + batch.numel() / config.total_frames, 1.0)
        steps = math.ceil(config.gradient_steps * after) - self.gradient_steps
        rates = decaying(1.0 - progress, 1.0 - after, steps) * config.learning_rate
        figures = self.clone.fit(self._sample, config.batch_size, rates)
        self.gradient_steps += steps
        return {**figures, "gradient_steps": float(self.gradient_steps)}

    def _sample(self, count: int) -> TensorDictBase:
        return self.states[torch.randint(len(self.states), (count,))]

    def policy_state(self) -> dict[str, Any]:
        """Weights and statistics that acting needs."""
        return self.policy.state_dict()

    def learning_state(self) -> dict[str, Any]:
        """What learning needs beyond the policy and the dataset."""
        return {"clone": self.clone.learning_state(), "steps": self.gradient_steps}

    def load(self, policy: dict[str, Any], learning: dict[str, Any]) -> None:
        """Restore what policy_state and learning_state gave."""
        self.clone.load(policy, learning["clone"])
        self.gradient_steps = learning["steps"]
