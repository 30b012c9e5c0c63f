"""Starts a learner from the policy of another run."""

import torch
from torch import nn

from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.imitation import network_of, statistics_of
from cathsim_dmc.agents.networks import LOG_STD_RANGE, NetworkShapes
from cathsim_dmc.agents.policies import TrainedPolicy, load_policy
from cathsim_dmc.tasks import observations

# What must agree for the weights to mean the same.
_ALIKE = ("hidden", "activation", "subtract_background",
          "convolutions", "cnn_features", "observation_clip")  # fmt: skip


def take_over(policy: nn.Module, config: TrainingConfig, shapes: NetworkShapes) -> None:
    """Give a policy the weights and observation statistics of `initial_policy`.

    A deviation that depends on the state (SAC) starts as one that does not (PPO,
    cloning), and the other way round as its value in the middle of all states.

    Raises:
        ConfigError: the other policy has another network, sizes or observation.
        CheckpointError: there is none, or it is damaged.
    """
    source = load_policy(str(config.initial_policy))
    if not isinstance(source, TrainedPolicy):
        raise ConfigError(
            f"initial_policy={config.initial_policy!r} has no network: give the "
            'directory of a run or of a checkpoint, or "pretrained:NAME".'
        )
    differing = [
        f"{name}: it has {getattr(source.config, name)!r}, given is "
        f"{getattr(config, name)!r}"
        for name in _ALIKE
        if getattr(source.config, name) != getattr(config, name)
    ]
    if _entries(source.config.observation) != _entries(config.observation):
        differing.append(
            f"observation: it has {source.config.observation!r}, given is "
            f"{config.observation!r}"
        )
    if source.shapes != shapes:
        differing.append(f"sizes: it has {source.shapes}, the task has {shapes}")
    if differing:
        raise ConfigError(
            f"initial_policy={config.initial_policy!r} does not fit "
            f"({'; '.join(differing)}); give the same settings, or another policy."
        )
    given = source.network
    theirs, ours = network_of(given), network_of(policy)
    ours.body.load_state_dict(theirs.body.state_dict())
    ours.mean.load_state_dict(theirs.mean.state_dict())
    with torch.no_grad():
        _set_deviation(ours.log_std, theirs.log_std, config.initial_std)
    for own, statistics in zip(
        statistics_of(policy), statistics_of(given), strict=True
    ):
        own.load_state_dict(statistics.state_dict())


def _entries(names: str | tuple[str, ...]) -> list[str]:
    """Entries of an observation without the word of where they are from.

    "route" and "biplane" have the same: one measures what the other reconstructs.
    """
    rows = observations.entries(observations.resolve(names))
    return sorted(entry.key.partition("_")[2] or entry.key for entry in rows)


def _set_deviation(
    ours: nn.Linear | nn.Parameter,
    theirs: nn.Linear | nn.Parameter,
    value: float | None,
) -> None:
    """Copy what a deviation depends on, or give it one value."""
    if isinstance(ours, nn.Linear) and isinstance(theirs, nn.Linear) and value is None:
        ours.load_state_dict(theirs.state_dict())
        return
    middle = theirs.bias if isinstance(theirs, nn.Linear) else theirs
    if value is not None:
        middle = torch.full_like(middle, value).log()
    if isinstance(ours, nn.Linear):
        ours.weight.zero_()
    target = ours.bias if isinstance(ours, nn.Linear) else ours
    target.data.copy_(middle.clamp(*LOG_STD_RANGE))
