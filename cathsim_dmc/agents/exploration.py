"""Exploration noise that is correlated in time and between motors.

White noise at 25 Hz on twenty motors averages out along the tip and over time, so the
head hardly leaves its path. Noise that is correlated in time, and shared by the motors
that bend about one axis, moves the head into other branches. Each action stays normally
distributed about the policy's mean, and the learner computes its log-probability as if
the noise were white (Hollenstein et al., Colored Noise in PPO, AAAI 2024).
"""

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal

# Actions stay off their bounds, where the log-probability is infinite.
_LARGEST = 1.0 - 1e-6


class CorrelatedNoise:
    """Standard normal noise (num_envs, actions), correlated in time."""

    def __init__(self, correlation: float, shared: float, groups: Sequence[int]):
        """Starts without a previous step.

        Args:
            correlation: Correlation between two consecutive steps, in [0, 1).
            shared: Share of the variance that actions of one group have in common.
            groups: (actions,), group of each action, counted from 0.
        """
        self._correlation, self._shared = correlation, shared
        self._groups = torch.as_tensor(groups)
        self._count = int(self._groups.max()) + 1
        self._noise: torch.Tensor | None = None

    def draw(self, like: torch.Tensor) -> torch.Tensor:
        """Return the noise of the next step, with the shape and dtype of a tensor."""
        fresh = torch.randn_like(like)
        if self._shared:
            common = torch.randn((*like.shape[:-1], self._count), dtype=like.dtype)
            fresh = (
                math.sqrt(1.0 - self._shared) * fresh
                + math.sqrt(self._shared) * common[..., self._groups]
            )
        if self._noise is None or self._noise.shape != like.shape:
            self._noise = fresh
        else:
            rest = math.sqrt(1.0 - self._correlation**2)
            self._noise = self._correlation * self._noise + rest * fresh
        return self._noise


class CorrelatedExploration(TensorDictModuleBase):
    """A Gaussian policy that draws its actions with correlated noise."""

    def __init__(self, policy: TensorDictSequential, noise: CorrelatedNoise):
        """Takes a policy whose actor writes "loc" and "scale" before the tanh."""
        super().__init__()
        self.policy = policy
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self._noise = noise

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add "action" and "action_log_prob", as the policy does."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            tensordict = self.policy(tensordict)
        mean, deviation = tensordict["loc"], tensordict["scale"]
        noise = self._noise.draw(mean.cpu()).to(mean.device)
        action = torch.tanh(mean + deviation * noise).clamp(-_LARGEST, _LARGEST)
        tensordict["action"] = action
        log_prob = TanhNormal(mean, deviation).log_prob(action)
        tensordict["action_log_prob"] = log_prob
        return tensordict
