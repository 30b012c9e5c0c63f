"""Collectors on the machines of a Ray cluster, by TorchRL's RayCollector."""

import copy
import functools
import importlib
import logging
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import ray
import torch
from ray.exceptions import ActorUnavailableError, RayError, RayTaskError
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase

from cathsim_dmc import cluster, files
from cathsim_dmc.agents.config import ConfigError, TrainingConfig
from cathsim_dmc.agents.learner import Learner

# Losses of a collector in a row, without a batch, that end the process; the run can be
# resumed.
MOST_LOSSES = 3
# Longest wait until the cluster knows whether an unresponsive machine is lost, s.
_PATIENCE = 90.0


class _Collector(Collector):
    def __bool__(self) -> bool:
        # Ray evaluates the truth of a failed actor; an endless collector has no len.
        return True


class RaySource:
    """Batches of collectors in processes of a cluster; lost collectors are replaced.

    Each collector has its share of the simulations and a copy of the policy, and gets
    the learner's weights and observation statistics before every batch. When one is
    lost, the others keep their parts of the batch and their episodes. A new collector
    replaces it, begins new episodes and collects its part.
    """

    def __init__(
        self,
        config: TrainingConfig,
        learner: Learner,
        make_env: Callable[..., EnvBase],
        frames: int,
        random_frames: Callable[[int], int],
        options: Mapping[str, Any],
    ):
        """Starts the collectors.

        Args:
            make_env: As for `evaluation.evaluate`; the workers must be able to import
                it.
            frames: Number of frames that earlier processes of the run have collected.
            random_frames: Function from the number of frames so far to the number that
                is still to be collected with random actions.
            options: Options of each collector.

        Raises:
            ConfigError: the cluster has too few processors.
        """
        self._config, self._learner, self._make_env = config, learner, make_env
        self._frames, self._random_frames, self._losses = frames, random_frames, 0
        self._threads = config.num_threads or 1
        cluster.connect()
        text = f"collectors={config.collectors} with num_threads={self._threads}"
        with files.refused(ConfigError, text, ValueError):
            cluster.require_room(config.collectors, self._threads)
        policy = copy.deepcopy(learner.policy).to("cpu").requires_grad_(False)
        shared = {name: options[name] for name in ("exploration_type", "trust_policy")}
        own = {name: value for name, value in options.items() if name not in shared}
        self._policy = policy
        with files.refused(RuntimeError, "a collector cannot begin", RayError):
            self._collector = RayCollector(
                [self._factory(number) for number in range(config.collectors)],
                policy,
                frames_per_batch=config.frames_per_batch,
                total_frames=sys.maxsize,
                init_random_frames=random_frames(frames),
                sync=True,
                collector_class=_Collector,
                collector_kwargs=[dict(own) for _ in range(config.collectors)],
                remote_configs=_placed(self._threads),
                # Weights are sent with each request of a batch: a sync scheme connects
                # a fixed set of collectors, so none could be replaced.
                weight_sync_schemes={},
                **shared,
            )

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yield batches (num_envs, steps), with the rows in the order of collectors.

        Raises:
            RuntimeError: a collector was lost several times without a batch.
        """
        while True:
            yield self._batch()

    def shutdown(self, timeout: float | None = None) -> None:
        """End the collectors; the cluster stays."""
        self._collector.shutdown(timeout)

    def _batch(self) -> TensorDictBase:
        weights = ray.put(TensorDict.from_module(self._learner.policy).data.to("cpu"))
        parts: dict[int, TensorDictBase] = {}
        for _ in range(MOST_LOSSES):
            missing = [n for n in range(self._config.collectors) if n not in parts]
            actors = self._collector.remote_collectors
            asked = [
                (
                    actors[n].update_policy_weights_.remote(weights),
                    actors[n].next.remote(),
                )
                for n in missing
            ]
            lost = {}
            for number, request in zip(missing, asked, strict=True):
                try:
                    _, parts[number] = ray.get(list(request))
                except RayTaskError as error:
                    raise cluster.cause_of(error) from error
                except RayError as error:
                    if getattr(error, "actor_init_failed", False):
                        text = f"collector {number} cannot begin: {_line(error)}"
                        raise RuntimeError(text) from error
                    lost[number] = error
            if not lost:
                break
            self._replace(lost)
        else:
            raise RuntimeError(
                f"collectors {sorted(lost)} were lost {MOST_LOSSES} times in a row "
                f"without a batch ({_line(lost.popitem()[1])}); the run can be resumed "
                "from its last checkpoint (resume=True, --resume)"
            )
        self._frames += self._config.frames_per_batch
        return torch.cat([parts[number] for number in sorted(parts)])

    def _replace(self, lost: Mapping[int, Exception]) -> None:
        """Replace lost collectors by new ones."""
        actors, logger = self._collector.remote_collectors, logging.getLogger(__name__)
        for number in lost:
            _await_certainty(actors[number])
            ray.kill(actors[number])
        self._losses += 1
        fits = cluster.room(self._threads) >= self._config.collectors
        for number, error in lost.items():
            logger.warning(
                "collector %d was lost after %d frames (%s); another one begins new "
                "episodes in its place%s",
                number, self._frames, _line(error),
                "" if fits else " and shares processors: the cluster has too few left",
            )  # fmt: skip
            left = self._random_frames(self._frames) // self._config.collectors
            own = {
                **self._collector.collector_kwargs[number],
                "init_random_frames": left,
            }
            place = _placed(self._threads if fits else 0)
            self._collector.add_collectors(
                [self._factory(number)], 1, self._policy, [own], [place]
            )
            actors[number] = actors.pop()

    def _factory(self, number: int) -> Callable[[], EnvBase]:
        """Return a function that makes the environment of one collector."""
        config, count = self._config, self._config.collectors
        share = config.num_envs // count
        # Own seeds: every process starts with the same state of torch's generator.
        place = [config.seed, self._frames, self._losses]
        seed, *drawn = np.random.SeedSequence(place).generate_state(1 + count)
        # Only modules that the user has imported here.
        modules = [name for name in config.modules or () if name in sys.modules]
        return functools.partial(
            _make_worker_env,
            self._make_env,
            int(drawn[number]),
            config.torch_threads,
            modules,
            config.task,
            observation=config.collected_observation,
            num_envs=share,
            num_threads=self._threads,
            seed=(int(seed) + number * share) % 2**31,
            task_kwargs=config.training_kwargs,
        )


def _make_worker_env(
    make_env: Callable[..., EnvBase],
    torch_seed: int,
    torch_threads: int,
    modules: list[str],
    task: str,
    **options: Any,
) -> EnvBase:
    """Make the environment of a collector, in its process."""
    for name in modules:
        importlib.import_module(name)
    torch.manual_seed(torch_seed)
    torch.set_num_threads(torch_threads)
    return make_env(task, **options)


def _placed(processors: int) -> dict[str, Any]:
    """Return Ray's options for running a collector."""
    return {"num_cpus": processors, "scheduling_strategy": "SPREAD"}


def _await_certainty(actor: Any) -> None:
    """Wait until the cluster knows whether an unresponsive process has ended."""
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        try:
            ray.get(actor.__ray_ready__.remote(), timeout=_PATIENCE)
            return
        except ActorUnavailableError:
            time.sleep(0.5)
        except RayError:
            return


def _line(error: Exception) -> str:
    """Return the last line of an error of the cluster, the most informative one."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[-1].strip()[:300]
