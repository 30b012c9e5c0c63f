"""Algorithms by name; to add one, write two classes and add a line here."""

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch

from cathsim_dmc import files, suite
from cathsim_dmc.agents import loggers
from cathsim_dmc.agents.collection import check_collector
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.dagger import DAgger, DAggerConfig
from cathsim_dmc.agents.demonstrations import require_dataset
from cathsim_dmc.agents.imitation import BC, BCConfig
from cathsim_dmc.agents.learner import Learner
from cathsim_dmc.agents.ppo import PPO, PPOConfig
from cathsim_dmc.agents.sac import SAC, SACConfig


class Algorithm(NamedTuple):
    """Settings and learner of one algorithm."""

    config: type[TrainingConfig]
    learner: type[Learner]


LEARNERS: dict[str, Algorithm] = {
    "ppo": Algorithm(PPOConfig, PPO),
    "sac": Algorithm(SACConfig, SAC),
    "bc": Algorithm(BCConfig, BC),
    "dagger": Algorithm(DAggerConfig, DAgger),
}


def make_config(
    algorithm: str = "ppo", preset: str = "published", **overrides: Any
) -> TrainingConfig:
    """Return a preset of an algorithm with fields overridden; or ConfigError."""
    kind = _choice(LEARNERS, algorithm, "algorithm").config
    settings = _choice(kind.presets, preset, f"preset of {algorithm}")
    return kind.from_dict({**settings, **overrides})


def config_from_dict(values: Mapping[str, Any]) -> TrainingConfig:
    """Invert `TrainingConfig.to_dict`; ConfigError if a value is wrong."""
    # A field of older cards without effect.
    values = {name: one for name, one in values.items() if name != "tensorboard"}
    kind = _choice(LEARNERS, values.pop("algorithm", None), "algorithm").config
    return kind.from_dict(values)


def _choice(table: Mapping[str, Any], name: object, what: str) -> Any:
    if not isinstance(name, str) or name not in table:
        raise ConfigError(
            f"{what} {name!r} is unknown; choose one of {', '.join(table)}."
        )
    return table[name]


def check_usable(config: TrainingConfig) -> None:
    """Check that the settings can be used on this machine.

    Raises:
        ConfigError: device, compiler, logger or collectors cannot be used; says what
            can.
        ValueError: the task is unknown, as while its modules are not imported, or does
            not take an option that only the evaluation has.
        DatasetError: the demonstrations are missing.
    """
    if config.modules:
        suite.known(config.task, config.modules)
    text = f"torch_device={config.torch_device!r} cannot be used here, 'cpu' always can"
    with files.refused(ConfigError, text, (RuntimeError, AssertionError)):
        one = torch.zeros(1, device=config.torch_device)
    if getattr(config, "torch_compile", False):
        text = "torch_compile=True needs a C++ compiler for torch; leave it out"
        with files.refused(ConfigError, text, RuntimeError), warnings.catch_warnings():
            # Torch warns about its own imports.
            warnings.simplefilter("ignore", DeprecationWarning)
            torch.compile(torch.neg)(one)
    loggers.require(config.logger)
    shown = getattr(config, "demonstrations", None)
    if shown or config.algorithm == "bc":
        require_dataset(shown)
    check_collector(config, LEARNERS[config.algorithm].learner)
    definition, own = suite.TASKS.get(config.task), {**config.task_kwargs}
    if definition and any(
        config.training_kwargs[name] is not own[name] for name in own
    ):
        if definition.random_arch and "numbers" not in own:
            own["pool"] = 1  # one arch suffices, and more take longer
        suite.make_task(config.task, **own)
