"""The published networks, for vector observations, images, or both."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator

from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.normalisation import ObservationNormaliser
from cathsim_dmc.simulation.environments import PIXELS, VECTOR

# The normalised vector: what the networks read in place of VECTOR.
NORMAL = "observation_normal"

# (filters, kernel, stride) of the published convolutions.
CONVOLUTIONS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))

# A deviation below exp(-5) before the tanh no longer explores; above exp(2) all
# actions sit at their bounds.
LOG_STD_RANGE = (-5.0, 2.0)

# Largest size that a description of networks may ask for: it must not take all memory.
MAX_SIZE = 65_536

_ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU}


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
    def of(cls, env: EnvBase) -> "NetworkShapes":
        """Read the sizes from an environment's specs."""
        spec = env.observation_spec
        keys = list(spec.keys())
        pixels = tuple(spec[PIXELS].shape[-3:]) if PIXELS in keys else None
        vector = spec[VECTOR].shape[-1] if VECTOR in keys else 0
        return cls(int(vector), pixels, int(env.action_spec.shape[-1]))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "NetworkShapes":
        """The inverse of to_dict.

        Raises:
            ValueError: a size is missing, no integer or out of range.
        """

        def size(value: object, name: str, least: int) -> int:
            if type(value) is not int or not least <= value <= MAX_SIZE:
                raise ValueError(
                    f"shapes.{name} is {value!r}; it must be an integer from {least} "
                    f"to {MAX_SIZE:,}."
                )
            return value

        pixels = values.get("pixels")
        if pixels is not None:
            if not isinstance(pixels, list | tuple) or len(pixels) != 3:
                raise ValueError(
                    f"shapes.pixels is {pixels!r}; it must be null or [channels, "
                    "height, width]."
                )
            channels, height, width = (size(one, "pixels", 1) for one in pixels)
            pixels = (channels, height, width)
        return cls(
            vector=size(values.get("vector"), "vector", 0),
            pixels=pixels,
            actions=size(values.get("actions"), "actions", 1),
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values."""
        return asdict(self)

    @property
    def raw_keys(self) -> list[str]:
        """Keys of the observation as the environment gives it."""
        return [VECTOR] * (self.vector > 0) + [PIXELS] * (self.pixels is not None)

    @property
    def keys(self) -> list[str]:
        """Keys that the networks read."""
        return [NORMAL] * (self.vector > 0) + [PIXELS] * (self.pixels is not None)


class Convolutions(nn.Module):
    """Images (..., C, H, W) uint8 to features (..., features) float32."""

    def __init__(self, shape: tuple[int, int, int], features: int):
        super().__init__()
        layers: list[nn.Module] = []
        channels = shape[0]
        for filters, kernel, stride in CONVOLUTIONS:
            layers += [nn.Conv2d(channels, filters, kernel, stride), nn.ReLU()]
            channels = filters
        self.filters = nn.Sequential(*layers, nn.Flatten(-3))
        with torch.no_grad():
            size = self.filters(torch.zeros(1, *shape)).shape[-1]
        self.head = nn.Sequential(nn.Linear(size, features), nn.ReLU())

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """Scale to [0, 1] here, so that storage keeps bytes."""
        batch = pixels.shape[:-3]
        flat = pixels.reshape(-1, *pixels.shape[-3:]).float() / 255.0
        return self.head(self.filters(flat)).reshape(*batch, -1)


class Body(nn.Module):
    """Observation (and action, for a Q function) to hidden features.

    Images alone go through the convolutions; wherever a vector is present, hidden
    layers follow.
    """

    def __init__(self, shapes: NetworkShapes, config: TrainingConfig, actions: int = 0):
        super().__init__()
        self.convolutions: Convolutions | None = None
        size = shapes.vector + actions
        if shapes.pixels is not None:
            self.convolutions = Convolutions(shapes.pixels, config.cnn_features)
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
    """Mean and deviation of the actions before the tanh, each (..., actions).

    Args:
        shapes: sizes of observation and action.
        config: widths and activation.
        state_dependent_std: whether the deviation is an output of the network (SAC)
            or one parameter per action (PPO).
    """

    def __init__(
        self, shapes: NetworkShapes, config: TrainingConfig, state_dependent_std: bool
    ):
        super().__init__()
        self.body = Body(shapes, config)
        self.mean = nn.Linear(self.body.features, shapes.actions)
        # A layer, or a parameter.
        self.log_std: nn.Linear | nn.Parameter = (
            nn.Linear(self.body.features, shapes.actions)
            if state_dependent_std
            else nn.Parameter(torch.zeros(shapes.actions))
        )

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (mean, deviation)."""
        features = self.body(*inputs)
        mean = self.mean(features)
        layer = self.log_std
        raw = layer(features) if isinstance(layer, nn.Linear) else layer
        return mean, raw.clamp(*LOG_STD_RANGE).exp().expand_as(mean)


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
    """Initialise as PPO expects: orthogonal layers, zero biases, a small head."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d):
            nn.init.orthogonal_(layer.weight, gain if layer is head else 2**0.5)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def make_actor(shapes: NetworkShapes, network: GaussianActor) -> ProbabilisticActor:
    """The stochastic actor on a network; actions in [-1, 1]."""
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=shapes.keys, out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def make_critic(shapes: NetworkShapes, config: TrainingConfig) -> ValueOperator:
    """State value, key "state_value"."""
    network = Value(shapes, config)
    orthogonal_(network, network.value, 1.0)
    return ValueOperator(network, in_keys=shapes.keys)


def make_q_function(shapes: NetworkShapes, config: TrainingConfig) -> ValueOperator:
    """Action value, key "state_action_value"."""
    network = Value(shapes, config, shapes.actions)
    return ValueOperator(network, in_keys=[*shapes.keys, "action"])


def make_normaliser(shapes: NetworkShapes, config: TrainingConfig) -> TensorDictModule:
    """The module that turns the raw vector into the networks' input."""
    module = ObservationNormaliser(shapes.vector, config.observation_clip)
    return TensorDictModule(module, in_keys=[VECTOR], out_keys=[NORMAL])


def make_policy(
    shapes: NetworkShapes, config: TrainingConfig, actor: ProbabilisticActor
) -> TensorDictSequential:
    """Normaliser and actor in one: raw observation in, action out."""
    modules: list[nn.Module] = []
    if shapes.vector:
        modules.append(make_normaliser(shapes, config))
    return TensorDictSequential(*modules, actor)
