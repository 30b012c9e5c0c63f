"""Settings that all algorithms share, and the checks of all settings."""

import dataclasses
import itertools
import json
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from cathsim_dmc import bounds

# Convolutions of the published agents: (filters, kernel size, stride) of each.
PUBLISHED_CONVOLUTIONS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))

# Task options of the presets "tuned", found on type1_lcca (docs/training.md): reward by
# the path through the lumen, short episodes that start anywhere along the route.
TUNED_TRAINING: Mapping[str, Any] = {
    "training_reward": {"path": -1.0, "success": 10.0},
    "training_max_steps": 120,
    "training_start": (0.0, 0.9),
}
# Additions of the presets "tuned_image": background subtraction, a first convolution
# with a stride of its kernel size (a fifth of the published cost), and a critic that
# reads the state.
TUNED_IMAGES: Mapping[str, Any] = {
    "observation": "image",
    "critic_observation": "internal",
    "subtract_background": True,
    "convolutions": ((32, 8, 8), (64, 4, 2), (64, 3, 1)),
    "cnn_features": 256,
}
_MOST = 2**62
_MOST_WIDTH = 2**16  # of a layer; a square weight matrix of this size takes 17 GB


class ConfigError(ValueError):
    """A hyper-parameter is outside what is allowed, or contradicts another."""


def require(condition: bool, name: str, given: object, allowed: str) -> None:
    """Raise ConfigError naming the field, what was given and what is allowed."""
    if not condition:
        raise ConfigError(f"{name} is {bounds.shown(given)}; it must be {allowed}")


def positive(default: Any, **limits: Any) -> Any:
    """Return a dataclass field of numbers above 0, with limits as for `within`."""
    return dataclasses.field(default=default, metadata={"positive": True, **limits})


def within(default: Any, **limits: Any) -> Any:
    """Return a dataclass field of numbers from `low` to `high`, both included."""
    return dataclasses.field(default=default, metadata=limits)


def check_fields(config: Any) -> None:
    """Raise ConfigError unless the fields of a dataclass have their types and bounds.

    Lists become tuples. The bounds of a base class hold in its subclasses.
    """
    for name, kind in typing.get_type_hints(type(config)).items():
        if typing.get_origin(kind) is ClassVar:
            continue
        limits: dict[str, Any] = {}
        for base in reversed(type(config).__mro__):
            field = getattr(base, "__dataclass_fields__", {}).get(name)
            limits |= {} if field is None else field.metadata
        try:
            value = checked(name, getattr(config, name), kind, **limits)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        object.__setattr__(config, name, value)


