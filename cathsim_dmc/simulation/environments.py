"""TorchRL environments of the tasks, with observations as the networks take them."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torchrl.data import Composite
from torchrl.envs import (
    CatTensors,
    Compose,
    DoubleToFloat,
    EnvBase,
    FlattenObservation,
    PermuteTransform,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

from cathsim_dmc import bounds
from cathsim_dmc.simulation.composer import composer_env

# All numeric entries of an observation, concatenated in the order of their names.
# Not called "state": TorchRL gives that name a meaning of its own.
VECTOR = "observation_vector"
# Images, channels first, uint8.
PIXELS = "pixels"


def make_env(
    task: str,
    *,
    observation: str | Sequence[str] = "internal",
    num_envs: int = 1,
    num_threads: int | None = None,
    seed: int = 0,
    backend: str = "batched",
    task_kwargs: Mapping[str, Any] | None = None,
) -> EnvBase:
    """A seeded environment of batch size [num_envs] whose observations are standard.

    Args:
        task: Name of a registered task.
        observation: Name or names of the task's observations.
        num_envs: Number of simulations; simulation i draws from seed + i.
        num_threads: Number of threads of the batched simulation, None for one per
            core.
        seed: Seed of the first simulation.
        backend: Way of simulating: "batched" (mujoco.batch, all side by side) or
            "composer" (dm_control environments, one after the other).
        task_kwargs: Further options of the task.

    Returns:
        An environment with "observation_vector" (num_envs, n) float32 and/or
        "pixels" (num_envs, c, h, w) uint8.

    Raises:
        ValueError: the backend, the task or one of its options is unknown.
    """
    kwargs = bounds.options("task_kwargs", task_kwargs)
    if backend == "batched":
        # Imported late: importing this module must not load MuJoCo.
        from cathsim_dmc.simulation.torchrl import BatchedEnv

        env = BatchedEnv(
            task,
            num_envs,
            num_threads=num_threads,
            seed=seed,
            observation=observation,
            task_kwargs=kwargs,
        )
    elif backend == "composer":
        kwargs["observation"] = observation
        # Each factory seeds its own: SerialEnv.set_seed would hash the seeds apart.
        env = SerialEnv(
            num_envs,
            [partial(composer_env, task, kwargs, seed + i) for i in range(num_envs)],
        )
    else:
        raise ValueError(
            f"backend={backend!r} is unknown; choose 'batched' or 'composer'."
        )
    return standard_observations(env)


def composer_of(env: EnvBase) -> Any:
    """The composer environment under one environment of the backend "composer"."""
    return env.base_env._env


def standard_observations(env: EnvBase) -> TransformedEnv:
    """Append the transforms from an environment's entries to VECTOR and PIXELS.

    Floating-point entries at the top level of the observation are cast to float32,
    flattened and concatenated in the order of their names; so are bytes of shape
    (..., h, w, c), channels first. Nested entries (forces and other information) are
    no part of the observation and stay as they are.
    """
    spec = env.observation_spec
    batch = len(env.batch_size)
    leaves = {
        name: spec[name]
        for name in sorted(spec.keys())
        if not isinstance(spec[name], Composite)
    }
    vectors = [name for name, leaf in leaves.items() if leaf.dtype.is_floating_point]
    images = [
        name
        for name, leaf in leaves.items()
        if leaf.dtype == torch.uint8 and leaf.ndim - batch == 3
    ]
    if not vectors and not images:
        raise ValueError(
            f"the environment offers neither numbers nor images to observe; its "
            f"entries are {sorted(map(str, spec.keys(True, True)))}."
        )
    transforms = Compose(DoubleToFloat())
    for name in vectors:
        if leaves[name].ndim - batch > 1:
            first = batch - leaves[name].ndim
            transforms.append(FlattenObservation(first, -1, in_keys=[name]))
    if vectors:
        transforms.append(CatTensors(vectors, out_key=VECTOR, del_keys=True))
    if images:
        transforms.append(PermuteTransform((-1, -3, -2), in_keys=images))
        transforms.append(CatTensors(images, dim=-3, out_key=PIXELS, del_keys=True))
    transforms.append(StepCounter())
    return TransformedEnv(env, transforms)
