"""Evaluation: fixed seeds, each episode counted once, intervals beside every mean."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from cathsim_dmc import files
from cathsim_dmc.agents.checkpoint import Checkpoint
from cathsim_dmc.agents.episodes import EpisodeOutcome, EpisodeTracker
from cathsim_dmc.agents.training import EnvFactory
from cathsim_dmc.analysis.force_statistics import wilson_interval
from cathsim_dmc.simulation import environments

Policy = Callable[[TensorDictBase], TensorDictBase | torch.Tensor]
# Called after every step with the environment and which episodes (n,) bool still run.
Observer = Callable[[EnvBase, np.ndarray], None]

BOOTSTRAP_SAMPLES = 10_000

_REPORTED = (
    "reward",
    "length",
    "mean_force",
    "max_force",
    "peak_force",
    "path_ratio",
)


@dataclass(frozen=True)
class EvaluationResult:
    """Episodes of one policy on one task.

    Attributes:
        task: name of the task.
        policy: what was evaluated.
        seed: of the first episode; episode i was played with seed + i.
        episodes: in the order of their seeds.
        settings: observation, task_kwargs and, for a checkpoint, its frames.
    """

    task: str
    policy: str
    seed: int
    episodes: tuple[EpisodeOutcome, ...]
    settings: Mapping[str, Any]

    def values(self, name: str) -> np.ndarray:
        """An outcome of every episode, float64 (episodes,); NaN where unknown."""
        return np.array([getattr(e, name) for e in self.episodes], dtype=np.float64)

    def mean_sd(self, name: str) -> tuple[float | None, float | None]:
        """Mean and sample standard deviation over the episodes; None if unknown."""
        values = self.values(name)
        values = values[~np.isnan(values)]
        if not len(values):
            return None, None
        deviation = float(values.std(ddof=1)) if len(values) > 1 else 0.0
        return float(values.mean()), deviation

    @property
    def successes(self) -> int | None:
        """Episodes that reached the goal; None where the task does not tell."""
        known = [e.success for e in self.episodes if e.success is not None]
        return sum(known) if len(known) == len(self.episodes) else None

    def summary(self) -> dict[str, Any]:
        """Means with deviations and the success rate with its interval."""
        result: dict[str, Any] = {"episodes": len(self.episodes)}
        for name in _REPORTED:
            result[name], result[f"{name}_sd"] = self.mean_sd(name)
        result["physics_errors"] = sum(e.physics_error for e in self.episodes)
        successes = self.successes
        rate = interval = None
        if successes is not None:
            rate = successes / len(self.episodes)
            interval = list(wilson_interval(successes, len(self.episodes)))
        result["success"] = rate
        result["success_ci95"] = interval
        return result

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: identity, summary and every episode."""
        return {
            "task": self.task,
            "policy": self.policy,
            "seed": self.seed,
            "settings": dict(self.settings),
            "summary": self.summary(),
            "episodes": [
                {"seed": self.seed + index, **asdict(episode)}
                for index, episode in enumerate(self.episodes)
            ],
        }


