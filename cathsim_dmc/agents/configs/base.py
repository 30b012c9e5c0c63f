"""What every training run must say, whichever algorithm learns."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

ACTIVATIONS = ("tanh", "relu", "elu")
PATHS = ("batched", "composer")


class ConfigError(ValueError):
    """A hyper-parameter is outside what is allowed, or contradicts another."""


def require(condition: bool, name: str, given: object, allowed: str) -> None:
    """Raise ConfigError naming the field, what was given and what is allowed."""
    if not condition:
        raise ConfigError(f"{name}={given!r} is not allowed: {name} must be {allowed}.")


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """Settings shared by all algorithms; subclasses add the algorithm's own.

    Attributes:
        task: name of a registered task, such as "type1_bca".
        observation: name or names of the task's observations ("internal", "image",
            "sequential", "tracking", "force").
        task_kwargs: further keyword arguments of the task; must be JSON-able.
        path: "batched" steps all environments in one thread pool, "composer" runs
            one dm_control environment after the other (slow; the reference).
        num_envs: simulations stepped side by side.
        num_threads: threads of the batched simulation; None takes every core.
        seed: of networks, exploration and environments together.
        total_frames: control steps over all environments. The last batch is
            finished, so a run may end slightly above.
        hidden: width of the hidden layers of the vector networks.
        activation: of the hidden layers; one of ACTIVATIONS.
        cnn_features: width of the layer behind the convolutions (images only).
        learning_rate: of Adam, for every network.
        gamma: discount per control step.
        observation_clip: normalised vector entries are clipped to +- this.
        normalisation_frames: random steps before the first update from which the
            first observation statistics come; they are not counted as frames. An
            algorithm that begins with random actions anyway (SAC) needs none.
        checkpoint_frames: frames between two checkpoints.
        keep_checkpoints: how many of the newest checkpoints stay on disk.
        metrics_frames: frames between two rows of metrics.csv.
        tensorboard: also write event files (needs the `tensorboard` extra).
        device: torch device of the networks, "cpu" or "cuda"; simulation is
            always on the CPU.
        torch_threads: threads of one torch operation. One is fastest for the small
            published MLP; images profit from all cores.
    """

    algorithm: ClassVar[str] = ""
    # What may differ between a run and its continuation: nothing that learning
    # depends on, apart from how long it lasts.
    resumable: ClassVar[frozenset[str]] = frozenset(
        {
            "total_frames",
            "checkpoint_frames",
            "keep_checkpoints",
            "metrics_frames",
            "tensorboard",
            "num_threads",
            "torch_threads",
            "device",
        }
    )

    task: str = "type1_bca"
    observation: str | tuple[str, ...] = "internal"
    task_kwargs: Mapping[str, Any] = field(default_factory=dict)
    path: str = "batched"
    num_envs: int = 16
    num_threads: int | None = None
    seed: int = 0
    total_frames: int = 600_000
    hidden: tuple[int, ...] = (64, 64)
    activation: str = "tanh"
    cnn_features: int = 512
    learning_rate: float = 3e-4
    gamma: float = 0.99
    observation_clip: float = 10.0
    normalisation_frames: int = 4_096
    checkpoint_frames: int = 51_200
    keep_checkpoints: int = 3
    metrics_frames: int = 2_048
    tensorboard: bool = False
    device: str = "cpu"
    torch_threads: int = 1

    def __post_init__(self):
        """Validate; every message says what was given and what is allowed."""
        object.__setattr__(self, "hidden", tuple(self.hidden))
        if not isinstance(self.observation, str):
            object.__setattr__(self, "observation", tuple(self.observation))
        object.__setattr__(self, "task_kwargs", dict(self.task_kwargs))
        require(bool(self.task), "task", self.task, "the name of a task")
        require(bool(self.observation), "observation", self.observation, "a name")
        require(self.path in PATHS, "path", self.path, f"one of {PATHS}")
        require(
            self.activation in ACTIVATIONS,
            "activation",
            self.activation,
            f"one of {ACTIVATIONS}",
        )
        require(
            len(self.hidden) > 0 and all(width > 0 for width in self.hidden),
            "hidden",
            self.hidden,
            "one or more positive widths",
        )
        for name in (
            "num_envs",
            "total_frames",
            "cnn_features",
            "checkpoint_frames",
            "keep_checkpoints",
            "metrics_frames",
            "torch_threads",
        ):
            value = getattr(self, name)
            require(
                isinstance(value, int) and value > 0, name, value, "a positive integer"
            )
        for name in ("seed", "normalisation_frames"):
            value = getattr(self, name)
            require(
                isinstance(value, int) and value >= 0, name, value, "an integer >= 0"
            )
        threads = self.num_threads
        require(
            threads is None or threads > 0,
            "num_threads",
            threads,
            "a positive integer, or None for every core",
        )
        require(0 < self.gamma <= 1, "gamma", self.gamma, "in (0, 1]")
        for name in ("learning_rate", "observation_clip"):
            value = getattr(self, name)
            require(value > 0, name, value, "positive")
        try:
            json.dumps(self.task_kwargs)
        except TypeError as error:
            raise ConfigError(
                f"task_kwargs={self.task_kwargs!r} cannot be written to config.json "
                f"({error}); use numbers, strings, lists and dicts only."
            ) from error

    @property
    def frames_per_batch(self) -> int:
        """Frames between two calls of the learner's update, over all envs."""
        raise NotImplementedError

    def replace(self, **changes: Any) -> "TrainingConfig":
        """A copy with some fields changed, validated again."""
        unknown = set(changes) - {item.name for item in dataclasses.fields(self)}
        if unknown:
            valid = sorted(item.name for item in dataclasses.fields(self))
            raise ConfigError(
                f"{type(self).__name__} has no field {sorted(unknown)}; "
                f"valid fields are {valid}."
            )
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """The config as JSON-able values, with the algorithm's name."""
        values = dataclasses.asdict(self)
        values["hidden"] = list(self.hidden)
        if not isinstance(self.observation, str):
            values["observation"] = list(self.observation)
        return {"algorithm": self.algorithm, **values}

    def changed_for_resume(self, other: "TrainingConfig") -> dict[str, tuple]:
        """Fields (name: (here, other)) that differ and may not on resuming."""
        here, there = self.to_dict(), other.to_dict()
        return {
            name: (here.get(name), there.get(name))
            for name in sorted(set(here) | set(there))
            if name not in self.resumable and here.get(name) != there.get(name)
        }
