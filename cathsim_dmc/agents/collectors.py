"""Where the frames of a training come from: a new place is a line in `COLLECTORS`."""

import functools
import importlib.util
import math
from collections.abc import Callable
from typing import Protocol

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import device
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType
from typing_extensions import override

from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.evaluation import EnvFactory
from cathsim_dmc.agents.learner import Learner
from cathsim_dmc.agents.learners import LEARNERS


class BatchSource(Protocol):
    """Batches of steps, collected with the learner's policy as it is.

    Attributes:
        restarts: How many times all episodes began anew, since collectors were lost.
    """

    restarts: int

    def next(self) -> TensorDictBase:
        """The next batch (num_envs, steps)."""
        ...

    def shutdown(self) -> None:
        """Close the environments."""


# Of every collector.
OPTIONS = {
    "exploration_type": ExplorationType.RANDOM,
    "trust_policy": True,
    "track_traj_ids": False,
    "auto_register_policy_transforms": False,
}


class LocalSource(BatchSource):
    """One collector in this process, with the environment that is given."""

    restarts = 0

    def __init__(
        self,
        config: TrainingConfig,
        learner: Learner,
        env: EnvBase,
        make_env: EnvFactory,
        frames: int,
    ):
        del make_env  # The environment is there already.
        self._collector = Collector(
            env,
            _on_cpu(learner.policy, learner.device),
            frames_per_batch=config.frames_per_batch,
            init_random_frames=random_frames(config, learner, frames) or None,
            total_frames=-1,
            **OPTIONS,
        )
        self._batches = iter(self._collector)

    @override
    def next(self) -> TensorDictBase:
        return next(self._batches)

    @override
    def shutdown(self) -> None:
        self._collector.shutdown()


def _ray_source(
    config: TrainingConfig,
    learner: Learner,
    env: EnvBase,
    make_env: EnvFactory,
    frames: int,
) -> BatchSource:
    # Imported late: Ray is an extra, and slow to import.
    from cathsim_dmc.agents.ray_source import RaySource

    left = functools.partial(random_frames, config, learner)
    return RaySource(config, learner, env, make_env, frames, left, OPTIONS)


# Settings, learner, environment of this process, function that makes others, number of
# frames of earlier processes of the run.
SourceFactory = Callable[
    [TrainingConfig, Learner, EnvBase, EnvFactory, int], BatchSource
]
COLLECTORS: dict[str, SourceFactory] = {"local": LocalSource, "ray": _ray_source}


def check_collector(config: TrainingConfig) -> None:
    """Refuse a collector that cannot do what the settings ask for.

    Raises:
        ConfigError: it cannot; the message says what can.
    """
    if config.collector == "local":
        return
    if not LEARNERS[config.algorithm].learner.remote:
        raise ConfigError(
            f"collector={config.collector!r} cannot collect for {config.algorithm}, "
            "whose expert looks at the simulations of this process: choose "
            "collector='local'."
        )
    if config.num_envs % config.collectors:
        raise ConfigError(
            f"num_envs={config.num_envs} is not a multiple of "
            f"collectors={config.collectors}: every collector has as many."
        )
    if importlib.util.find_spec("ray") is None:
        raise ConfigError(
            "collector='ray' needs the extra: pip install 'cathsim-dmc[ray]'."
        )


def random_frames(config: TrainingConfig, learner: Learner, frames: int) -> int:
    """Frames still to be collected at random, in whole batches."""
    left = max(learner.random_frames - frames, 0)
    return math.ceil(left / config.frames_per_batch) * config.frames_per_batch


def _on_cpu(
    policy: TensorDictModuleBase, device: device
) -> Callable[[TensorDictBase], TensorDictBase]:
    """A policy that takes and gives CPU tensors wherever its weights are."""
    if device.type == "cpu":
        return policy

    def act(observation: TensorDictBase) -> TensorDictBase:
        outside = observation.select(*policy.in_keys).to(device)
        return observation.update(policy(outside).to("cpu"))

    return act
