"""DAgger: the expert labels the states that the learner reaches.

Ross, Gordon and Bagnell, "A Reduction of Imitation Learning and Structured Prediction
to No-Regret Online Learning", AISTATS 2011.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from typing_extensions import override

from cathsim_dmc.agents.config import positive, require, within
from cathsim_dmc.agents.demonstrations import EXPERT_ACTION
from cathsim_dmc.agents.imitation import CloningConfig, CloningLearner, decaying
from cathsim_dmc.agents.networks import NetworkShapes
from cathsim_dmc.agents.replay import ReplayMemory
from cathsim_dmc.policies import Teacher, View

_BEGUN = "step_count"  # control steps since an episode began


@dataclass(frozen=True, kw_only=True)
class DAggerConfig(CloningConfig):
    """DAgger from the scripted expert.

    A round collects frames in which expert and learner alternate, adds them with the
    expert's actions to all frames before, and fits the policy to them again.

    Attributes:
        steps_per_env: Number of control steps of each environment in a round.
        expert_share: Factor by which the fraction of control steps in which the expert
            acts falls from round to round; it is 1 in the first round.
        gradient_steps: Number of gradient steps in a round.
        withdrawal_weight: Largest weight in the loss of states in which the expert
            withdraws a device, where the others have 1; together they weigh at most as
            much as the others.
        expert_lead: Distance by which the expert keeps a guidewire ahead of the
            catheter around it, m; negative if the catheter leads.
        replay_frames: Largest number of states kept, the newest.
        replay_bytes: Largest size of their files in bytes; the smaller of the two
            limits applies.
    """

    algorithm: ClassVar[str] = "dagger"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "published": {},
        # Learns in a minute: points along the device, few and short episodes.
        "demo": {"observation": "tracking", "training_max_steps": 250},
    }

    steps_per_env: int = positive(128)
    expert_share: float = within(0.5, low=0, high=1)
    gradient_steps: int = positive(2_000)
    withdrawal_weight: float = within(20.0, low=1, high=1_000)
    expert_lead: float = within(0.02, low=-0.1, high=0.1)
    replay_frames: int = 1_000_000
    replay_bytes: int = positive(2 * 1024**3)
    total_frames: int = 20_480
    checkpoint_frames: int = 2_048

    def __post_init__(self):
        """Validate the algorithm's own fields after the shared ones."""
        super().__post_init__()
        least, most = self.frames_per_batch, self.replay_frames
        allowed = f"at least num_envs * steps_per_env={least}"
        require(most >= least, "replay_frames", most, allowed)


class _Guided(TensorDictModuleBase):
    """Acts with expert or learner at random; records the expert's action."""

    def __init__(self, learner: "DAgger", view: View):
        super().__init__()
        self.learner, self.policy = learner, learner.network
        self.in_keys = [*self.policy.in_keys, _BEGUN]
        self.out_keys = ["action", EXPERT_ACTION]
        self._teacher = Teacher(view, learner.config.expert_lead)
        self._last = torch.zeros(view.num_simulations, view.num_actions)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add "action" and "expert_action" to the state of all simulations."""
        fresh = tensordict[_BEGUN].reshape(-1).cpu() == 0
        self._last[fresh] = 0.0
        self._teacher.reset(fresh.numpy())
        label = torch.as_tensor(self._teacher.act(self._last.double().numpy())).float()
        own = self.policy(tensordict.select(*self.policy.in_keys))["action"]
        guided = torch.rand(len(label), 1) < self.learner.share
        action = torch.where(guided, label, own.cpu())
        self._last = action.clone()
        tensordict["action"] = action.to(own.device)
        tensordict[EXPERT_ACTION] = label.to(own.device)
        return tensordict


class DAgger(CloningLearner):
    """Fits a policy to all states that expert and learner have visited."""

    metrics: ClassVar[tuple[str, ...]] = (
        "loss", "deviation", "expert_share", "replay_frames", "gradient_steps",
    )  # fmt: skip
    remote: ClassVar[bool] = False

    def __init__(self, config: DAggerConfig, shapes: NetworkShapes, directory: Path):
        super().__init__(config, shapes, directory)
        self._keys = [*shapes.raw_keys, EXPERT_ACTION]
        self.replay = ReplayMemory.of(config, directory, self._keys)

    @override
    def attach(self, env: EnvBase) -> None:
        view = View(env.base_env.simulation)
        self.policy = _Guided(self, view)
        self._translations = list(view.task.scene.catheter.translations)

    @override
    def _weights(self, target: torch.Tensor) -> torch.Tensor:
        """Weights (n, 1): withdrawals weigh more, since they are rare but necessary."""
        withdrawn = (target[:, self._translations] < 0.0).any(1, keepdim=True)
        share = withdrawn.float().mean().clamp(1e-6, 1.0)
        weight = ((1.0 - share) / share).clamp(1.0, self.config.withdrawal_weight)
        return torch.where(withdrawn, weight, torch.ones_like(weight))

    @property
    def share(self) -> float:
        """Fraction of the control steps of this round in which the expert acts."""
        rounds = self.gradient_steps // self.config.gradient_steps
        return self.config.expert_share**rounds

    @override
    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        config, share = self.config, self.share
        self.replay.extend(batch.select(*self._keys).reshape(-1))
        self.observe(batch)
        rates = decaying(config.learning_rate, 0.0, config.gradient_steps)
        figures = self.fit(self.replay.sample, rates)
        return {
            **figures,
            "expert_share": share,
            "replay_frames": float(len(self.replay)),
            "gradient_steps": float(self.gradient_steps),
        }
