"""Agents: TorchRL environments, PPO and SAC, training, evaluation, checkpoints."""

# torchrl before anything that loads dm_control: with MUJOCO_GL=egl or osmesa the
# other order crashes inside triton. (The variable itself is the user's to set.)
import torchrl  # noqa: F401, I001

from cathsim_dmc.agents.checkpoint import Checkpoint, CheckpointError
from cathsim_dmc.agents.configs import (
    ConfigError,
    PPOConfig,
    SACConfig,
    TrainingConfig,
    make_config,
)
from cathsim_dmc.agents.environments import make_env
from cathsim_dmc.agents.evaluation import (
    Comparison,
    EvaluationResult,
    compare,
    evaluate,
    random_policy,
)
from cathsim_dmc.agents.training import TrainingResult, train

__all__ = [
    "Checkpoint",
    "CheckpointError",
    "Comparison",
    "ConfigError",
    "EvaluationResult",
    "PPOConfig",
    "SACConfig",
    "TrainingConfig",
    "TrainingResult",
    "compare",
    "evaluate",
    "make_config",
    "make_env",
    "random_policy",
    "train",
]
