"""Proximal policy optimisation on TorchRL's ClipPPOLoss and GAE."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, cast

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from typing_extensions import override

from cathsim_dmc.agents.config import (
    TUNED_IMAGES,
    TUNED_TRAINING,
    ActorCriticConfig,
    ConfigError,
    positive,
    require,
    within,
)
from cathsim_dmc.agents.exploration import CorrelatedExploration, CorrelatedNoise
from cathsim_dmc.agents.learner import Learner, means
from cathsim_dmc.agents.networks import (
    NetworkShapes,
    make_critic,
    network_of,
    orthogonal_,
)

# Larger minibatches and fewer passes: about a tenth of the published cost of learning
# per frame.
_LARGE_BATCHES: Mapping[str, Any] = {
    "num_envs": 32, "steps_per_update": 2_048, "minibatch_size": 256, "epochs": 10,
    "clip": 0.2, "target_kl": 0.05,
}  # fmt: skip
# Exploration noise that bends the whole tip for a while (docs/training.md).
_TUNED: Mapping[str, Any] = {
    **_LARGE_BATCHES, **TUNED_TRAINING, "hidden": (128, 128), "initial_deviation": 0.7,
    "noise_correlation": 0.9, "noise_shared": 0.8, "total_frames": 300_000,
}  # fmt: skip
_TERMS = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction")


@dataclass(frozen=True, kw_only=True)
class PPOConfig(ActorCriticConfig):
    """PPO with the settings of the published agents.

    `steps_per_update` counts frames over all environments together. That keeps the
    published ratio of learning to experience (320 minibatch steps per 512 frames)
    for any number of environments; with the default 16 of them an update sees 32
    consecutive steps of each, beyond the horizon of the advantage estimate
    (1 / (1 - gamma * gae_lambda) = 17 steps).

    Attributes:
        steps_per_update: Number of frames per update, over all environments.
        minibatch_size: Number of frames per gradient step.
        epochs: Number of passes over the batch per update.
        gae_lambda: Decay factor of the generalised advantage estimate.
        clip: Clipping range of the probability ratio.
        entropy_coefficient: Weight of the entropy bonus in the loss.
        value_coefficient: Weight of the squared value error in the loss.
        max_grad_norm: Largest joint gradient norm of both networks.
        target_kl: Approximate KL divergence from the collecting policy beyond which
            an update's epochs stop; None never stops.
        initial_deviation: Standard deviation of the exploration of a new policy, before
            the tanh.
        noise_correlation: Correlation of the exploration noise between two control
            steps; 0 for white noise.
        noise_shared: Fraction of the variance of the exploration noise that is common
            to the motors of one bending axis; 0 for independent motors.
    """

    algorithm: ClassVar[str] = "ppo"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "published": {},
        "demo": {**_LARGE_BATCHES, "anneal": True},
        "tuned": _TUNED,
        "tuned_image": {**_TUNED, **TUNED_IMAGES},
    }

    steps_per_update: int = positive(512)
    minibatch_size: int = positive(32)
    epochs: int = positive(20)
    gae_lambda: float = within(0.95, low=0, high=1)
    clip: float = positive(0.1, high=0.999)
    entropy_coefficient: float = within(5.85e-4, low=0)
    value_coefficient: float = within(0.872, low=0)
    max_grad_norm: float = positive(1.0)
    target_kl: float | None = positive(None)
    initial_deviation: float = positive(1.0)
    noise_correlation: float = within(0.0, low=0, high=0.999)
    noise_shared: float = within(0.0, low=0, high=0.999)

    def __post_init__(self):
        """Validate the algorithm's own fields after the shared ones."""
        super().__post_init__()
        allowed = f"a divisor of steps_per_update={self.steps_per_update}"
        for name in ("num_envs", "minibatch_size"):
            value = getattr(self, name)
            # A smaller last minibatch would weigh its frames more than the others.
            require(self.steps_per_update % value == 0, name, value, allowed)
        require(self.minibatch_size > 1, "minibatch_size", self.minibatch_size, "> 1")

    @property
    def frames_per_batch(self) -> int:
        """Frames per update, over all environments."""
        return self.steps_per_update


