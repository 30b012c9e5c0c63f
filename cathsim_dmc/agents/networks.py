"""The published networks, for vector observations, images, or both."""

import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator

from cathsim_dmc.agents.actor_critic import ActorCriticConfig
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.fields import require_type, tuples
from cathsim_dmc.agents.normalisation import ImageNormaliser, ObservationNormaliser
from cathsim_dmc.simulation.environments import PIXELS, VECTOR
from cathsim_dmc.tasks import observations

# What the networks read in place of VECTOR and PIXELS.
NORMAL = "observation_normal"
NORMAL_PIXELS = "pixels_normal"

# A deviation below exp(-5) before the tanh explores nothing; above exp(2) all
# actions are at their bounds.
LOG_STD_RANGE = (-5.0, 2.0)


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
        """The inverse of to_dict; ConfigError if a size is missing or no integer."""
        fields = {name: tuples(values.get(name)) for name in cls.__annotations__}
        for name, kind in typing.get_type_hints(cls).items():
            require_type(f"shapes.{name}", fields[name], kind)
        return cls(**fields)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values."""
        return asdict(self)

    def split(
        self, config: ActorCriticConfig
    ) -> "tuple[NetworkShapes, NetworkShapes | None]":
        """Sizes of what the policy reads and of what the critic reads.

        Returns:
            The parts of what is collected; None for a critic that reads the same.

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
        """Keys of the observation as the environment gives it."""
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
    """Normalised images (..., C, H, W) to features (..., features)."""

    def __init__(self, shape: tuple[int, int, int], config: TrainingConfig):
        super().__init__()
        layers: list[nn.Module] = []
        channels, *size = shape
        for filters, kernel, stride in config.convolutions:
            if min(size) < kernel:
                raise ConfigError(
                    f"convolutions={config.convolutions!r} do not fit images of "
                    f"{shape[1]} x {shape[2]} pixels: one of {kernel} x {kernel} "
                    f"meets {size[0]} x {size[1]}; give fewer or smaller ones."
                )
            size = [(length - kernel) // stride + 1 for length in size]
            layers += [nn.Conv2d(channels, filters, kernel, stride), nn.ReLU()]
            channels = filters
        self.filters = nn.Sequential(*layers, nn.Flatten(-3))
        entries = channels * size[0] * size[1]
        self.head = nn.Sequential(nn.Linear(entries, config.cnn_features), nn.ReLU())

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """Take any number of dimensions before the channels."""
        batch = pixels.shape[:-3]
        flat = pixels.reshape(-1, *pixels.shape[-3:])
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
    """Mean and deviation of the actions before the tanh, each (..., actions).

    Args:
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


def make_critic(shapes: NetworkShapes, config: TrainingConfig) -> ValueOperator:
    """State value, key "state_value"."""
    network = Value(shapes, config)
    orthogonal_(network, network.value, 1.0)
    return ValueOperator(network, in_keys=shapes.keys)


def make_q_function(shapes: NetworkShapes, config: TrainingConfig) -> ValueOperator:
    """Action value, key "state_action_value"."""
    network = Value(shapes, config, shapes.actions)
    return ValueOperator(network, in_keys=[*shapes.keys, "action"])


def make_normalisers(
    shapes: NetworkShapes, config: TrainingConfig
) -> list[TensorDictModule]:
    """The modules that turn raw observations into what the networks read."""
    modules: list[TensorDictModule] = []
    if shapes.vector:
        vector = ObservationNormaliser(shapes.vector, config.observation_clip)
        modules.append(TensorDictModule(vector, in_keys=[VECTOR], out_keys=[NORMAL]))
    if shapes.pixels is not None:
        images = ImageNormaliser(shapes.pixels, config.subtract_background)
        modules.append(
            TensorDictModule(images, in_keys=[PIXELS], out_keys=[NORMAL_PIXELS])
        )
    return modules


class Normalisers:
    """The normalisers that a learner needs: of its policy, and of its critic.

    Attributes:
        critics: Those of what the critic alone reads; none if it reads what the policy
            reads. The state of the others is that of the policy.
    """

    def __init__(
        self,
        policy: TensorDictSequential,
        critic_shapes: NetworkShapes | None,
        config: TrainingConfig,
    ):
        """Takes the sizes of what the critic reads, None for those of the policy."""
        self._policys = cast(list[TensorDictModule], list(policy.module)[:-1])
        own = [] if critic_shapes is None else make_normalisers(critic_shapes, config)
        self.critics = nn.ModuleList(own).to(config.torch_device)
        self._all = [*self._policys, *own]

    def observe(self, batch: TensorDictBase) -> None:
        """Take observation statistics from raw observations."""
        for module in self._all:
            statistics = cast(ObservationNormaliser | ImageNormaliser, module.module)
            raw = batch[module.in_keys[0]]
            statistics.update(raw.to(statistics.mean.device))

    def add(self, batch: TensorDictBase) -> None:
        """Add what policy and critic read to raw observations."""
        for module in self._all:
            module(batch)

    def add_for_critic(self, batch: TensorDictBase) -> None:
        """Add what the critic reads to raw observations."""
        for module in self.critics or self._policys:
            module(batch)


def make_policy(
    shapes: NetworkShapes, config: TrainingConfig, network: GaussianActor
) -> TensorDictSequential:
    """Normalisers and stochastic actor: raw observation in, action in [-1, 1] out."""
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=shapes.keys, out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    return TensorDictSequential(*make_normalisers(shapes, config), actor)
