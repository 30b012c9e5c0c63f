"""Named settings, and the way back from JSON."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from cathsim_dmc.agents.configs.base import ConfigError, TrainingConfig
from cathsim_dmc.agents.configs.ppo import PPOConfig
from cathsim_dmc.agents.configs.sac import SACConfig

ALGORITHMS: dict[str, type[TrainingConfig]] = {"ppo": PPOConfig, "sac": SACConfig}

# "demo" buys wall time with larger minibatches and fewer passes: about a tenth of
# the published cost of learning per frame.
PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "ppo": {
        "published": {},
        "demo": {
            "num_envs": 32,
            "steps_per_update": 2_048,
            "minibatch_size": 256,
            "epochs": 10,
            "clip": 0.2,
            "target_kl": 0.05,
            "anneal": True,
        },
    },
    "sac": {
        "published": {},
        "demo": {"num_envs": 32, "updates_per_frame": 0.25},
    },
}


def _choice(table: Mapping[str, Any], name: str, what: str) -> Any:
    if name not in table:
        raise ConfigError(f"{what} {name!r} is unknown; choose one of {list(table)}.")
    return table[name]


def make_config(
    algorithm: str = "ppo", preset: str = "published", **overrides: Any
) -> TrainingConfig:
    """The config of an algorithm: a preset with some fields overridden.

    Raises:
        ConfigError: unknown algorithm, preset or field, or a value not allowed.
    """
    kind = _choice(ALGORITHMS, algorithm, "algorithm")
    settings = _choice(PRESETS[algorithm], preset, f"preset of {algorithm}")
    return config_from_dict({"algorithm": kind.algorithm, **settings, **overrides})


def config_from_dict(values: Mapping[str, Any]) -> TrainingConfig:
    """The inverse of TrainingConfig.to_dict.

    Raises:
        ConfigError: unknown algorithm or field, or a value not allowed.
    """
    values = dict(values)
    kind = _choice(ALGORITHMS, values.pop("algorithm", None), "algorithm")
    valid = [item.name for item in dataclasses.fields(kind)]
    unknown = sorted(set(values) - set(valid))
    if unknown:
        raise ConfigError(
            f"{kind.__name__} has no field {unknown}; valid fields are {valid}."
        )
    return kind(**values)