@dataclass(frozen=True)
class Comparison:
    """How much better one policy is than another on the same seeds.

    Attributes:
        policy: the one in question.
        baseline: the other.
        reward_difference: mean over seeds of the difference of episode rewards.
        reward_ci95: its bootstrap interval, resampling seeds.
        success_difference: difference of the success rates; None if unknown.
        success_ci95: its bootstrap interval; None if unknown.
        better: whether the reward interval lies above zero.
    """

    policy: str
    baseline: str
    reward_difference: float
    reward_ci95: tuple[float, float]
    success_difference: float | None
    success_ci95: tuple[float, float] | None
    better: bool

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values."""
        return asdict(self)


def paired_bootstrap(
    first: np.ndarray, second: np.ndarray, seed: int = 0
) -> tuple[float, tuple[float, float]]:
    """Mean of first - second over pairs (n,), with its 95 % percentile interval."""
    difference = np.asarray(first, np.float64) - np.asarray(second, np.float64)
    draws = np.random.default_rng(seed).integers(
        len(difference), size=(BOOTSTRAP_SAMPLES, len(difference))
    )
    low, high = np.quantile(difference[draws].mean(1), (0.025, 0.975))
    return float(difference.mean()), (float(low), float(high))


def compare(policy: EvaluationResult, baseline: EvaluationResult) -> Comparison:
    """Compare two evaluations of the same task on the same seeds.

    Raises:
        ValueError: they are of different tasks or seeds.
    """
    here = (policy.task, policy.seed, len(policy.episodes))
    there = (baseline.task, baseline.seed, len(baseline.episodes))
    if here != there:
        raise ValueError(
            f"only evaluations of the same (task, seed, episodes) can be compared: "
            f"given are {here} and {there}."
        )
    reward, reward_ci = paired_bootstrap(
        policy.values("reward"), baseline.values("reward")
    )
    success = success_ci = None
    if policy.successes is not None and baseline.successes is not None:
        success, success_ci = paired_bootstrap(
            policy.values("success"), baseline.values("success")
        )
    return Comparison(
        policy=policy.policy,
        baseline=baseline.policy,
        reward_difference=reward,
        reward_ci95=reward_ci,
        success_difference=success,
        success_ci95=success_ci,
        better=reward_ci[0] > 0,
    )


def random_policy(num_actions: int, seed: int = 0) -> Policy:
    """Uniform actions in [-1, 1] from a generator of its own."""
    generator = torch.Generator().manual_seed(seed)

    def random(observation: TensorDictBase) -> torch.Tensor:
        shape = (*observation.batch_size, num_actions)
        return 2.0 * torch.rand(shape, generator=generator) - 1.0

    return random


def evaluate(
    policy: str | Path | Checkpoint | Policy,
    task: str | None = None,
    episodes: int = 30,
    seed: int = 1_000_000,
    *,
    name: str | None = None,
    observation: str | Sequence[str] | None = None,
    task_kwargs: Mapping[str, Any] | None = None,
    backend: str = "batched",
    num_threads: int | None = None,
    out_dir: str | Path | None = None,
    observer: Observer | None = None,
    make_env: EnvFactory = environments.make_env,
) -> EvaluationResult:
    """Play episodes with a policy, each with a seed of its own, all side by side.

    A trained policy acts deterministically (the middle of its distribution) with
    frozen observation statistics. Each environment plays one episode; what it does
    while others finish is not counted.

    Args:
        policy: a run's or checkpoint's directory, a Checkpoint, "random", or a
            callable that gets the observations (episodes,) and returns the actions
            or the tensordict with "action" in it. "step_count" tells such a callable
            where each episode stands.
        task: the task; for a checkpoint, None takes the one it was trained on.
        episodes: how many.
        seed: of the first episode. The default lies apart from training seeds.
        name: of the policy, for the reports.
        observation: as for task.
        task_kwargs: as for task.
        backend: "batched" or "composer".
        num_threads: of the batched simulation.
        out_dir: write evaluation.json there.
        observer: called after every step, before any environment is reset.
        make_env: see `environments.make_env`.

    Raises:
        ValueError: no task is known, or episodes < 1.
        CheckpointError: there is no such checkpoint.
    """
    if episodes < 1:
        raise ValueError(f"episodes={episodes}: at least one is needed.")
    checkpoint = None
    if isinstance(policy, Checkpoint):
        checkpoint = policy
    elif isinstance(policy, str | Path) and str(policy) != "random":
        checkpoint = Checkpoint.open(policy)
    if checkpoint is not None:
        config = checkpoint.config
        task = config.task if task is None else task
        observation = config.observation if observation is None else observation
        task_kwargs = config.task_kwargs if task_kwargs is None else task_kwargs
    if task is None:
        raise ValueError("task=None: a policy that is no checkpoint needs a task.")
    settings = {
        "observation": observation or "internal",
        "task_kwargs": dict(task_kwargs or {}),
        "backend": backend,
        "frames": checkpoint.frames if checkpoint else None,
    }
    env = make_env(
        task,
        observation=settings["observation"],
        num_envs=episodes,
        num_threads=num_threads,
        seed=seed,
        backend=backend,
        task_kwargs=settings["task_kwargs"],
    )
    if checkpoint is not None:
        act: Policy = checkpoint.policy()
        name = name or f"{checkpoint.config.algorithm} {checkpoint.path.name}"
    elif isinstance(policy, str | Path):
        act = random_policy(env.action_spec.shape[-1], seed)
        name = name or "random"
    else:
        act = policy
        name = name or getattr(policy, "__name__", type(policy).__name__)
    try:
        outcomes = _first_episodes(env, act, observer)
    finally:
        env.close()
    result = EvaluationResult(task, name, seed, outcomes, settings)
    if out_dir is not None:
        write_evaluation(out_dir, result.to_dict())
    return result


@torch.no_grad()
def _first_episodes(
    env: EnvBase, act: Policy, observer: Observer | None
) -> tuple[EpisodeOutcome, ...]:
    (count,) = env.batch_size
    tracker = EpisodeTracker(count)
    outcomes: dict[int, EpisodeOutcome] = {}
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        current = env.reset()
        while len(outcomes) < count:
            answer = act(current)
            action = answer if isinstance(answer, torch.Tensor) else answer["action"]
            current["action"] = action.to(torch.float32)
            stepped = env.step(current)
            if observer is not None:
                running = np.array([index not in outcomes for index in range(count)])
                observer(env, running)
            for outcome in tracker.add(stepped.unsqueeze(1)):
                outcomes.setdefault(outcome.env, outcome)
            current = env.maybe_reset(step_mdp(stepped))
    return tuple(outcomes[env_index] for env_index in range(count))


def write_evaluation(out_dir: str | Path, values: Mapping[str, Any]) -> Path:
    """Write evaluation.json atomically; return its path."""
    directory = Path(out_dir)
    directory.mkdir(parents=True, exist_ok=True)
    text = json.dumps(values, indent=2) + "\n"
    return files.write_text(directory / "evaluation.json", text)