class PPO(Learner):
    """Updates from whole batches, collected with the present policy."""

    metrics: ClassVar[tuple[str, ...]] = (
        *_TERMS, "grad_norm", "explained_variance", "learning_rate", "gradient_steps",
    )  # fmt: skip

    def __init__(self, config: PPOConfig, shapes: NetworkShapes, directory: Path):
        own, critic_shapes = shapes.split(config)
        super().__init__(config, own, directory, critic_shapes)
        self.actor, network = self.network[-1], network_of(self.network)
        # A small head starts the policy near the middle of every action's range.
        orthogonal_(network, network.mean, 0.01)
        log_std = cast(nn.Parameter, network.log_std)
        nn.init.constant_(log_std, math.log(config.initial_deviation))
        self.critic = make_critic(critic_shapes or own, config).to(self.device)
        orthogonal_(self.critic, self.critic.module.value, 1.0)
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
            # PPO has no second set of weights; swapping weights in takes a tenth of a
            # gradient step.
            functional=False,
        )
        self.losses = self.compiled(self.loss)
        self.advantage = GAE(
            gamma=config.gamma, lmbda=config.gae_lambda, value_network=None
        )
        self.optimiser = torch.optim.Adam(
            [*self.actor.parameters(), *self.critic.parameters()],
            lr=config.learning_rate,
            eps=1e-5,
            fused=True,
        )
        critic_keys = critic_shapes.keys if critic_shapes else []
        self.loss_keys = [*own.keys, *critic_keys, "action", "action_log_prob"]
        self.loss_keys += ["advantage", "value_target"]

    @override
    def attach(self, env: EnvBase) -> None:
        # White noise too: the log-probability by the policy alone is that of an action
        # before it is rounded at a bound; the loss takes that of the rounded one.
        config = self.config
        groups = getattr(getattr(env, "base_env", env), "action_groups", None)
        if groups is None:
            if config.noise_shared:
                raise ConfigError(
                    f"noise_shared={config.noise_shared!r} needs an environment that "
                    "tells which motors bend together: choose noise_shared=0."
                )
            groups = range(env.action_spec.shape[-1])
        noise = CorrelatedNoise(config.noise_correlation, config.noise_shared, groups)
        self.policy = CorrelatedExploration(self.network, noise)

    @override
    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        config = self.config
        self.anneal(progress)
        batch = batch.to(self.device)
        explained = self._add_advantages(batch)
        frames = batch.select(*self.loss_keys).reshape(-1)
        kept: list[dict[str, torch.Tensor]] = []
        for _ in range(config.epochs):
            # One gather per epoch; the minibatches are then views.
            shuffled = frames[torch.randperm(len(frames), device=self.device)]
            last = [self._step(one) for one in shuffled.split(config.minibatch_size)]
            kept += last
            limit = config.target_kl
            if limit is not None and means(last)["kl_approx"] > limit:
                break
        # After learning, which needs the statistics used when the actions were chosen.
        self.observe(batch)
        return {
            **means(kept),
            "explained_variance": explained,
            "learning_rate": self.optimiser.param_groups[0]["lr"],
            "gradient_steps": float(self.gradient_steps),
        }

    @torch.no_grad()
    def _add_advantages(self, batch: TensorDictBase) -> float:
        """Add advantage and value target; return the explained variance.

        GAE continues a truncated episode with the value of its last observation, and a
        terminated one with 0.
        """
        for states in (batch, batch["next"]):
            self.normalise(states, critic_only=True)
            self.critic(states)
        self.advantage(batch)
        target = batch["value_target"]
        left = (target - batch["state_value"]).var()
        return float(1.0 - left / target.var().clamp_min(1e-12))

    def _step(self, minibatch: TensorDictBase) -> dict[str, torch.Tensor]:
        losses = self.losses(minibatch)
        loss = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
        norm = self.descend(loss, self.config.max_grad_norm)
        return {**{name: losses[name].detach() for name in _TERMS}, "grad_norm": norm}

    @override
    def learning_state(self) -> dict[str, Any]:
        return {**super().learning_state(), "critic": self.critic.state_dict()}

    @override
    def load(self, policy: dict[str, Any], learning: dict[str, Any]) -> None:
        super().load(policy, learning)
        self.critic.load_state_dict(learning["critic"])
