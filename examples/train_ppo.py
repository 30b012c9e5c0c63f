"""PPO in one file, on TorchRL's collector and losses, to copy and change.

    python examples/train_ppo.py --task type1_lcca --total-frames 300000

From top to bottom: settings, environment, networks, noise, loop, evaluation. The
settings are those of `cathsim train type1_lcca --preset tuned`, which adds features for
long runs: checkpoints that survive kill -9, metrics, images.
"""

import dataclasses
import math
import time

import torch
import tyro
from tensordict.nn import AddStateIndependentNormalScale as LearntScale
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from cathsim_dmc.agents.normalisation import ObservationNormaliser
from cathsim_dmc.simulation.environments import VECTOR, make_env


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run; every one is an option of the command line."""

    task: str = "type1_lcca"  # a task of `cathsim list`
    observation: str = "internal"  # of numbers, not images
    seed: int = 0  # of networks, exploration and environments
    total_frames: int = 300_000
    # Training episodes are short and start anywhere along the route; the reward is the
    # remaining path through the lumen. The evaluation is that of the task.
    max_steps: int = 120
    start: tuple[float, float] = (0.0, 0.9)  # fractions of the route
    num_envs: int = 32  # parallel simulations
    steps_per_update: int = 64  # of each simulation
    epochs: int = 10
    minibatch_size: int = 256
    learning_rate: float = 3e-4
    gamma: float = 0.99
    clip: float = 0.2
    target_kl: float = 0.05  # ends the epochs of an update
    hidden: int = 128
    deviation: float = 0.7  # initial deviation of the actions, before the tanh
    correlation: float = 0.9  # of the noise between two control steps
    shared: float = 0.8  # fraction of its variance that the motors of an axis share
    evaluation_episodes: int = 30  # each with its own seed
    evaluation_steps: int = 2_000  # at most, of an episode


def environment(settings: Settings, num_envs: int, seed: int, max_steps: int, **more):
    """Parallel simulations with a vector observation."""
    options = {"max_steps": max_steps, **more}
    kwargs = {"observation": settings.observation, "task_kwargs": options}
    return make_env(settings.task, num_envs=num_envs, seed=seed, **kwargs)


def network(inputs: int, outputs: int, hidden: int, gain: float) -> MLP:
    """Two hidden layers, orthogonal weights; `gain` is that of the last layer."""
    mlp = MLP(inputs, outputs, num_cells=[hidden, hidden], activation_class=nn.Tanh)
    layers = [layer for layer in mlp if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else 2**0.5)
        nn.init.zeros_(layer.bias)
    return mlp


def make_actor(inputs: int, actions: int, settings: Settings) -> ProbabilisticActor:
    """A tanh-squashed Gaussian; its learnt deviation is the same in all states."""
    mean = network(inputs, actions, settings.hidden, gain=0.01)
    scale = LearntScale(actions, init_value=math.log(settings.deviation))
    return ProbabilisticActor(
        TensorDictModule(nn.Sequential(mean, scale), ["normal"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


class Exploration(TensorDictModuleBase):
    """The policy with noise correlated in time and over the motors of an axis.

    White noise on twenty motors averages out along the tip and over time. Each action
    is still normal about the mean, and PPO computes its log-probability as for white
    noise (Hollenstein et al., Colored Noise in PPO, AAAI 2024).
    """

    def __init__(self, policy: TensorDictSequential, groups, settings: Settings):
        super().__init__()
        self.policy, self.groups = policy, torch.as_tensor(groups)
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.shared, self.memory = settings.shared, settings.correlation
        self.noise = None

    def forward(self, frame):
        """Adds the action and its log-probability."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            frame = self.policy(frame)
        mean, deviation = frame["loc"], frame["scale"]
        common = torch.randn(*mean.shape[:-1], int(self.groups.max()) + 1)
        noise = math.sqrt(1 - self.shared) * torch.randn_like(mean)
        noise += math.sqrt(self.shared) * common[..., self.groups]
        if self.noise is not None:
            noise = self.memory * self.noise + math.sqrt(1 - self.memory**2) * noise
        self.noise = noise
        drawn = torch.tanh(mean + deviation * noise)
        frame["action"] = drawn.clamp(-1 + 1e-6, 1 - 1e-6)
        frame["action_log_prob"] = TanhNormal(mean, deviation).log_prob(frame["action"])
        return frame


