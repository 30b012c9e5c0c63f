"""Settings of the algorithms with a critic, and what their tuned presets share."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cathsim_dmc.agents.config import TrainingConfig, require

# What the presets "tuned" learn from, found on type1_lcca (docs/training.md): the way
# through the lumen as reward, episodes that are short and start anywhere along it.
TUNED_TRAINING: Mapping[str, Any] = {
    "training_reward": {"path": -1.0, "success": 10.0},
    "training_max_steps": 120,
    "training_start": (0.0, 0.9),
}
# What the presets "tuned_image" add: images without their background, whose first
# convolution strides by its size (a fifth of the published cost), and a critic that
# reads the state.
TUNED_IMAGES: Mapping[str, Any] = {
    "observation": "image",
    "critic_observation": "internal",
    "subtract_background": True,
    "convolutions": ((32, 8, 8), (64, 4, 2), (64, 3, 1)),
    "cnn_features": 256,
}


@dataclass(frozen=True, kw_only=True)
class ActorCriticConfig(TrainingConfig):
    """Settings shared by the algorithms with a critic.

    Attributes:
        critic_observation: Name or names of the vector observations that the critic
            reads in place of the images that the policy reads (Pinto et al. 2018,
            "Asymmetric Actor Critic for Image-Based Robot Learning"); only the
            training needs them. None lets it read what the policy reads.
    """

    critic_observation: str | tuple[str, ...] | None = None

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(
            self.critic_observation is None or bool(self.critic_observation),
            "critic_observation",
            self.critic_observation,
            "a name, names, or None",
        )

    @property
    def collected_observation(self) -> str | tuple[str, ...]:
        """Those of the policy and those of the critic."""
        if self.critic_observation is None:
            return self.observation
        return (*_names(self.observation), *_names(self.critic_observation))


def _names(names: str | tuple[str, ...]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else names
