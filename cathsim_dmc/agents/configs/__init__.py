"""Hyper-parameters: one frozen dataclass per algorithm, and named presets."""

from cathsim_dmc.agents.configs.base import ConfigError, TrainingConfig
from cathsim_dmc.agents.configs.ppo import PPOConfig
from cathsim_dmc.agents.configs.presets import (
    ALGORITHMS,
    PRESETS,
    config_from_dict,
    make_config,
)
from cathsim_dmc.agents.configs.sac import SACConfig

__all__ = [
    "ALGORITHMS",
    "PRESETS",
    "ConfigError",
    "PPOConfig",
    "SACConfig",
    "TrainingConfig",
    "config_from_dict",
    "make_config",
]