def checked(name: str, value: Any, kind: Any, **limits: Any) -> Any:
    """Return a value checked against an annotation, lists as tuples; or ValueError."""
    origin, kinds = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if value is None and types.NoneType in kinds:
            return None
        kinds = [one for one in kinds if one is not types.NoneType]
        # In `str | tuple[str, ...]` the string comes first.
        return checked(name, value, kinds[-(not isinstance(value, str))], **limits)
    if origin is Literal:
        return bounds.choice(name, value, kinds)
    if origin is Mapping:
        values = bounds.options(name, bounds.instance(name, value, Mapping))
        if kinds[1] is Any:
            return values
        return {
            key: checked(f"{name}[{key!r}]", one, kinds[1], **limits)
            for key, one in values.items()
        }
    if origin is tuple:
        if not isinstance(value, list | tuple) or not value:
            bounds.refuse(name, value, "a list with one entry or more")
        return tuple(checked(name, one, kinds[0], **limits) for one in value)
    if kind is int:
        low = 1 if "positive" in limits else limits.get("low", -_MOST)
        return bounds.whole(name, value, low, limits.get("high", _MOST))
    if kind is float:
        return bounds.number(name, value, **limits)
    if kind is bool:
        return bounds.switch(name, value)
    if not isinstance(value, str) or not value:
        bounds.refuse(name, value, "a text")
    return value


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """Settings shared by all algorithms; subclasses add the algorithm's own.

    Attributes:
        task: Name of a registered task, such as "type1_bca".
        observation: Name or names of the task's observations, such as "internal",
            "image", "sequential" or "tracking".
        task_kwargs: Further options of the task; must be JSON-able.
        training_reward: Weights of the reward terms to learn from: path -1 success 10
            on the command line (no JSON), {"path": -1, "success": 10} in Python; None
            takes the task's. Evaluation and recordings always take the task's.
        training_max_steps: Largest number of control steps of a training episode; the
            return of a truncated one is bootstrapped with the value of its last state;
            None takes the task's. Evaluation and recordings always take the task's.
        training_start: Range (low, high) of the fraction of the way to the goal at
            which training episodes start; None takes the task's. Evaluation and
            recordings always take the task's.
        num_envs: Number of simulations stepped in parallel.
        num_threads: Number of threads of the batched simulation; None takes one per
            core, and on a cluster one in each process.
        seed: Seed of networks, exploration and environments.
        total_frames: Number of control steps to train for, over all simulations. The
            last batch is finished, so a run may end slightly above.
        hidden: Widths of the hidden layers of the vector networks.
        activation: Activation function of the hidden layers.
        subtract_background: Whether the networks read images as the difference from
            the mean image, as in digital subtraction angiography; their brightness
            otherwise.
        convolutions: Convolutions of the images, each (filters, kernel size, stride).
        cnn_features: Width of the layer after the convolutions (images only).
        learning_rate: Learning rate of Adam, for every network.
        gamma: Discount factor per control step.
        observation_clip: Largest magnitude of a normalised vector entry; larger ones
            are clipped.
        normalisation_frames: Number of random control steps before the first update,
            from which the first observation statistics come; they are not counted as
            frames. An algorithm that begins with random actions anyway (SAC) needs
            none, nor does one that starts from another policy, unless its critic reads
            other observations.
        initial_policy: Directory of the run or checkpoint, or "pretrained:NAME", whose
            policy the networks start from, with its observation statistics; None for
            random weights.
        initial_std: Initial standard deviation, before the tanh, of every action of an
            initial_policy; None keeps the policy's own.
        checkpoint_frames: Number of frames between two checkpoints.
        checkpoint_seconds: Longest time between two checkpoints in seconds of wall
            time, so that a killed run loses no more.
        keep_checkpoints: Number of the newest checkpoints that stay on disk.
        metrics_frames: Number of frames between two rows of metrics.csv.
        logger: Logger that also gets the rows of metrics.csv: csv (a file for each
            column), tensorboard, trackio or wandb, offline unless WANDB_MODE is online;
            each except csv needs the extra of that name. None for metrics.csv only.
        torch_device: Torch device of the networks, such as "cpu" or "cuda".
        simulation_device: Where the simulations run: "cpu", or "cuda" for MuJoCo Warp
            on a GPU (docs/gpu.md), with hundreds of simulations or more.
        torch_threads: Number of threads of one torch operation. One is fastest for
            the small published MLP; images profit from all cores.
        modules: Modules that define what the run uses, such as a task of your own. The
            run stores their names, and an error names missing ones; only `--import`
            imports them.
        collector: Where the simulations run: "local", in this process, or "ray", in
            processes of a Ray cluster (needs the `ray` extra).
        collectors: Number of processes of "ray", which share the simulations.
    """

    algorithm: ClassVar[str] = ""
    # Whether the deviation of the actions is an output of the network (SAC), or a
    # parameter of each action.
    state_dependent_std: ClassVar[bool] = False
    # Settings by the name of a preset; settings that it leaves out have their defaults.
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"published": {}}

    task: str = "type1_bca"
    observation: str | tuple[str, ...] = "internal"
    task_kwargs: Mapping[str, Any] = field(default_factory=dict)
    training_reward: Mapping[str, float] | None = None
    training_max_steps: int | None = positive(None)
    training_start: tuple[float, float] | None = within(
        None, low=0.0, high=bounds.MOST_START_SHARE
    )
    num_envs: int = positive(16, high=bounds.MOST_SIMULATIONS)
    num_threads: int | None = positive(None, high=bounds.MOST_THREADS)
    seed: int = within(0, low=0)
    total_frames: int = positive(600_000)
    hidden: tuple[int, ...] = positive((64, 64), high=_MOST_WIDTH)
    activation: Literal["tanh", "relu", "elu"] = "tanh"
    subtract_background: bool = False
    convolutions: tuple[tuple[int, int, int], ...] = positive(
        PUBLISHED_CONVOLUTIONS, high=_MOST_WIDTH
    )
    cnn_features: int = positive(512, high=_MOST_WIDTH)
    learning_rate: float = positive(3e-4)
    gamma: float = positive(0.99, high=1.0)
    observation_clip: float = positive(10.0)
    normalisation_frames: int = within(4_096, low=0)
    initial_policy: str | None = None
    initial_std: float | None = positive(None)
    checkpoint_frames: int = positive(51_200)
    checkpoint_seconds: float = positive(120.0)
    keep_checkpoints: int = positive(3)
    metrics_frames: int = positive(2_048)
    logger: Literal["csv", "tensorboard", "trackio", "wandb"] | None = None
    torch_device: str = "cpu"
    simulation_device: str = "cpu"
    torch_threads: int = positive(1)
    modules: tuple[str, ...] | None = None
    collector: Literal["local", "ray"] = "local"
    collectors: int = positive(2)

    def __post_init__(self):
        """Validate; every message says what was given and what is allowed."""
        check_fields(self)
        layers, start = self.convolutions, self.training_start
        fit = all(len(layer) == 3 for layer in layers)
        require(fit, "convolutions", layers, "(filters, kernel size, stride) of each")
        place = bounds.SIMULATION_DEVICE.fullmatch(self.simulation_device)
        named = bounds.SIMULATION_DEVICES
        require(bool(place), "simulation_device", self.simulation_device, named)
        ordered = start is None or (len(start) == 2 and start[0] <= start[1])
        require(
            ordered, "training_start", start, "two fractions (low, high), low <= high"
        )
        try:
            json.dumps(self.task_kwargs, allow_nan=False)
        except (TypeError, ValueError) as error:
            what = f"finite numbers, strings, lists and dicts only: {error}"
            require(False, "task_kwargs", self.task_kwargs, what)

    @property
    def resumable(self) -> frozenset[str]:
        """Settings that may change when the run is resumed.

        Learning depends on none of them, except for the number of frames and the path
        of the dataset.
        """
        names = frozenset(
            {"total_frames", "checkpoint_frames", "checkpoint_seconds"}
            | {"keep_checkpoints", "metrics_frames", "logger", "num_threads"}
            | {"torch_threads", "torch_device", "torch_compile", "simulation_device"}
            | {"demonstrations", "modules", "collector", "collectors"}
        )
        return names & vars(self).keys()

    @property
    def training_kwargs(self) -> dict[str, Any]:
        """Options of the task during training."""
        own = {
            "reward": self.training_reward,
            "max_steps": self.training_max_steps,
            "start_along_route": self.training_start,
        }
        given = {name: value for name, value in own.items() if value is not None}
        return {**self.task_kwargs, **given}

    @property
    def collected_observation(self) -> str | tuple[str, ...]:
        """Name or names of the observations that the training collects."""
        return self.observation

    @property
    def frames_per_batch(self) -> int:
        """Frames between two calls of the learner's update, over all environments."""
        return self.num_envs * vars(self)["steps_per_env"]

    def replace(self, **changes: Any) -> "TrainingConfig":
        """A copy with some fields changed, validated again."""
        return self.from_dict({**vars(self), **changes})

    def to_dict(self) -> dict[str, Any]:
        """The config as JSON-able values, with the algorithm's name."""
        # Tuples become lists.
        return {"algorithm": self.algorithm, **json.loads(json.dumps(vars(self)))}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "TrainingConfig":
        """Make a config from its fields by name; ConfigError if one is not allowed."""
        valid = [item.name for item in dataclasses.fields(cls)]
        if unknown := set(values) - set(valid):
            names = ", ".join(sorted(map(str, unknown)))
            raise ConfigError(
                f"{cls.__name__} has no field {names}; its fields are "
                f"{', '.join(valid)}."
            )
        return cls(**values)

    def changed_for_resume(self, other: "TrainingConfig") -> dict[str, tuple]:
        """Return fields (name: (own, other)) that differ but must not on resuming."""
        here, there = self.to_dict(), other.to_dict()
        names = sorted((here.keys() | there.keys()) - self.resumable)
        pairs = {name: (here.get(name), there.get(name)) for name in names}
        return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


@dataclass(frozen=True, kw_only=True)
class ActorCriticConfig(TrainingConfig):
    """Settings shared by the algorithms with a critic.

    Attributes:
        critic_observation: Name or names of the vector observations that the critic
            reads in place of the images that the policy reads (Pinto et al. 2018,
            "Asymmetric Actor Critic for Image-Based Robot Learning"); only the training
            needs them. None for those of the policy.
        torch_compile: Whether torch compiles the loss and its gradient, for faster
            gradient steps (docs/training.md); needs a C++ compiler and up to a minute.
        anneal: Whether to decrease the learning rate linearly to zero over
            total_frames.
    """

    critic_observation: str | tuple[str, ...] | None = None
    torch_compile: bool = False
    anneal: bool = False

    @property
    def resumable(self) -> frozenset[str]:
        """All but the length of a run over which the learning rate falls."""
        return super().resumable - ({"total_frames"} if self.anneal else set())

    @property
    def collected_observation(self) -> str | tuple[str, ...]:
        """Names of the observations of policy and critic."""
        if self.critic_observation is None:
            return self.observation
        both = self.observation, self.critic_observation
        names = ((one,) if isinstance(one, str) else one for one in both)
        return tuple(dict.fromkeys(itertools.chain.from_iterable(names)))
