"""The published networks, for vector observations, images, or both."""

import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator

from cathsim_dmc import files
from cathsim_dmc.agents.config import (
    ActorCriticConfig,
    ConfigError,
    TrainingConfig,
    checked,
)
from cathsim_dmc.agents.normalisation import ImageNormaliser, ObservationNormaliser
from cathsim_dmc.simulation.environments import PIXELS, VECTOR
from cathsim_dmc.tasks import observations

# Keys of the normalised VECTOR and PIXELS, which the networks read.
NORMAL = "observation_normal"
NORMAL_PIXELS = "pixels_normal"

# A deviation below exp(-5) before the tanh explores nothing; above exp(2) all
# actions are at their bounds.
_LEAST_LOG_STD, _LARGEST_LOG_STD = -5.0, 2.0
_ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU}


def bounded(log_std: torch.Tensor) -> torch.Tensor:
    """Return log standard deviations, clamped to a range that can be learnt."""
    return log_std.clamp(_LEAST_LOG_STD, _LARGEST_LOG_STD)


@dataclass(frozen=True)
class NetworkShapes:
    """Sizes that fix the networks: all that is needed to rebuild a policy.

    Attributes:
        vector: entries of the vector observation, 0 if there is none.
        pixels: (channels, height, width) of the images, None if there are none.
        actions: number of actions, each in [-1, 1].
    """

    vector: int
    pixels: tuple[int, int, int] | None
    actions: int

    @classmethod
    def of(cls, observation: Any, action: Any) -> "NetworkShapes":
        """Return the sizes of an observation and an action, or of their specs."""
        keys, pixels = list(observation.keys()), None
        if PIXELS in keys:
            channels, height, width = observation[PIXELS].shape[-3:]
            pixels = channels, height, width
        vector = observation[VECTOR].shape[-1] if VECTOR in keys else 0
        return cls(int(vector), pixels, int(action.shape[-1]))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "NetworkShapes":
        """Invert `to_dict`; ValueError if a size is missing or no integer."""
        kinds = typing.get_type_hints(cls).items()
        return cls(**{n: checked(f"shapes.{n}", values.get(n), k) for n, k in kinds})

    def to_dict(self) -> dict[str, Any]:
        """Return the sizes as JSON-able values."""
        return asdict(self)

    def split(
        self, config: ActorCriticConfig
    ) -> "tuple[NetworkShapes, NetworkShapes | None]":
        """Split the sizes of the collected observation between policy and critic.

        Returns:
            Sizes of the policy and of the critic; None for a critic that reads the
            same.

        Raises:
            ConfigError: the critic is to read something else, but the policy does not
                read images alone or the critic does not read vectors alone.
        """
        critic = config.critic_observation
        if critic is None:
            return self, None
        if not _are_images(config.observation, True) or not _are_images(critic, False):
            raise ConfigError(
                f"critic_observation={critic!r} beside observation="
                f"{config.observation!r} is not allowed: the policy must read images "
                'alone and the critic vectors alone, such as "image" and "internal".'
            )
        return replace(self, vector=0), replace(self, pixels=None)

    @property
    def raw_keys(self) -> list[str]:
        """Keys of the raw observation of the environment."""
        return [VECTOR] * (self.vector > 0) + [PIXELS] * (self.pixels is not None)

    @property
    def keys(self) -> list[str]:
        """Keys that the networks read."""
        images = self.pixels is not None
        return [NORMAL] * (self.vector > 0) + [NORMAL_PIXELS] * images


def _are_images(names: str | tuple[str, ...], images: bool) -> bool:
    chosen = observations.resolve(names)
    return all(one.is_image == images for one in observations.entries(chosen))


class Convolutions(nn.Module):
    """Map normalised images (..., C, H, W) to features (..., cnn_features)."""

    def __init__(self, shape: tuple[int, int, int], config: TrainingConfig):
        super().__init__()
        layers: list[nn.Module] = []
        channels = shape[0]
        for filters, kernel, stride in config.convolutions:
            layers += [nn.Conv2d(channels, filters, kernel, stride), nn.ReLU()]
            channels = filters
        self.filters = nn.Sequential(*layers, nn.Flatten(-3))
        size = f"{shape[1]} x {shape[2]} pixels; give fewer or smaller ones"
        text = f"convolutions do not fit images of {size}"
        with files.refused(ConfigError, text, RuntimeError):
            entries = self.filters(torch.zeros(shape)).numel()
        self.head = nn.Sequential(nn.Linear(entries, config.cnn_features), nn.ReLU())

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """Return the features; any number of axes may precede the channels."""
        flat = pixels.reshape((-1, *pixels.shape[-3:]))
        return self.head(self.filters(flat)).reshape((*pixels.shape[:-3], -1))


