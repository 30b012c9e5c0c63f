"""DAgger: the expert says what to do in the states that the learner comes to.

Ross, Gordon and Bagnell, "A Reduction of Imitation Learning and Structured Prediction
to No-Regret Online Learning", AISTATS 2011.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.envs import EnvBase

from cathsim_dmc.agents.config import TrainingConfig, require
from cathsim_dmc.agents.demonstrations import EXPERT_ACTION
from cathsim_dmc.agents.imitation import Clone, decaying, make_clone
from cathsim_dmc.agents.networks import NetworkShapes
from cathsim_dmc.agents.replay import ReplayMemory
from cathsim_dmc.agents.views import view_of
from cathsim_dmc.policies import Teacher

_BEGUN = "step_count"  # control steps since an episode began


@dataclass(frozen=True, kw_only=True)
class DAggerConfig(TrainingConfig):
    """DAgger from the scripted expert.

    A round collects frames in which expert and learner take turns, adds them with the
    expert's actions to all frames before, and fits the policy to them again.

    Attributes:
        steps_per_env: Number of control steps of each environment in a round.
        expert_share: Share of the control steps that the expert acts in, as a factor
            from round to round; in the first round it acts alone.
        gradient_steps: Number of gradient steps in a round.
        batch_size: Number of states per gradient step.
        replay_frames: Largest number of states kept, the newest.
        replay_bytes: Largest size of their files in bytes; the smaller of the two
            limits rules.
    """

    algorithm: ClassVar[str] = "dagger"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "published": {},
        # What learns in a minute: points along the device, few and short episodes.
        "demo": {"observation": "tracking", "training_max_steps": 250},
    }

    steps_per_env: int = 128
    expert_share: float = 0.5
    gradient_steps: int = 2_000
    batch_size: int = 256
    replay_frames: int = 1_000_000
    replay_bytes: int = 2 * 1024**3
    total_frames: int = 20_480
    hidden: tuple[int, ...] = (128, 128)
    learning_rate: float = 1e-3
    normalisation_frames: int = 0
    training_max_steps: int | None = 300
    checkpoint_frames: int = 2_048

    def __post_init__(self):
        """Validate the algorithm's own fields after the shared ones."""
        super().__post_init__()
        self._require_positive(
            "steps_per_env", "gradient_steps", "batch_size", "replay_bytes"
        )
        share = self.expert_share
        require(0 <= share <= 1, "expert_share", share, "in [0, 1]")
        require(
            self.replay_frames >= self.frames_per_batch,
            "replay_frames",
            self.replay_frames,
            f"at least num_envs * steps_per_env={self.frames_per_batch}",
        )

    @property
    def frames_per_batch(self) -> int:
        """Frames of a round, over all environments."""
        return self.num_envs * self.steps_per_env


class _Guided(TensorDictModuleBase):
    """Expert and learner in turns; notes what the expert would do."""

    def __init__(self, policy: TensorDictSequential, env: EnvBase):
        super().__init__()
        self.policy, self.share = policy, 1.0
        self.in_keys = [*policy.in_keys, _BEGUN]
        self.out_keys = ["action", EXPERT_ACTION]
        self._view = view_of(env)
        self._teacher = Teacher(self._view)
        self._last = torch.zeros(self._view.num_simulations, self._view.num_actions)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add "action" and "expert_action" to the state of all simulations."""
        fresh = tensordict[_BEGUN].reshape(-1).cpu() == 0
        self._last[fresh] = 0.0
        self._teacher.reset(fresh.numpy())
        label = torch.as_tensor(self._teacher.act(self._last.double().numpy())).float()
        own = self.policy(tensordict.select(*self.policy.in_keys))["action"]
        guided = torch.rand(len(label), 1) < self.share
        action = torch.where(guided, label, own.cpu())
        self._last = action.clone()
        tensordict["action"] = action.to(own.device)
        tensordict[EXPERT_ACTION] = label.to(own.device)
        return tensordict


class DAgger:
    """The learner: a clone, fitted to all states that were visited.

    Attributes:
        shapes: Sizes of what the policy reads, and of the action.
        policy: Raw observation in, action out: that of the expert or the learner.
        random_frames: Number of frames to collect with uniformly random actions
            first (none).
    """

    metrics: ClassVar[tuple[str, ...]] = (
        "loss",
        "deviation",
        "expert_share",
        "replay_frames",
        "gradient_steps",
    )
    random_frames = 0

    def __init__(self, config: DAggerConfig, shapes: NetworkShapes, directory: Path):
        self.config, self.shapes = config, shapes
        self.device = torch.device(config.torch_device)
        self.clone = Clone(config, shapes)
        self.policy: TensorDictModuleBase = self.clone.policy
        self._keys = [*shapes.raw_keys, EXPERT_ACTION]
        self.replay = ReplayMemory(
            directory / "replay",
            self._keys,
            config.replay_frames,
            config.replay_bytes,
        )
        self.rounds = 0

    @staticmethod
    def make_policy(
        shapes: NetworkShapes, config: DAggerConfig
    ) -> TensorDictSequential:
        """A policy with fresh weights: raw observation in, action out."""
        return make_clone(shapes, config)

    def attach(self, env: EnvBase) -> None:
        """Take the simulations of the environment, for the expert to look at."""
        self.policy = _Guided(self.clone.policy, env)
        self._set_share()

    def _set_share(self) -> None:
        if isinstance(self.policy, _Guided):
            self.policy.share = self.config.expert_share**self.rounds

    def observe(self, batch: TensorDictBase) -> None:
        """Take no statistics: they are those of the states in the rounds."""

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Add a round's states (num_envs, steps) and fit to all.

        Args:
            batch: Steps as the collector gives them.
            progress: Share of the run that is done; not used.

        Returns:
            The figures in `metrics`.
        """
        config = self.config
        share = config.expert_share**self.rounds
        self.replay.extend(batch.select(*self._keys).reshape(-1))
        self.clone.observe(batch)
        rates = decaying(config.learning_rate, 0.0, config.gradient_steps)
        figures = self.clone.fit(self.replay.sample, config.batch_size, rates)
        self.rounds += 1
        self._set_share()
        return {
            **figures,
            "expert_share": share,
            "replay_frames": float(len(self.replay)),
            "gradient_steps": float(self.rounds * config.gradient_steps),
        }

    def policy_state(self) -> dict[str, Any]:
        """Weights and statistics that acting without the expert needs."""
        return self.clone.policy.state_dict()

    def learning_state(self) -> dict[str, Any]:
        """What learning needs beyond the policy and the files of the states."""
        return {
            "clone": self.clone.learning_state(),
            "replay": self.replay.state(),
            "rounds": self.rounds,
        }

    def load(self, policy: dict[str, Any], learning: dict[str, Any]) -> None:
        """Restore what policy_state and learning_state gave."""
        self.clone.load(policy, learning["clone"])
        if "replay" in learning:
            self.replay.load(learning["replay"])
        self.rounds = learning["rounds"]
        self._set_share()