def update(batch, loss, advantage, optimiser, settings: Settings) -> float:
    """Several epochs over a batch; returns the divergence from the old policy."""
    with torch.no_grad():
        advantage(batch)
    frames, divergence = batch.reshape(-1), 0.0
    for _ in range(settings.epochs):
        kls = []
        for rows in torch.randperm(len(frames)).split(settings.minibatch_size):
            terms = loss(frames[rows])
            total = sum(terms[f"loss_{n}"] for n in ("objective", "critic", "entropy"))
            optimiser.zero_grad()
            total.backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimiser.step()
            kls.append(terms["kl_approx"].detach())
        divergence = float(torch.stack(kls).mean())
        if divergence > settings.target_kl:
            break
    return divergence


@torch.no_grad()
def evaluate(policy, settings: Settings) -> None:
    """Play episodes of the task to their ends with deterministic actions."""
    episodes = settings.evaluation_episodes
    env = environment(settings, episodes, 1_000_000, settings.evaluation_steps)
    alive = torch.ones(episodes, dtype=torch.bool)
    success, steps = torch.zeros(episodes), torch.zeros(episodes)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        while alive.any():
            stepped, state = env.step_and_maybe_reset(policy(state))
            steps += alive
            success += alive & stepped["next", "info", "success"][:, 0]
            alive &= ~stepped["next", "done"][:, 0]
    print(f"success: {100 * success.mean():.0f} % of {episodes} episodes")
    print(f"{steps.mean():.0f} control steps on average")


def train(settings: Settings) -> None:
    """Train and evaluate."""
    torch.manual_seed(settings.seed)
    torch.set_num_threads(1)  # the networks are small
    env = environment(
        settings, settings.num_envs, settings.seed, settings.max_steps,
        start_along_route=settings.start, reward={"path": -1.0, "success": 10.0},
    )  # fmt: skip
    inputs = env.observation_spec[VECTOR].shape[-1]
    norm = ObservationNormaliser(inputs, clip=10.0)
    norm.update(env.rollout(128, break_when_any_done=False)[VECTOR])  # random actions
    normalise = TensorDictModule(norm, [VECTOR], ["normal"])
    actor = make_actor(inputs, env.action_spec.shape[-1], settings)
    critic = ValueOperator(network(inputs, 1, settings.hidden, 1.0), in_keys=["normal"])
    loss = ClipPPOLoss(
        actor, critic, clip_epsilon=settings.clip, normalize_advantage=True,
        entropy_coeff=5.85e-4, critic_coeff=0.872, loss_critic_type="l2",
        functional=False,
    )  # fmt: skip
    advantage = GAE(gamma=settings.gamma, lmbda=0.95, value_network=critic)
    optimiser = torch.optim.Adam(loss.parameters(), settings.learning_rate, eps=1e-5)
    policy = TensorDictSequential(normalise, actor)
    explorer = Exploration(policy, env.base_env.action_groups, settings)
    size = settings.num_envs * settings.steps_per_update
    batches = Collector(
        env, explorer, total_frames=math.ceil(settings.total_frames / size) * size,
        frames_per_batch=size, auto_register_policy_transforms=False,
    )  # fmt: skip
    start, frames = time.monotonic(), 0
    for batch in batches:
        normalise(batch["next"])
        divergence = update(batch, loss, advantage, optimiser, settings)
        norm.update(batch[VECTOR])  # the actions were chosen under the old statistics
        frames += batch.numel()
        rate, ended = frames / (time.monotonic() - start), batch["next", "done"].sum()
        reached = int(batch["next", "info", "success"].sum())
        print(f"{frames:8} frames, {rate:5.0f} a second, kl {divergence:.3f}, reached "
              f"the goal in {reached} of {ended} episodes", flush=True)  # fmt: skip
    batches.shutdown()
    evaluate(policy, settings)


if __name__ == "__main__":
    train(tyro.cli(Settings))
