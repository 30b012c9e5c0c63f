"""Starts a learner from the policy of another run."""

import torch
from torch import nn

from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.networks import LOG_STD_RANGE, NetworkShapes
from cathsim_dmc.agents.policies import TrainedPolicy, load_policy
from cathsim_dmc.tasks import observations

# What must agree for the weights to mean the same.
_ALIKE = ("hidden", "activation", "subtract_background",
          "convolutions", "cnn_features", "observation_clip")  # fmt: skip


def take_over(
    network: nn.Module, config: TrainingConfig, shapes: NetworkShapes
) -> None:
    """Give a policy the weights and observation statistics of `initial_policy`.

    A deviation that depends on the state (SAC) starts as one that does not (PPO,
    cloning), and the other way round as its value in the middle of all states.

    Raises:
        ConfigError: the other policy has another network, sizes or observation.
        CheckpointError: there is none, or it is damaged.
    """
    name = f"initial_policy={config.initial_policy!r}"
    source = load_policy(str(config.initial_policy))
    if not isinstance(source, TrainedPolicy):
        raise ConfigError(
            f"{name} has no network: give the directory of a run or of a checkpoint, "
            'or "pretrained:NAME".'
        )
    pairs = {n: (getattr(source.config, n), getattr(config, n)) for n in _ALIKE}
    pairs["sizes"] = source.shapes, shapes
    seen = source.config.observation, config.observation
    if _entries(seen[0]) != _entries(seen[1]):
        pairs["observation"] = seen
    differing = [
        f"{what}: it has {theirs!r}, given is {ours!r}"
        for what, (theirs, ours) in pairs.items()
        if theirs != ours
    ]
    if differing:
        raise ConfigError(
            f"{name} does not fit ({'; '.join(differing)}); give the same settings, or "
            "another policy."
        )
    given, state = source.network.state_dict(), network.state_dict()
    (middle,) = (v for n, v in given.items() if n.endswith(("log_std", "log_std.bias")))
    if config.initial_std is not None:
        middle = torch.full_like(middle, config.initial_std).log()
    alike = given.keys() == state.keys() and config.initial_std is None
    for key, value in state.items():
        if alike or "log_std" not in key:
            state[key] = given[key]
        elif value.ndim == 1:
            state[key] = middle.clamp(*LOG_STD_RANGE)
        else:
            state[key] = torch.zeros_like(value)  # alike in all states
    network.load_state_dict(state)


def _entries(names: str | tuple[str, ...]) -> list[str]:
    """Entries of an observation without the word of where they are from.

    "route" and "biplane" have the same: one measures what the other reconstructs.
    """
    rows = observations.entries(observations.resolve(names))
    return sorted(entry.key.partition("_")[2] or entry.key for entry in rows)
