"""TorchRL environments of the tasks, with observations for networks."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl import envs
from torchrl.data import Bounded, Composite, Unbounded

from cathsim_dmc import bounds

# All numeric entries of an observation, concatenated in the order of their names.
# Not called "state": TorchRL gives that name a meaning of its own.
VECTOR = "observation_vector"
# Images, channels first, uint8.
PIXELS = "pixels"
# Function with the arguments of `make_env`.
EnvFactory = Callable[..., envs.EnvBase]


def make_env(
    task: str,
    *,
    observation: str | Sequence[str] = "internal",
    num_envs: int = 1,
    num_threads: int | None = None,
    seed: int | Sequence[int] = 0,
    task_kwargs: Mapping[str, Any] | None = None,
    device: str = "cpu",
) -> envs.EnvBase:
    """Makes a seeded environment of batch size [num_envs] with standard observations.

    Args:
        num_envs: Number of simulations; simulation i draws from seed + i.
        num_threads: Number of threads of the batched simulation, None for one per
            core.
        seed: Seed of each simulation, or of the first.
        device: Device of the simulation, see `torchrl.BatchedEnv`.

    Returns:
        An environment with "observation_vector" (num_envs, n) float32 and/or
        "pixels" (num_envs, c, h, w) uint8, and "step_count" (num_envs, 1) int64, the
        control steps since the episode began.

    Raises:
        ValueError: the task or one of its options is unknown.
    """
    # Imported late: importing this module must not load MuJoCo.
    from cathsim_dmc.simulation.torchrl import BatchedEnv

    options: Any = {"observation": observation, "task_kwargs": task_kwargs}
    options |= {"seed": seed, "device": device}
    env = BatchedEnv(task, num_envs, num_threads=num_threads, **options)
    return standard_observations(env)


def require_factory(make_env: Any) -> None:
    """ValueError unless `make_env` is a function; environments are callable, too."""
    if isinstance(make_env, envs.EnvBase) or not callable(make_env):
        bounds.refuse("make_env", make_env, "a function, as agents.make_env is")


def record_errors(env: envs.EnvBase, folder: str | Path) -> None:
    """Makes the simulations of an environment write physics errors to a folder.

    It does nothing for environments of other packages.
    """
    base = getattr(env, "base_env", env)
    if hasattr(base, "record_errors"):
        base.record_errors(folder)


def standard(
    entries: Mapping[str, torch.Tensor], batch_dims: int
) -> dict[str, torch.Tensor]:
    """Converts an observation to inputs of a network, VECTOR and/or PIXELS.

    Args:
        entries: Entries by name, in any order: numbers (*batch, ...) are flattened,
            images (*batch, h, w, c) uint8 get their channels first. Both are
            concatenated in the order of their names.
        batch_dims: Number of batch axes.

    Raises:
        ValueError: if images differ in size.
    """
    named = [entries[name] for name in sorted(entries)]
    images = [one.movedim(-1, -3) for one in named if one.dtype == torch.uint8]
    numbers = [one for one in named if one.dtype != torch.uint8]
    seen = {}
    if numbers:
        seen[VECTOR] = torch.cat([n.flatten(batch_dims).float() for n in numbers], -1)
    if images:
        if len({one.shape[-2:] for one in images}) > 1:
            sizes = (
                f"{name} {entries[name].shape[-2]} x {entries[name].shape[-3]}"
                for name in sorted(entries)
                if entries[name].dtype == torch.uint8
            )
            raise ValueError(
                f"images of different sizes are no observation of a network: "
                f"{', '.join(sizes)} pixels; give the options of the task that set "
                "them, such as fluoroscopy size and endoluminal_size, one size"
            )
        seen[PIXELS] = torch.cat(images, -3)
    return seen


def as_batch(observation: TensorDictBase | Mapping[str, Any]) -> TensorDictBase:
    """Converts what `policies.Policy.act` gets to a standard observation.

    Args:
        observation: Standard observation of N simulations, which is returned, or
            arrays by name of one composer environment, without the axis N.

    Returns:
        VECTOR and/or PIXELS, see `standard`, with batch size [N] or [1].
    """
    if isinstance(observation, TensorDictBase):
        return observation
    entries = {k: torch.as_tensor(one)[None] for k, one in observation.items()}
    return TensorDict(standard(entries, 1), batch_size=[1])


class StandardObservation(envs.Transform):
    """Replaces the entries of an environment's observation by those of `standard`."""

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        entries = {key: next_tensordict.get(key) for key in self.in_keys}
        seen = standard(entries, next_tensordict.batch_dims)
        return next_tensordict.exclude(*self.in_keys, inplace=True).update(seen)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declares VECTOR and PIXELS."""
        zeros = {key: observation_spec[key].zero() for key in self.in_keys}
        for key in self.in_keys:
            del observation_spec[key]
        for key, value in standard(zeros, len(observation_spec.shape)).items():
            observation_spec[key] = (
                Bounded(0, 255, value.shape, dtype=torch.uint8)
                if key == PIXELS
                else Unbounded(value.shape)
            )
        return observation_spec


def standard_observations(env: envs.EnvBase) -> envs.TransformedEnv:
    """Wraps an environment so that it observes VECTOR and/or PIXELS, see `standard`.

    It counts the steps of an episode in "step_count", too.

    Nested entries (forces and other information) are not part of the observation and do
    not change; double precision becomes single.
    """
    spec, batch = env.observation_spec, len(env.batch_size)
    keys = [name for name, leaf in spec.items() if not isinstance(leaf, Composite)]
    seen = standard({key: spec[key].zero() for key in keys}, batch)
    observe = StandardObservation(in_keys=keys, out_keys=list(seen))
    steps = envs.DoubleToFloat(), observe, envs.StepCounter()
    return envs.TransformedEnv(env, envs.Compose(*steps))
