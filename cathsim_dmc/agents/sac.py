"""Soft actor-critic on TorchRL's SACLoss and SoftUpdate."""

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.objectives import SACLoss, SoftUpdate

from cathsim_dmc.agents.configs import SACConfig
from cathsim_dmc.agents.networks import (
    Signature,
    make_actor,
    make_normaliser,
    make_q_function,
)
from cathsim_dmc.agents.replay import ReplayMemory
from cathsim_dmc.simulation.environments import VECTOR

_TERMS = ("loss_actor", "loss_qvalue", "loss_alpha")


class SAC:
    """The learner: a policy to collect with, and updates from a replay memory.

    The replay keeps raw observations; they are normalised with today's statistics
    when sampled, so old and new transitions agree.

    Attributes:
        policy: raw observation in, sampled action out.
        random_frames: frames to collect with uniformly random actions first.
    """

    metrics = (
        "loss_actor",
        "loss_qvalue",
        "loss_alpha",
        "alpha",
        "entropy",
        "replay_frames",
        "gradient_steps",
    )

    def __init__(self, config: SACConfig, signature: Signature, directory: Path):
        self.config = config
        self.device = torch.device(config.device)
        self.random_frames = config.random_frames
        self.actor = make_actor(signature, config).to(self.device)
        q_function = make_q_function(signature, config).to(self.device)
        self.normaliser = None
        modules: list[nn.Module] = []
        if signature.vector:
            self.normaliser = make_normaliser(signature, config).to(self.device)
            modules.append(self.normaliser)
        self.policy = TensorDictSequential(*modules, self.actor)
        target = config.target_entropy
        self.loss = SACLoss(
            self.actor,
            q_function,
            num_qvalue_nets=2,
            loss_function="l2",
            alpha_init=config.initial_alpha,
            target_entropy=-float(signature.actions) if target is None else target,
        )
        self.loss.make_value_estimator(gamma=config.gamma)
        self.targets = SoftUpdate(self.loss, tau=config.tau)
        self.optimiser = torch.optim.Adam(
            [p for p in self.loss.parameters() if p.requires_grad],
            lr=config.learning_rate,
            fused=True,
        )
        self.replay = ReplayMemory(
            directory / "replay", config.replay_frames, config.replay_bytes
        )
        keys = [*signature.raw_keys, "reward", "done", "terminated"]
        self.replay_keys = [
            *signature.raw_keys,
            "action",
            *[("next", key) for key in keys],
        ]
        self.gradient_steps = 0
        self.owed_steps = 0.0

    def observe(self, batch: TensorDictBase) -> None:
        """Take observation statistics from a batch without learning from it."""
        if self.normaliser is not None:
            self.normaliser.module.update(batch[VECTOR].to(self.device))

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Store a batch (num_envs, steps) and take the gradient steps it pays for.

        Args:
            batch: as the collector gives it.
            progress: share of the run that is done; not used.

        Returns:
            Means over the gradient steps of the quantities in `metrics`.
        """
        transitions = batch.select(*self.replay_keys).reshape(-1)
        self.replay.extend(transitions)
        self.observe(batch)
        sums: dict[str, torch.Tensor] = {}
        steps = 0
        if len(self.replay) >= min(self.random_frames, self.replay.capacity):
            self.owed_steps += len(transitions) * self.config.updates_per_frame
            steps = int(self.owed_steps)
            self.owed_steps -= steps
        for _ in range(steps):
            for name, value in self._step().items():
                sums[name] = sums.get(name, 0.0) + value
        self.gradient_steps += steps
        return {
            **{name: float(value) / steps for name, value in sums.items()},
            "replay_frames": float(len(self.replay)),
            "gradient_steps": float(self.gradient_steps),
        }

    def _step(self) -> dict[str, torch.Tensor]:
        sample = self.replay.sample(self.config.batch_size).to(self.device)
        if self.normaliser is not None:
            self.normaliser(sample)
            self.normaliser(sample["next"])
        losses = self.loss(sample)
        # Each term has gradients for its own parameters only, so one sum serves.
        loss = sum(losses[name] for name in _TERMS)
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        self.targets.step()
        return {name: losses[name].detach() for name in (*_TERMS, "alpha", "entropy")}

    def policy_state(self) -> dict[str, Any]:
        """Weights and statistics that acting needs."""
        return self.policy.state_dict()

    def learning_state(self) -> dict[str, Any]:
        """What learning needs beyond the policy and the replay files."""
        loss = {
            name: value
            for name, value in self.loss.state_dict().items()
            if isinstance(value, torch.Tensor)
        }
        return {
            "loss": loss,
            "optimiser": self.optimiser.state_dict(),
            "replay": self.replay.state(),
            "gradient_steps": self.gradient_steps,
            "owed_steps": self.owed_steps,
        }

    def load(self, policy: dict[str, Any], learning: dict[str, Any]) -> None:
        """Restore what policy_state and learning_state gave."""
        self.policy.load_state_dict(policy)
        state = self.loss.state_dict()
        for name, value in learning["loss"].items():
            state[name] = value
        self.loss.load_state_dict(state)
        self.optimiser.load_state_dict(learning["optimiser"])
        self.replay.load(learning["replay"])
        self.gradient_steps = learning["gradient_steps"]
        self.owed_steps = learning["owed_steps"]
