"""Policies for dm_control environments: timestep in, action out."""

from collections.abc import Callable

import dm_env
import numpy as np
import torch
from dm_control import composer
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.simulation import environments

TimestepPolicy = Callable[[dm_env.TimeStep], np.ndarray]


def trained(checkpoint: Checkpoint) -> TimestepPolicy:
    """The trained policy, acting deterministically with frozen statistics."""
    network = checkpoint.policy()

    @torch.no_grad()
    def act(timestep: dm_env.TimeStep) -> np.ndarray:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return network(_tensors(timestep.observation))["action"][0].double().numpy()

    return act


def _tensors(observation: dict[str, np.ndarray]) -> TensorDict:
    """One observation as `environments.standard_observations` arranges it."""
    vectors, images = [], []
    for _, value in sorted(observation.items()):
        if value.dtype == np.uint8:
            images.append(torch.as_tensor(value).movedim(-1, 0))
        else:
            vectors.append(torch.as_tensor(np.ravel(value)).float())
    entries = {}
    if vectors:
        entries[environments.VECTOR] = torch.cat(vectors)[None]
    if images:
        entries[environments.PIXELS] = torch.cat(images)[None]
    return TensorDict(entries, batch_size=[1])


def random(environment: composer.Environment, seed: int) -> TimestepPolicy:
    """Uniform actions from a generator of its own."""
    generator = np.random.default_rng(seed)
    shape = environment.action_spec().shape
    return lambda timestep: generator.uniform(-1, 1, shape)


def push(environment: composer.Environment) -> TimestepPolicy:
    """Full push, tip motors at rest."""
    action = np.zeros(environment.action_spec().shape)
    action[len(environment.task.scene.catheter.tip_motors)] = 1.0
    return lambda timestep: action
