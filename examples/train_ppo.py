"""PPO in one file, on TorchRL's collector and losses: the one to copy and to change.

    python examples/train_ppo.py --task type1_bca --total-frames 150000

It reads from top to bottom: settings, environment, networks, loss, loop, evaluation.
What a long run needs beside that (checkpoints that survive kill -9, resuming, metrics
files, images) is in `cathsim train`.
"""

import dataclasses
import time

import torch
import tyro
from tensordict.nn import AddStateIndependentNormalScale as LearntScale
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import ClipTransform, ExplorationType, set_exploration_type
from torchrl.envs.transforms import VecNormV2
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from cathsim_dmc.simulation.environments import VECTOR, make_env


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run; every one is an option of the command line."""

    task: str = "type1_bca"  # a task of `cathsim list`
    observation: str = "internal"  # of numbers, not images
    max_steps: int = 2_000  # control steps of a training episode
    seed: int = 0  # of networks, exploration and environments
    total_frames: int = 150_000
    num_envs: int = 32  # simulations side by side
    steps_per_update: int = 64  # of each simulation
    epochs: int = 10
    minibatch_size: int = 256
    learning_rate: float = 3e-4  # falls to 0 over the run
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy_coefficient: float = 5.85e-4
    value_coefficient: float = 0.872
    max_grad_norm: float = 1.0
    target_kl: float = 0.05  # ends the epochs of an update
    hidden: int = 64
    evaluation_episodes: int = 30  # each with a seed of its own
    evaluation_steps: int = 2_000  # at most, of an episode


def environment(settings: Settings, num_envs: int, seed: int, max_steps: int):
    """Simulations side by side, with one vector of normalised numbers to observe."""
    env = make_env(
        settings.task,
        observation=settings.observation,
        num_envs=num_envs,
        seed=seed,
        task_kwargs={"max_steps": max_steps},
    )
    # Running mean and spread over all simulations; frozen, it is part of the policy.
    norm = VecNormV2([VECTOR], decay=0.99999, eps=1e-2, reduce_batch_dims=True)
    env.append_transform(norm)
    env.append_transform(ClipTransform([VECTOR], low=-10.0, high=10.0))
    return env, norm


def network(inputs: int, outputs: int, hidden: int, gain: float) -> nn.Sequential:
    """Two hidden layers, orthogonal weights; `gain` is that of the last layer."""
    layers = []
    for size in (inputs, hidden):
        layers += [nn.Linear(size, hidden), nn.Tanh()]
        nn.init.orthogonal_(layers[-2].weight, 2**0.5)
        nn.init.zeros_(layers[-2].bias)
    layers.append(nn.Linear(hidden, outputs))
    nn.init.orthogonal_(layers[-1].weight, gain)
    nn.init.zeros_(layers[-1].bias)
    return nn.Sequential(*layers)


def make_actor(env, hidden: int) -> ProbabilisticActor:
    """A Gaussian whose spread is learnt, and the same everywhere."""
    inputs = env.observation_spec[VECTOR].shape[-1]
    actions = env.action_spec.shape[-1]
    mean = TensorDictModule(
        network(inputs, actions, hidden, gain=0.01), [VECTOR], ["mean"]
    )
    scale = TensorDictModule(LearntScale(actions), ["mean"], ["loc", "scale"])
    return ProbabilisticActor(
        TensorDictSequential(mean, scale),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
        # The simulation clips actions to [-1, 1]; the log-probability is of the
        # action as it was drawn.
        default_interaction_type=ExplorationType.RANDOM,
    )


def update(batch, loss, advantage, optimiser, settings: Settings) -> float:
    """Several epochs over a batch; returns the divergence from the old policy."""
    with torch.no_grad():
        advantage(batch)
    frames = batch.reshape(-1)
    divergence = 0.0
    for _ in range(settings.epochs):
        kls = []
        for rows in torch.randperm(len(frames)).split(settings.minibatch_size):
            terms = loss(frames[rows])
            total = sum(terms[f"loss_{n}"] for n in ("objective", "critic", "entropy"))
            optimiser.zero_grad()
            total.backward()
            nn.utils.clip_grad_norm_(loss.parameters(), settings.max_grad_norm)
            optimiser.step()
            kls.append(terms["kl_approx"].detach())
        divergence = float(torch.stack(kls).mean())
        if divergence > settings.target_kl:
            break
    return divergence


@torch.no_grad()
def evaluate(actor, norm: VecNormV2, settings: Settings) -> dict[str, float]:
    """Play every episode to its end with the most likely actions."""
    episodes = settings.evaluation_episodes
    env, own = environment(settings, episodes, 1_000_000, settings.evaluation_steps)
    own.load_state_dict(norm.state_dict())
    own.freeze()
    alive = torch.ones(episodes, dtype=torch.bool)
    success, steps, force = (torch.zeros(episodes) for _ in range(3))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        while alive.any():
            stepped, state = env.step_and_maybe_reset(actor(state))
            info = stepped["next", "info"]
            steps += alive
            peak = info["wall_force_peak_max"][:, 0]
            force = torch.where(alive, torch.maximum(force, peak), force)
            success += alive & info["success"][:, 0]
            alive &= ~stepped["next", "done"][:, 0]
    env.close()
    return {
        "success": float(success.mean()),
        "control steps": float(steps.mean()),
        "largest force, N": float(force.mean()),
    }


def train(settings: Settings) -> dict[str, float]:
    """Train and evaluate; returns the figures of the evaluation."""
    torch.manual_seed(settings.seed)
    torch.set_num_threads(1)  # the networks are small
    env, norm = environment(
        settings, settings.num_envs, settings.seed, settings.max_steps
    )
    actor = make_actor(env, settings.hidden)
    inputs = env.observation_spec[VECTOR].shape[-1]
    critic = ValueOperator(
        network(inputs, 1, settings.hidden, gain=1.0), in_keys=[VECTOR]
    )
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=settings.clip,
        entropy_coeff=settings.entropy_coefficient,
        critic_coeff=settings.value_coefficient,
        loss_critic_type="l2",
        normalize_advantage=True,
    )
    advantage = GAE(
        gamma=settings.gamma, lmbda=settings.gae_lambda, value_network=critic
    )
    optimiser = torch.optim.Adam(loss.parameters(), settings.learning_rate, eps=1e-5)
    per_batch = settings.num_envs * settings.steps_per_update
    collector = Collector(
        env, actor, frames_per_batch=per_batch, total_frames=settings.total_frames
    )
    start, frames = time.monotonic(), 0
    for batch in collector:
        left = 1.0 - frames / settings.total_frames
        optimiser.param_groups[0]["lr"] = settings.learning_rate * left
        divergence = update(batch, loss, advantage, optimiser, settings)
        frames += batch.numel()
        reached = int(batch["next", "info", "success"].sum())
        print(
            f"{frames:8} frames, {frames / (time.monotonic() - start):6.0f} a second, "
            f"reward {float(batch['next', 'reward'].mean()):+.4f}, reached the goal "
            f"{reached} times, kl {divergence:.3f}",
            flush=True,
        )
    collector.shutdown()
    return evaluate(actor, norm, settings)


if __name__ == "__main__":
    for name, value in train(tyro.cli(Settings)).items():
        print(f"{name}: {value:.3f}")
