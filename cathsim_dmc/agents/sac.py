"""Soft actor-critic on TorchRL's SACLoss and SoftUpdate."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torchrl.objectives import SACLoss, SoftUpdate
from typing_extensions import override

from cathsim_dmc.agents.config import (
    TUNED_IMAGES,
    TUNED_TRAINING,
    ActorCriticConfig,
    TrainingConfig,
    positive,
    require,
)
from cathsim_dmc.agents.demonstrations import alike, load_transitions
from cathsim_dmc.agents.learner import Learner, means
from cathsim_dmc.agents.networks import NetworkShapes, make_critic
from cathsim_dmc.agents.replay import ReplayMemory

# 2 GiB hold about 270,000 transitions of the internal observation.
REPLAY_BYTES = 2 * 1024**3

# The weight of the entropy must start near the size of a step's reward (0.05): at 0.1
# and above the actions stay random for tens of thousands of frames. An overestimated
# value of standing still decays in 1 / (tau * (1 - gamma)) gradient steps: 5,000, and
# 1,000 with images.
_TUNED: Mapping[str, Any] = {
    **TUNED_TRAINING, "updates_per_frame": 0.25, "hidden": (256, 256),
    "activation": "relu", "initial_alpha": 1e-3, "tau": 0.02, "total_frames": 40_000,
}  # fmt: skip
_TERMS = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy")


@dataclass(frozen=True, kw_only=True)
class SACConfig(ActorCriticConfig):
    """SAC with twin critics and a learned entropy weight.

    Attributes:
        batch_size: Number of transitions per gradient step.
        tau: Coefficient of the soft update of the target critics.
        replay_frames: Largest number of transitions kept.
        replay_bytes: Largest size of the replay files in bytes; the smaller of the two
            limits applies.
        random_frames: Number of frames at the start with uniformly random actions
            and no learning.
        steps_per_env: Number of control steps of each environment between two
            updates.
        updates_per_frame: Number of gradient steps per frame collected.
        initial_alpha: Weight of the entropy at the start.
        demonstrations: Directory of a dataset that `cathsim demos` has written, from
            which half of every minibatch is drawn (Ball et al. 2023, "Efficient online
            reinforcement learning with offline data"); None for no dataset.
        target_entropy: Entropy that the weight is steered towards, in nats; None
            means minus the number of actions.
    """

    algorithm: ClassVar[str] = "sac"
    state_dependent_std: ClassVar[bool] = True
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "published": {},
        "demo": {"num_envs": 32, "updates_per_frame": 0.25},
        "tuned": _TUNED,
        "tuned_image": {**_TUNED, **TUNED_IMAGES, "batch_size": 128, "gamma": 0.95},
    }

    batch_size: int = positive(256)
    tau: float = positive(0.005, high=1)
    replay_frames: int = positive(600_000)
    replay_bytes: int = positive(REPLAY_BYTES)
    random_frames: int = 5_000
    steps_per_env: int = positive(4)
    updates_per_frame: float = positive(1.0)
    initial_alpha: float = positive(1.0)
    target_entropy: float | None = None
    demonstrations: str | None = None

    def __post_init__(self):
        """Validate the algorithm's own fields after the shared ones."""
        super().__post_init__()
        first, most = self.random_frames, self.replay_frames
        least = f"at least batch_size={self.batch_size}"
        require(first >= self.batch_size, "random_frames", first, least)
        least += f" and num_envs * steps_per_env={self.frames_per_batch}"
        fits = most >= max(self.batch_size, self.frames_per_batch)
        require(fits, "replay_frames", most, least)

    def changed_for_resume(self, other: TrainingConfig) -> dict[str, tuple]:
        """Return fields that must not change; the path of the dataset may."""
        changed = super().changed_for_resume(other)
        paths = self.demonstrations, vars(other).get("demonstrations")
        if None in paths and paths[0] != paths[1]:
            changed["demonstrations"] = paths
        return changed


class SAC(Learner):
    """Updates from a replay memory.

    The replay keeps raw observations; they are normalised with the present statistics
    when sampled, so old and new transitions agree.
    """

    metrics: ClassVar[tuple[str, ...]] = (
        *_TERMS, "replay_frames", "gradient_steps", "learning_rate",
    )  # fmt: skip

    def __init__(self, config: SACConfig, shapes: NetworkShapes, directory: Path):
        own, critic_shapes = shapes.split(config)
        super().__init__(config, own, directory, critic_shapes)
        self.random_frames = config.random_frames
        self.actor = self.network[-1]
        critic = make_critic(critic_shapes or own, config, own.actions)
        target = config.target_entropy
        self.loss = SACLoss(
            self.actor,
            critic.to(self.device),
            num_qvalue_nets=2,
            loss_function="l2",
            alpha_init=config.initial_alpha,
            target_entropy=-float(shapes.actions) if target is None else target,
        )
        self.loss.make_value_estimator(gamma=config.gamma)
        self.losses = self.compiled(self.loss)
        self.targets = SoftUpdate(self.loss, tau=config.tau)
        self.optimiser = torch.optim.Adam(
            [p for p in self.loss.parameters() if p.requires_grad],
            lr=config.learning_rate,
            fused=True,
        )
        after = [*shapes.raw_keys, "reward", "done", "terminated"]
        self.replay_keys = [*shapes.raw_keys, "action", *[("next", k) for k in after]]
        self.replay = ReplayMemory.of(config, directory, self.replay_keys)
        self.demonstrations: TensorDictBase | None = None
        if config.demonstrations is not None:
            shown = load_transitions(
                config.demonstrations,
                config.collected_observation,
                shapes,
                **alike(config.task, config.task_kwargs),
                reward=config.training_kwargs.get("reward"),
            )
            self.demonstrations = shown.select(*self.replay_keys)
            self.observe(shown)
        self.owed_steps = 0.0

    @override
    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        self.anneal(progress)
        transitions = batch.select(*self.replay_keys).reshape(-1)
        self.replay.extend(transitions)
        self.observe(batch)
        if len(self.replay) >= min(self.random_frames, self.replay.capacity):
            self.owed_steps += len(transitions) * self.config.updates_per_frame
        steps = int(self.owed_steps)
        self.owed_steps -= steps
        return {
            **means([self._step() for _ in range(steps)]),
            "replay_frames": float(len(self.replay)),
            "gradient_steps": float(self.gradient_steps),
            "learning_rate": self.optimiser.param_groups[0]["lr"],
        }

    def _step(self) -> dict[str, torch.Tensor]:
        sample = self._sample(self.config.batch_size).to(self.device)
        self.normalise(sample)
        self.normalise(sample["next"])
        losses = self.losses(sample)
        # Each term has gradients for its own parameters only, so one sum serves.
        loss = losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]
        self.descend(loss)
        self.targets.step()
        return {name: losses[name].detach() for name in _TERMS}

    def _sample(self, count: int) -> TensorDictBase:
        """Draw transitions (count,), half of them demonstrations if there are any."""
        shown = self.demonstrations
        if shown is None:
            return self.replay.sample(count)
        half = count // 2
        chosen = shown[torch.randint(len(shown), (half,))]
        return torch.cat([chosen, self.replay.sample(count - half)])

    @override
    def learning_state(self) -> dict[str, Any]:
        loss = self.loss.state_dict().items()
        loss = {name: value for name, value in loss if isinstance(value, torch.Tensor)}
        own = {"loss": loss, "owed_steps": self.owed_steps}
        return {**super().learning_state(), **own}

    @override
    def load(self, policy: dict[str, Any], learning: dict[str, Any]) -> None:
        super().load(policy, learning)
        self.loss.load_state_dict({**self.loss.state_dict(), **learning["loss"]})
        self.owed_steps = learning["owed_steps"]
