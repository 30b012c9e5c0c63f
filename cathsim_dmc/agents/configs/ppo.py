"""Proximal policy optimisation: the published settings are the defaults."""

from dataclasses import dataclass
from typing import ClassVar

from cathsim_dmc.agents.configs.base import ConfigError, TrainingConfig, require


@dataclass(frozen=True, kw_only=True)
class PPOConfig(TrainingConfig):
    """PPO with the settings of the published agents.

    `steps_per_update` counts frames over all environments together. That keeps the
    published ratio of learning to experience (320 minibatch steps per 512 frames)
    for any number of environments; with the default 16 of them an update sees 32
    consecutive steps of each, beyond the horizon of the advantage estimate
    (1 / (1 - gamma * gae_lambda) = 17 steps).

    Attributes:
        steps_per_update: frames per update, over all environments.
        minibatch_size: frames per gradient step.
        epochs: passes over the batch per update.
        gae_lambda: of the generalised advantage estimate.
        clip: of the probability ratio.
        entropy_coefficient: weight of the entropy bonus.
        value_coefficient: weight of the squared value error.
        max_grad_norm: joint gradient norm of both networks.
        target_kl: stop an update's epochs when the approximate KL divergence from
            the collecting policy exceeds this; None never stops.
        anneal: decrease the learning rate linearly to zero over total_frames.
    """

    algorithm: ClassVar[str] = "ppo"

    steps_per_update: int = 512
    minibatch_size: int = 32
    epochs: int = 20
    gae_lambda: float = 0.95
    clip: float = 0.1
    entropy_coefficient: float = 5.85e-4
    value_coefficient: float = 0.872
    max_grad_norm: float = 1.0
    target_kl: float | None = None
    anneal: bool = False

    def __post_init__(self):
        """Validate the algorithm's own fields after the shared ones."""
        super().__post_init__()
        for name in ("steps_per_update", "minibatch_size", "epochs"):
            value = getattr(self, name)
            require(
                isinstance(value, int) and value > 0, name, value, "a positive integer"
            )
        if self.steps_per_update % self.num_envs:
            raise ConfigError(
                f"steps_per_update={self.steps_per_update} is not a multiple of "
                f"num_envs={self.num_envs}: choose num_envs that divides it, or set "
                f"steps_per_update to a multiple."
            )
        if self.steps_per_update % self.minibatch_size:
            raise ConfigError(
                f"steps_per_update={self.steps_per_update} is not a multiple of "
                f"minibatch_size={self.minibatch_size}: a smaller last minibatch "
                f"would weigh its frames more than the others."
            )
        require(self.minibatch_size > 1, "minibatch_size", self.minibatch_size, "> 1")
        require(0 <= self.gae_lambda <= 1, "gae_lambda", self.gae_lambda, "in [0, 1]")
        require(0 < self.clip < 1, "clip", self.clip, "in (0, 1)")
        for name in ("entropy_coefficient", "value_coefficient"):
            value = getattr(self, name)
            require(value >= 0, name, value, ">= 0")
        require(self.max_grad_norm > 0, "max_grad_norm", self.max_grad_norm, "> 0")
        kl = self.target_kl
        require(kl is None or kl > 0, "target_kl", kl, "positive, or None")

    @property
    def frames_per_batch(self) -> int:
        """Frames per update, over all environments."""
        return self.steps_per_update

    def changed_for_resume(self, other: TrainingConfig) -> dict[str, tuple]:
        """As in the base class; an annealed run may not change its length."""
        changed = super().changed_for_resume(other)
        if self.anneal and self.total_frames != other.total_frames:
            changed["total_frames"] = (self.total_frames, other.total_frames)
        return changed