class Body(nn.Module):
    """Map an observation, and for a Q function an action, to hidden features.

    Images alone pass only through the convolutions; with a vector or an action, hidden
    layers follow.
    """

    def __init__(self, shapes: NetworkShapes, config: TrainingConfig, actions: int = 0):
        super().__init__()
        self.convolutions: Convolutions | None = None
        size = shapes.vector + actions
        if shapes.pixels is not None:
            self.convolutions = Convolutions(shapes.pixels, config)
            size += config.cnn_features
        self.has_vector = shapes.vector > 0
        layers: list[nn.Module] = []
        if shapes.vector or actions:
            for width in config.hidden:
                layers += [nn.Linear(size, width), _ACTIVATIONS[config.activation]()]
                size = width
        self.hidden = nn.Sequential(*layers)
        self.features = size

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        """Inputs in the order of `shapes.keys`, then the action if there is one."""
        parts = list(inputs)
        if self.convolutions is not None:
            index = int(self.has_vector)
            parts[index] = self.convolutions(parts[index])
        return self.hidden(parts[0] if len(parts) == 1 else torch.cat(parts, -1))


class GaussianActor(nn.Module):
    """Mean and deviation of the actions before the tanh, each (..., actions)."""

    def __init__(self, shapes: NetworkShapes, config: TrainingConfig):
        super().__init__()
        self.body = Body(shapes, config)
        self.mean = nn.Linear(self.body.features, shapes.actions)
        self.log_std: nn.Linear | nn.Parameter = (
            nn.Linear(self.body.features, shapes.actions)
            if config.state_dependent_std
            else nn.Parameter(torch.zeros(shapes.actions))
        )

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (mean, deviation)."""
        features = self.body(*inputs)
        mean = self.mean(features)
        layer = self.log_std
        raw = layer(features) if isinstance(layer, nn.Linear) else layer
        return mean, bounded(raw).exp().expand_as(mean)


class Value(nn.Module):
    """Value (..., 1) of an observation, or of observation and action."""

    def __init__(self, shapes: NetworkShapes, config: TrainingConfig, actions: int = 0):
        super().__init__()
        self.body = Body(shapes, config, actions)
        self.value = nn.Linear(self.body.features, 1)

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        """Inputs in the order of `shapes.keys`, then the action if there is one."""
        return self.value(self.body(*inputs))


def orthogonal_(module: nn.Module, head: nn.Linear, gain: float) -> None:
    """Initialise orthogonally, with `gain` for the head, and with zero biases."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d):
            nn.init.orthogonal_(layer.weight, gain if layer is head else 2**0.5)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def make_critic(
    shapes: NetworkShapes, config: TrainingConfig, actions: int = 0
) -> ValueOperator:
    """Return a state value, or with a number of actions a Q function."""
    keys = [*shapes.keys, "action"] if actions else shapes.keys
    return ValueOperator(Value(shapes, config, actions), in_keys=keys)


def make_normalisers(
    shapes: NetworkShapes, config: TrainingConfig
) -> list[TensorDictModule]:
    """Return the modules that normalise raw observations for the networks."""
    made: dict[str, nn.Module] = {}
    if shapes.vector:
        made[VECTOR] = ObservationNormaliser(shapes.vector, config.observation_clip)
    if shapes.pixels is not None:
        made[PIXELS] = ImageNormaliser(shapes.pixels, config.subtract_background)
    return [
        TensorDictModule(module, in_keys=[raw], out_keys=[key])
        for (raw, module), key in zip(made.items(), shapes.keys, strict=True)
    ]


def make_policy(shapes: NetworkShapes, config: TrainingConfig) -> TensorDictSequential:
    """Return normalisers and stochastic actor: raw observation to action in [-1, 1]."""
    network = GaussianActor(shapes, config)
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=shapes.keys, out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    return TensorDictSequential(*make_normalisers(shapes, config), actor)


def network_of(policy: nn.Module) -> GaussianActor:
    """Return the actor network of a policy."""
    return next(m for m in policy.modules() if isinstance(m, GaussianActor))
