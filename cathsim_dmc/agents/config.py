"""Settings that all algorithms share."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from cathsim_dmc.agents.fields import (
    ConfigError,
    check_fields,
    positive,
    require,
    within,
)
from cathsim_dmc.bounds import MOST_START_SHARE

# Convolutions of the published agents: (filters, kernel size, stride) of each.
PUBLISHED_CONVOLUTIONS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """Settings shared by all algorithms; subclasses add the algorithm's own.

    Attributes:
        task: Name of a registered task, such as "type1_bca".
        observation: Name or names of the task's observations, such as "internal",
            "image", "sequential" or "tracking".
        task_kwargs: Further options of the task; must be JSON-able.
        training_reward: Weights of the reward terms to learn from, such as
            {"path": -1, "success": 10}, or path -1 success 10 on the command line;
            None takes the task's. Evaluation and recordings always take the task's.
        training_max_steps: Largest number of control steps of an episode of the
            training, at whose end the value is carried on; None takes the task's.
            Evaluation and recordings always take the task's.
        training_start: Least and largest share of the way to the goal that the device
            has made when an episode of the training starts; None takes the task's.
            Evaluation and recordings always take the task's.
        num_envs: Number of simulations stepped side by side.
        num_threads: Number of threads of the batched simulation; None takes one per
            core.
        seed: Seed of networks, exploration and environments.
        total_frames: Number of control steps to train for, over all simulations. The
            last batch is finished, so a run may end slightly above.
        hidden: Widths of the hidden layers of the vector networks.
        activation: Activation function of the hidden layers.
        subtract_background: Whether the networks read images as the difference from
            the mean image, as in digital subtraction angiography; their brightness
            otherwise.
        convolutions: Convolutions of the images, each (filters, kernel size, stride).
        cnn_features: Width of the layer behind the convolutions (images only).
        learning_rate: Learning rate of Adam, for every network.
        gamma: Discount factor per control step.
        observation_clip: Largest magnitude of a normalised vector entry; larger ones
            are clipped.
        normalisation_frames: Number of random control steps before the first update,
            from which the first observation statistics come; they are not counted as
            frames. An algorithm that begins with random actions anyway (SAC) needs
            none, nor does one that starts from another policy.
        initial_policy: Directory of the run or checkpoint, or "pretrained:NAME", whose
            policy the networks start from, with its observation statistics; None
            starts afresh.
        initial_std: Deviation before the tanh that every action of such a policy
            starts with; None keeps the policy's own.
        checkpoint_frames: Number of frames between two checkpoints.
        checkpoint_seconds: Longest time between two checkpoints in seconds of wall
            time, so that a killed run loses no more.
        keep_checkpoints: Number of the newest checkpoints that stay on disk.
        metrics_frames: Number of frames between two rows of metrics.csv.
        torch_device: Torch device of the networks, such as "cpu" or "cuda"; the
            simulation is always on the CPU.
        torch_threads: Number of threads of one torch operation. One is fastest for
            the small published MLP; images profit from all cores.
    """

    algorithm: ClassVar[str] = ""
    # Settings by the name of a preset; what a preset leaves out has its default.
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"published": {}}
    # What may differ between a run and its continuation: nothing that learning
    # depends on, apart from how long it lasts.
    resumable: ClassVar[frozenset[str]] = frozenset(
        {
            "total_frames",
            "checkpoint_frames",
            "checkpoint_seconds",
            "keep_checkpoints",
            "metrics_frames",
            "num_threads",
            "torch_threads",
            "torch_device",
        }
    )

    task: str = "type1_bca"
    observation: str | tuple[str, ...] = "internal"
    task_kwargs: Mapping[str, Any] = field(default_factory=dict)
    training_reward: Mapping[str, float] | None = None
    training_max_steps: int | None = positive(None)
    training_start: tuple[float, float] | None = None
    num_envs: int = positive(16)
    num_threads: int | None = positive(None)
    seed: int = within(0, 0)
    total_frames: int = positive(600_000)
    hidden: tuple[int, ...] = (64, 64)
    activation: Literal["tanh", "relu", "elu"] = "tanh"
    subtract_background: bool = False
    convolutions: tuple[tuple[int, int, int], ...] = PUBLISHED_CONVOLUTIONS
    cnn_features: int = 512
    learning_rate: float = positive(3e-4)
    gamma: float = within(0.99, 0, 1, "(]")
    observation_clip: float = positive(10.0)
    normalisation_frames: int = within(4_096, 0)
    initial_policy: str | None = None
    initial_std: float | None = positive(None)
    checkpoint_frames: int = positive(51_200)
    checkpoint_seconds: float = positive(120.0)
    keep_checkpoints: int = positive(3)
    metrics_frames: int = positive(2_048)
    torch_device: str = "cpu"
    torch_threads: int = positive(1)

    def __post_init__(self):
        """Validate; every message says what was given and what is allowed."""
        check_fields(self)
        require(bool(self.task), "task", self.task, "the name of a task")
        require(bool(self.observation), "observation", self.observation, "a name")
        for name in ("hidden", "convolutions"):
            require(bool(getattr(self, name)), name, (), "one layer or more")
        layers = self.convolutions
        fit = all(len(layer) == 3 and min(layer) > 0 for layer in layers)
        require(fit, "convolutions", layers, "positive (filters, kernel size, stride)")
        widths = (*self.hidden, self.cnn_features)
        require(min(widths) > 0, "hidden or cnn_features", widths, "positive")
        start = self.training_start
        require(
            start is None
            or (len(start) == 2 and 0 <= start[0] <= start[1] <= MOST_START_SHARE),
            "training_start",
            start,
            "two shares (low, high) with 0 <= low <= high <= "
            f"{MOST_START_SHARE:g}, or None",
        )
        try:
            json.dumps(self.task_kwargs, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"task_kwargs={self.task_kwargs!r} cannot be written to config.json "
                f"({error}); use finite numbers, strings, lists and dicts only."
            ) from error

    @property
    def training_kwargs(self) -> dict[str, Any]:
        """Options of the task while it is learnt."""
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
        """Number of frames between two calls of the learner's update."""
        raise NotImplementedError

    def replace(self, **changes: Any) -> "TrainingConfig":
        """A copy with some fields changed, validated again."""
        _require_fields(type(self), changes)
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """The config as JSON-able values, with the algorithm's name."""
        values = dataclasses.asdict(self)
        # Tuples become lists.
        return {"algorithm": self.algorithm, **json.loads(json.dumps(values))}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "TrainingConfig":
        """A config from its fields by name; ConfigError if one is not allowed."""
        _require_fields(cls, values)
        return cls(**values)

    def changed_for_resume(self, other: "TrainingConfig") -> dict[str, tuple]:
        """Fields (name: (here, other)) that differ and may not on resuming."""
        here, there = self.to_dict(), other.to_dict()
        return {
            name: (here.get(name), there.get(name))
            for name in sorted(set(here) | set(there))
            if name not in self.resumable and here.get(name) != there.get(name)
        }


def _require_fields(kind: type[TrainingConfig], names: Mapping[str, Any]) -> None:
    valid = [item.name for item in dataclasses.fields(kind)]
    unknown = sorted(set(names) - set(valid))
    if unknown:
        raise ConfigError(
            f"{kind.__name__} has no field {unknown}; valid fields are {valid}."
        )
