"""Proximal policy optimisation on TorchRL's ClipPPOLoss and GAE."""

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from cathsim_dmc.agents.configs import PPOConfig
from cathsim_dmc.agents.networks import (
    Signature,
    make_actor,
    make_critic,
    make_normaliser,
)
from cathsim_dmc.simulation.environments import VECTOR

_TERMS = ("loss_objective", "loss_critic", "loss_entropy")


class PPO:
    """The learner: a policy to collect with, and an update from what it collected.

    Attributes:
        policy: raw observation in, sampled action and its log-probability out.
        random_frames: frames to collect with uniformly random actions first (none).
    """

    metrics = (
        "loss_objective",
        "loss_critic",
        "entropy",
        "kl_approx",
        "clip_fraction",
        "grad_norm",
        "explained_variance",
        "learning_rate",
        "gradient_steps",
    )
    random_frames = 0

    def __init__(self, config: PPOConfig, signature: Signature):
        self.config = config
        self.device = torch.device(config.device)
        self.actor = make_actor(signature, config).to(self.device)
        self.critic = make_critic(signature, config).to(self.device)
        self.normaliser = None
        modules: list[nn.Module] = []
        if signature.vector:
            self.normaliser = make_normaliser(signature, config).to(self.device)
            modules.append(self.normaliser)
        self.policy = TensorDictSequential(*modules, self.actor)
        self.loss = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=config.clip,
            entropy_coeff=config.entropy_coefficient,
            critic_coeff=config.value_coefficient,
            loss_critic_type="l2",
            # Per minibatch, as in the published agents.
            normalize_advantage=True,
            log_explained_variance=False,
            # There is no second set of weights to swap in, which takes a tenth of a
            # gradient step.
            functional=False,
        )
        self.advantage = GAE(
            gamma=config.gamma, lmbda=config.gae_lambda, value_network=None
        )
        # A plain list: walking the loss module's parameters costs as much as a layer.
        self.parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimiser = torch.optim.Adam(
            self.parameters, lr=config.learning_rate, eps=1e-5, fused=True
        )
        self.loss_keys = [
            *signature.keys,
            "action",
            "action_log_prob",
            "advantage",
            "value_target",
        ]
        self.gradient_steps = 0

    def observe(self, batch: TensorDictBase) -> None:
        """Take observation statistics from a batch without learning from it."""
        if self.normaliser is not None:
            self.normaliser.module.update(batch[VECTOR].to(self.device))

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a batch (num_envs, steps) collected with the current policy.

        Args:
            batch: as the collector gives it.
            progress: share of the run that is done, in [0, 1].

        Returns:
            Means over the update's gradient steps of the quantities in `metrics`.
        """
        config = self.config
        if config.anneal:
            for group in self.optimiser.param_groups:
                group["lr"] = config.learning_rate * (1.0 - progress)
        batch = batch.to(self.device)
        explained = self._add_advantages(batch)
        frames = batch.select(*self.loss_keys).reshape(-1)
        sums: dict[str, torch.Tensor] = {}
        steps = 0
        for _ in range(config.epochs):
            # One gather per epoch; the minibatches are then views.
            shuffled = frames[torch.randperm(len(frames), device=self.device)]
            divergence = 0.0
            for minibatch in shuffled.split(config.minibatch_size):
                terms = self._step(minibatch)
                for name, value in terms.items():
                    sums[name] = sums.get(name, 0.0) + value
                divergence += terms["kl_approx"]
                steps += 1
            mean_kl = divergence * config.minibatch_size / len(frames)
            if config.target_kl is not None and float(mean_kl) > config.target_kl:
                break
        self.gradient_steps += steps
        # Only now: learning needs the statistics that the actions were chosen under.
        self.observe(batch)
        return {
            **{name: float(value) / steps for name, value in sums.items()},
            "explained_variance": explained,
            "learning_rate": self.optimiser.param_groups[0]["lr"],
            "gradient_steps": float(self.gradient_steps),
        }

    @torch.no_grad()
    def _add_advantages(self, batch: TensorDictBase) -> float:
        """Add advantage and value target; return the explained variance.

        A truncated episode continues in the value of its last observation, a
        terminated one is worth nothing afterwards: GAE reads both flags.
        """
        following = batch["next"]
        if self.normaliser is not None:
            self.normaliser(following)
        self.critic(batch)
        self.critic(following)
        self.advantage(batch)
        target = batch["value_target"]
        left = (target - batch["state_value"]).var()
        return float(1.0 - left / target.var().clamp_min(1e-12))

    def _step(self, minibatch: TensorDictBase) -> dict[str, torch.Tensor]:
        losses = self.loss(minibatch)
        loss = sum(losses[name] for name in _TERMS)
        self.optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
        self.optimiser.step()
        names = ("loss_objective", "loss_critic", "entropy", "kl_approx")
        terms = {name: losses[name].detach() for name in (*names, "clip_fraction")}
        return {**terms, "grad_norm": norm}

    def policy_state(self) -> dict[str, Any]:
        """Weights and statistics that acting needs."""
        return self.policy.state_dict()

    def learning_state(self) -> dict[str, Any]:
        """What learning needs beyond the policy."""
        return {
            "critic": self.critic.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "gradient_steps": self.gradient_steps,
        }

    def load(self, policy: dict[str, Any], learning: dict[str, Any]) -> None:
        """Restore what policy_state and learning_state gave."""
        self.policy.load_state_dict(policy)
        self.critic.load_state_dict(learning["critic"])
        self.optimiser.load_state_dict(learning["optimiser"])
        self.gradient_steps = learning["gradient_steps"]
