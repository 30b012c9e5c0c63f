"""Soft actor-critic: the customary settings with the published networks."""

from dataclasses import dataclass
from typing import ClassVar

from cathsim_dmc.agents.configs.base import TrainingConfig, require

# 2 GiB hold about 270,000 transitions of the internal observation.
REPLAY_BYTES = 2 * 1024**3


@dataclass(frozen=True, kw_only=True)
class SACConfig(TrainingConfig):
    """SAC with twin critics and a learned entropy weight.

    Attributes:
        batch_size: transitions per gradient step.
        tau: step of the target critics towards the critics.
        replay_frames: most transitions kept.
        replay_bytes: most bytes of the replay files; the smaller of the two rules.
        random_frames: uniformly random actions, and no learning, at the start.
        steps_per_env: control steps of each environment between two updates.
        updates_per_frame: gradient steps per frame collected.
        initial_alpha: entropy weight at the start.
        target_entropy: nats; None means minus the number of actions.
    """

    algorithm: ClassVar[str] = "sac"

    batch_size: int = 256
    tau: float = 0.005
    replay_frames: int = 600_000
    replay_bytes: int = REPLAY_BYTES
    random_frames: int = 5_000
    steps_per_env: int = 4
    updates_per_frame: float = 1.0
    initial_alpha: float = 1.0
    target_entropy: float | None = None

    def __post_init__(self):
        """Validate the algorithm's own fields after the shared ones."""
        super().__post_init__()
        for name in ("batch_size", "replay_frames", "replay_bytes", "steps_per_env"):
            value = getattr(self, name)
            require(
                isinstance(value, int) and value > 0, name, value, "a positive integer"
            )
        require(0 < self.tau <= 1, "tau", self.tau, "in (0, 1]")
        require(
            self.random_frames >= self.batch_size,
            "random_frames",
            self.random_frames,
            f"at least batch_size={self.batch_size}",
        )
        require(
            self.replay_frames >= max(self.batch_size, self.frames_per_batch),
            "replay_frames",
            self.replay_frames,
            f"at least batch_size={self.batch_size} and "
            f"num_envs * steps_per_env={self.frames_per_batch}",
        )
        for name in ("updates_per_frame", "initial_alpha"):
            value = getattr(self, name)
            require(value > 0, name, value, "positive")

    @property
    def frames_per_batch(self) -> int:
        """Frames between two updates, over all environments."""
        return self.num_envs * self.steps_per_env
