"""Collectors on the machines of a Ray cluster, by TorchRL's RayCollector."""

import contextlib
import copy
import functools
import logging
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase

from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.evaluation import EnvFactory
from cathsim_dmc.agents.learner import Learner

# So many losses in a row without a batch end the process; the run can be resumed.
MOST_LOSSES = 3


class RaySource:
    """Collectors in processes of a cluster; lost ones are replaced.

    Each has its share of the simulations and a copy of the policy, and gets the
    learner's weights and observation statistics before every batch. When one is lost,
    all begin anew with fresh episodes, since half a batch is none.

    Attributes:
        restarts: How many times all episodes began anew.
    """

    def __init__(
        self,
        config: TrainingConfig,
        learner: Learner,
        env: EnvBase,
        make_env: EnvFactory,
        frames: int,
        random_frames: Callable[[int], int],
        options: Mapping[str, Any],
    ):
        """Starts the collectors and closes `env`, which was only looked at.

        Args:
            config, learner, env, make_env, frames: As for every source; the workers
                must be able to import `make_env`.
            random_frames: Frames still to be collected at random, after so many.
            options: Options of TorchRL's collectors.

        Raises:
            ConfigError: the cluster has too few processors.
        """
        self.restarts = 0
        self._config, self._learner = config, learner
        self._make_env, self._frames = make_env, frames
        self._random_frames, self._options = random_frames, options
        env.close()
        _start_ray()
        self._start()

    def next(self) -> TensorDictBase:
        """The next batch (num_envs, steps).

        Raises:
            RuntimeError: collectors were lost several times without a batch between.
        """
        from ray.exceptions import RayError

        last: Exception | None = None
        for _ in range(MOST_LOSSES):
            try:
                weights = TensorDict.from_module(self._learner.policy).data.to("cpu")
                self._collector.update_policy_weights_(weights)
                batch = next(self._batches)
            # A process that dies while it is given weights breaks the connection.
            except (RayError, RuntimeError) as error:
                last = error
                self._replace(error)
                continue
            self._frames += batch.numel()
            # Collectors, environments, steps.
            return batch.flatten(0, 1)
        raise RuntimeError(
            f"the collectors were lost {MOST_LOSSES} times in a row without a batch; "
            "the run can be resumed from its last checkpoint"
        ) from last

    def shutdown(self) -> None:
        """End the collectors, and Ray if it was started here."""
        with contextlib.suppress(Exception):
            self._collector.shutdown()

    def _start(self) -> None:
        config, count = self._config, self._config.collectors
        threads = config.num_threads or 1
        _require_room(count, threads)
        policy = copy.deepcopy(self._learner.policy).to("cpu").requires_grad_(False)
        of_each = dict(self._options)
        shared = {n: of_each.pop(n) for n in ("exploration_type", "trust_policy")}
        self._collector = RayCollector(
            [self._worker(index, threads) for index in range(count)],
            policy,
            frames_per_batch=config.frames_per_batch,
            total_frames=sys.maxsize,
            init_random_frames=self._random_frames(self._frames),
            sync=True,
            collector_kwargs=[dict(of_each) for _ in range(count)],
            remote_configs={"num_cpus": threads},
            **shared,
        )
        self._batches = iter(self._collector)

    def _worker(self, index: int, threads: int) -> functools.partial[EnvBase]:
        """Function that makes the environment of one collector."""
        config, share = self._config, self._config.num_envs // self._config.collectors
        # Of their own: every process begins with the same state of torch's generator.
        drawn = np.random.SeedSequence(
            [config.seed, self._frames, self.restarts]
        ).generate_state(1 + config.collectors)
        return functools.partial(
            _make_worker_env,
            self._make_env,
            int(drawn[1 + index]),
            config.torch_threads,
            config.task,
            observation=config.collected_observation,
            num_envs=share,
            num_threads=threads,
            seed=(int(drawn[0]) + index * share) % 2**31,
            task_kwargs=config.training_kwargs,
        )

    def _replace(self, error: Exception) -> None:
        line = (str(error).strip().splitlines() or [type(error).__name__])[0]
        logging.getLogger(__name__).warning(
            "a collector was lost after %d frames (%s); all begin anew",
            self._frames,
            line,
        )
        self.shutdown()
        self.restarts += 1
        self._start()


def _make_worker_env(
    make_env: EnvFactory, torch_seed: int, threads: int, *args: Any, **kwargs: Any
) -> EnvBase:
    """The environment of a collector, made in its process."""
    torch.manual_seed(torch_seed)
    torch.set_num_threads(threads)
    return make_env(*args, **kwargs)


def _start_ray() -> None:
    """Connect to the cluster of this machine or of RAY_ADDRESS, or start one here."""
    import ray

    if ray.is_initialized():
        return
    # Ray sends statistics of its use to its makers otherwise.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # What the workers print lies in Ray's own logs.
    ray.init(
        include_dashboard=False, logging_level=logging.WARNING, log_to_driver=False
    )


def _require_room(count: int, threads: int) -> None:
    """Refuse what would wait for processors for ever.

    Raises:
        ConfigError: the cluster has too few processors in all.
    """
    import ray

    processors = ray.cluster_resources().get("CPU", 0.0)
    if processors < count * threads:
        raise ConfigError(
            f"collectors={count} with num_threads={threads} need {count * threads} "
            f"processors, the Ray cluster has {processors:g}: ask for fewer, or add "
            "machines."
        )
