"""The algorithms by name: a new one is a module of its own and a line here."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.envs import EnvBase

from cathsim_dmc.agents.bc import BC, BCConfig
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.dagger import DAgger, DAggerConfig
from cathsim_dmc.agents.networks import NetworkShapes
from cathsim_dmc.agents.ppo import PPO, PPOConfig
from cathsim_dmc.agents.sac import SAC, SACConfig

Settings = TypeVar("Settings", bound=TrainingConfig, contravariant=True)
Config = TypeVar("Config", bound=TrainingConfig)


class Learner(Protocol[Settings]):
    """What training asks of an algorithm.

    Attributes:
        metrics: Names of the figures that `update` returns, columns of metrics.csv.
        random_frames: Number of frames to collect with uniformly random actions
            first; the observation statistics then come from those.
        device: Torch device of the networks.
        shapes: Sizes of what the policy reads, and of the action.
        policy: Raw observation in, sampled action out.
    """

    metrics: ClassVar[tuple[str, ...]]
    random_frames: int
    device: torch.device
    shapes: NetworkShapes
    policy: TensorDictModuleBase

    def __init__(self, config: Settings, shapes: NetworkShapes, directory: Path):
        """Make networks with fresh weights, drawn from torch's generator.

        Args:
            config: Settings of the algorithm.
            shapes: Sizes of the observation that is collected, and of the action.
            directory: Directory of the run, for what the algorithm keeps on disk.
        """

    @staticmethod
    def make_policy(shapes: NetworkShapes, config: Settings) -> TensorDictSequential:
        """A policy with fresh weights: raw observation in, action out."""
        ...

    def attach(self, env: EnvBase) -> None:
        """Look at the environment that `policy` is to collect from, once, first."""

    def observe(self, batch: TensorDictBase) -> None:
        """Take observation statistics from a batch without learning from it."""

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a batch (num_envs, steps) collected with the current policy.

        Args:
            batch: Steps as the collector gives them.
            progress: Share of the run that is done, in [0, 1].

        Returns:
            Figures by the names in `metrics`; what is not known yet is left out.
        """
        ...

    def policy_state(self) -> dict[str, Any]:
        """Weights and statistics that acting needs."""
        ...

    def learning_state(self) -> dict[str, Any]:
        """What learning needs beyond the policy: tensors, numbers, strings."""
        ...

    def load(self, policy: dict[str, Any], learning: dict[str, Any]) -> None:
        """Restore what policy_state and learning_state gave."""


@dataclass(frozen=True)
class Algorithm(Generic[Config]):
    """Settings and learner of one algorithm.

    Attributes:
        config: Class of its settings.
        learner: Class of its learner.
        remote: Whether its policy needs nothing but observations, so that it can act
            in another process.
    """

    config: type[Config]
    learner: type[Learner[Config]]
    remote: bool = True


LEARNERS: dict[str, Algorithm[Any]] = {
    "ppo": Algorithm(PPOConfig, PPO),
    "sac": Algorithm(SACConfig, SAC),
    "bc": Algorithm(BCConfig, BC),
    "dagger": Algorithm(DAggerConfig, DAgger, remote=False),
}


def make_config(
    algorithm: str = "ppo", preset: str = "published", **overrides: Any
) -> TrainingConfig:
    """The config of an algorithm: a preset with some fields overridden.

    Args:
        algorithm: Name of an algorithm in `LEARNERS`.
        preset: Name of a preset of it.
        **overrides: Fields of the algorithm's config.

    Raises:
        ConfigError: unknown algorithm, preset or field, or a value not allowed.
    """
    kind = _choice(LEARNERS, algorithm, "algorithm").config
    settings = _choice(kind.presets, preset, f"preset of {algorithm}")
    return kind.from_dict({**settings, **overrides})


def config_from_dict(values: Mapping[str, Any]) -> TrainingConfig:
    """The inverse of TrainingConfig.to_dict.

    Raises:
        ConfigError: unknown algorithm or field, or a value not allowed.
    """
    values = dict(values)
    kind = _choice(LEARNERS, values.pop("algorithm", None), "algorithm").config
    return kind.from_dict(values)


def make_learner(
    config: TrainingConfig, shapes: NetworkShapes, directory: Path
) -> Learner:
    """The learner of a config's algorithm, with fresh weights."""
    return LEARNERS[config.algorithm].learner(config, shapes, directory)


def make_policy(shapes: NetworkShapes, config: TrainingConfig) -> TensorDictSequential:
    """The policy of a config's algorithm, with fresh weights."""
    return LEARNERS[config.algorithm].learner.make_policy(shapes, config)


def _choice(table: Mapping[str, Any], name: object, what: str) -> Any:
    if not isinstance(name, str) or name not in table:
        raise ConfigError(f"{what} {name!r} is unknown; choose one of {list(table)}.")
    return table[name]
