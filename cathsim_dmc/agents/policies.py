"""Policies of every kind behind one face: by name, from a checkpoint, a function."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cathsim_dmc.agents import learners, pretrained
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.agents.config import TrainingConfig
from cathsim_dmc.agents.networks import NetworkShapes
from cathsim_dmc.policies import POLICIES, Policy, make_policy
from cathsim_dmc.simulation import environments

# Gets the standard observations (N, ...), returns the actions (N, A) or the TensorDict
# with "action" in it.
PolicyFunction = Callable[[TensorDictBase], TensorDictBase | torch.Tensor]
PolicyLike = str | Path | Checkpoint | Policy | PolicyFunction


class FunctionPolicy(Policy):
    """A function of the standard observations.

    A function with randomness of its own, such as a network, acts deterministically:
    with the middle of its distribution.
    """

    def __init__(self, function: PolicyFunction, name: str | None = None):
        """Wraps a function.

        Args:
            function: Function from the observations (N, ...) to the actions (N, A) or
                to the TensorDict with "action" in it.
            name: Name for reports; by default the function's.
        """
        self._function = function
        default = getattr(function, "__name__", type(function).__name__)
        self.name = name or default

    @torch.no_grad()
    def act(self, observation: Any) -> np.ndarray:
        """Actions (N, A) float32."""
        if not isinstance(observation, TensorDictBase):
            observation = _tensors(observation)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            answer = self._function(observation)
        action = answer if isinstance(answer, torch.Tensor) else answer["action"]
        return action.to(torch.float32).numpy()


class NetworkPolicy(FunctionPolicy):
    """A trained policy, with frozen observation statistics.

    Attributes:
        network: Raw observation in, action out.
        config: Settings of its training.
        shapes: Sizes of its observation and action.
    """

    def __init__(
        self,
        name: str,
        state: Mapping[str, Any],
        shapes: NetworkShapes,
        config: TrainingConfig,
    ):
        """Builds the network.

        Args:
            name: Name for reports.
            state: Weights and statistics, as `checkpoint.require_fit` allows them.
            shapes: Sizes of observation and action.
            config: Settings of the training.
        """
        network = learners.make_policy(shapes, config)
        network.load_state_dict(dict(state))
        super().__init__(network.eval().requires_grad_(False), name)
        self.network, self.config, self.shapes = network, config, shapes
        self.task = config.task
        self.observation = config.observation
        self.task_kwargs = config.task_kwargs


class TrainedPolicy(NetworkPolicy):
    """The policy of a checkpoint."""

    def __init__(self, checkpoint: Checkpoint):
        """Loads the weights.

        Args:
            checkpoint: Checkpoint of a run.

        Raises:
            CheckpointError: its weights cannot be used.
        """
        config = checkpoint.config
        name = f"{config.algorithm} {checkpoint.path.name}"
        super().__init__(name, checkpoint.policy_state(), checkpoint.shapes, config)
        self.checkpoint = checkpoint


class PretrainedPolicy(NetworkPolicy):
    """The policy of a file, such as those that ship.

    Attributes:
        card: What it was trained for and what it reached, see `pretrained.read_card`.
    """

    def __init__(self, weights: str | Path):
        """Loads the weights.

        Args:
            weights: Path of the `.safetensors` file; the card lies beside it.

        Raises:
            CheckpointError: there is none, or it is damaged.
        """
        self.card, state, shapes, config = pretrained.read_pretrained(weights)
        name = f"{pretrained.PREFIX}{self.card['name']}"
        super().__init__(name, state, shapes, config)
        self.task = self.card["task"]
        self.task_kwargs = self.card["task_kwargs"]


def load_policy(policy: PolicyLike, seed: int = 0) -> Policy:
    """A policy from whatever names one.

    Args:
        policy: Name in `POLICIES`, "pretrained:NAME", file of a pretrained policy,
            directory of a run or of a checkpoint, Checkpoint, policy, or function as
            for `FunctionPolicy`.
        seed: Seed of a named policy's own randomness.

    Raises:
        CheckpointError: it is none of these, or damaged.
    """
    if isinstance(policy, Policy):
        return policy
    if isinstance(policy, Checkpoint):
        return TrainedPolicy(policy)
    if isinstance(policy, str | Path):
        if str(policy) in POLICIES:
            return make_policy(str(policy), seed)
        if str(policy).startswith(pretrained.PREFIX):
            policy = pretrained.pretrained_path(str(policy))
        if Path(policy).suffix == pretrained.SUFFIX:
            return PretrainedPolicy(policy)
        return TrainedPolicy(Checkpoint.open(policy))
    return FunctionPolicy(policy)


def _tensors(observation: Mapping[str, np.ndarray]) -> TensorDict:
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
